// Polar tables on a GPU, a thread for each entry: `polar_minimum` in ops/operators.py.

#include <cstdint>

#include "threads.h"

constexpr int LEVELS = 16;

struct Levels {
    int64_t rows[LEVELS];  // below which a level widens an entry; 0 after the last level
};

// Make each entry of tables (B, R, P) the minimum of itself and those that follow it all around: 1, 3, 7, ... of them.
extern "C" __global__ void widen(const float* table, float* widened, int64_t R, int64_t P, Levels levels) {
    const Place at = place(R * P);
    if (at.k >= R * P) return;
    const int32_t width = int32_t(P), row = int32_t(at.k) / width, first = int32_t(at.k) % width;
    int32_t span = 1;
    for (int w = 0; w < LEVELS && row < levels.rows[w]; w++) span *= 2;
    const float* entries = table + at.row * R * P + int64_t(row) * P;
    float lowest = entries[first];
    for (int32_t k = first, left = span; left > 0; left--) {
        const float other = entries[k];
        if (other < lowest || other != other) lowest = other;
        k = k + 1 < width ? k + 1 : 0;
    }
    widened[at.row * R * P + at.k] = lowest;
}
