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
    const int64_t row = at.k / P, first = at.k % P;
    int64_t span = 1;
    for (int w = 0; w < LEVELS && row < levels.rows[w]; w++) span *= 2;
    const float* entries = table + at.row * R * P + row * P;
    float lowest = entries[first];
    for (int64_t k = 1; k < span; k++) {
        const float other = entries[(first + k) % P];
        if (other < lowest || other != other) lowest = other;
    }
    widened[at.row * R * P + at.k] = lowest;
}
