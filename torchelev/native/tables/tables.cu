// Polar tables on a GPU: `polar_minimum` in ops/operators.py.

#include <cstdint>

#include "lower.h"
#include "threads.h"

// Write the running minimum of tables (B, R, P) from row `ranges` - 1 to the first, a thread for each column; the rows
// from `ranges` on are blank.
extern "C" __global__ void scan_back(const float* __restrict__ table, float* __restrict__ scanned, int64_t R, int64_t P,
                                     int64_t ranges, float blank) {
    const Place at = place(P);
    if (at.k >= P) return;
    const int64_t first = at.row * R * P + at.k;
    for (int64_t row = ranges; row < R; row++) scanned[first + row * P] = blank;
    float lowest = blank;
#pragma unroll 16
    for (int32_t row = int32_t(ranges) - 1; row >= 0; row--) {
        lowest = lower(table[first + row * P], lowest);
        scanned[first + row * P] = lowest;
    }
}

constexpr int LEVELS = 16;

struct Levels {
    int64_t rows[LEVELS];  // below which a level widens an entry; 0 after the last level
};

// Make each entry of tables (B, R, P) the minimum of itself and the 1, 3, 7, ... entries that follow it around the row.
// A thread for each entry.
extern "C" __global__ void widen(const float* table, float* widened, int64_t R, int64_t P, Levels levels) {
    const Place at = place(R * P);
    if (at.k >= R * P) return;
    const int32_t width = int32_t(P), row = int32_t(at.k) / width, first = int32_t(at.k) % width;
    int32_t span = 1;
    for (int w = 0; w < LEVELS && row < levels.rows[w]; w++) span *= 2;
    const float* entries = table + at.row * R * P + int64_t(row) * P;
    float lowest = entries[first];
    for (int32_t k = first, left = span; left > 0; left--) {
        lowest = lower(entries[k], lowest);
        k = k + 1 < width ? k + 1 : 0;
    }
    widened[at.row * R * P + at.k] = lowest;
}
