// Minima of neighbours in a row.
#pragma once

#include <algorithm>
#include <cstdint>

#include "native/tables/lower.h"

// Make each entry of a row the minimum of itself and the one `shift` on, all around; `start` has room for `shift`.
inline void widen_row(float* row, int64_t width, int64_t shift, float* start) {
    std::copy(row, row + shift, start);
    for (int64_t a = 0; a < width - shift; a++) row[a] = lower(row[a], row[a + shift]);
    for (int64_t a = width - shift; a < width; a++) row[a] = lower(row[a], start[a - (width - shift)]);
}
