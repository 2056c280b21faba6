// Polar tables on a GPU: `polar_minimum` in ops/operators.py.

#include <algorithm>
#include <cstdint>

#include "lower.h"
#include "threads.h"

constexpr int LEVELS = 16;
constexpr int TEAM = 128;  // threads that widen a row of a block's table

struct Levels {
    int64_t rows[LEVELS];  // below which a level widens an entry; 0 after the last level

    // How many entries, itself the first of them, one of a row looks at.
    int32_t span(int32_t row) const {
        int32_t span = 1;
        for (int w = 0; w < LEVELS && row < rows[w]; w++) span *= 2;
        return span;
    }
};

inline int32_t lower(int32_t a, int32_t b) { return a < b ? a : b; }

// The lowest of the `span` entries from place k on around a row.
template <class Value> inline Value lowest_of(const Value* __restrict__ row, int32_t k, int32_t width, int32_t span) {
    Value lowest = row[k];
#pragma unroll 8
    for (; span > 0; span--) {
        lowest = lower(row[k], lowest);
        k = k + 1 < width ? k + 1 : 0;
    }
    return lowest;
}

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

// Make each entry of tables (B, R, P) the minimum of itself and the 1, 3, 7, ... entries that follow it around the row.
// A thread for each entry.
extern "C" __global__ void widen(const float* __restrict__ table, float* __restrict__ widened, int64_t R, int64_t P,
                                 Levels levels) {
    const Place at = place(R * P);
    if (at.k >= R * P) return;
    const int32_t width = int32_t(P), row = int32_t(at.k) / width;
    const float* entries = table + at.row * R * P + row * P;
    widened[at.row * R * P + at.k] = lowest_of(entries, int32_t(at.k) % width, width, levels.span(row));
}

// Integers in the order of floats, none of them NaN; each is the other's.
inline int32_t ordered(int32_t bits) { return bits < 0 ? bits ^ 0x7fffffff : bits; }

// The whole table (B, R, P) of values (B, N) from their places on, where one table fits into a block's own memory. A
// block for each table; integers in the order of the values.
extern "C" __global__ void lowest_slopes(const int64_t* index, const float* values, float* table, int64_t N, int64_t R,
                                         int64_t P, int64_t ranges, float blank, Levels levels) {
    int32_t* lowest = block_memory();  // (ranges, P)
    const int32_t width = int32_t(P), number = int32_t(ranges) * width, first = threadIdx.x, step = blockDim.x;
    const int64_t ray = blockIdx.x * N;
    for (int32_t k = first; k < number; k += step) lowest[k] = ordered(__float_as_int(blank));
    __syncthreads();
    for (int32_t n = first; n < N; n += step) {
        const int64_t place = index[ray + n];
        if (place >= 0 && place < number) atomicMin(&lowest[place], ordered(__float_as_int(values[ray + n])));
    }
    __syncthreads();
    for (int32_t k = first; k < width; k += step)
        for (int32_t place = k + number - 2 * width; place >= 0; place -= width)
            lowest[place] = lower(lowest[place], lowest[place + width]);
    __syncthreads();
    float* own = table + blockIdx.x * R * P;
    const int32_t team = std::min(TEAM, step);
    for (int32_t row = first / team; row < R; row += step / team) {
        const int32_t* entries = lowest + row * width;
        const int32_t span = levels.span(row);
        for (int32_t k = first % team; k < width; k += team)
            own[row * width + k] = row < ranges ? __int_as_float(ordered(lowest_of(entries, k, width, span))) : blank;
    }
}
