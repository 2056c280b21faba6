// Where the window lies: stage.py.
#pragma once

#include "kernels/scalar.h"

namespace recentering {

// First cell of a window of so many cells that is centred on the base to within half a cell, by the base's place [m]:
// `window_corner`.
INLINE float first_cell(float base, int64_t size, float resolution) {
    return floor_of(base / resolution - 0.5f * float(size) + 0.5f);
}

}  // namespace recentering
