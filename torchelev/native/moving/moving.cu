// Layers moved by whole cells, in place, on a GPU: ops/moving.py. A block for each layer of each map.

#include <algorithm>
#include <cstdint>

#include "threads.h"

constexpr int LAYERS = 16;  // at most
constexpr int EACH = 8;     // cells that a thread moves at a time

struct Layers {
    void* cells[LAYERS];   // (B, H, W) each
    float blanks[LAYERS];  // of entering cells
};

// Give cell (i, j) what was at (i + di, j + dj), or `blank` if that lies outside.
template <class Value>
inline void move(Value* layer, Value blank, int32_t rows, int32_t columns, int32_t di, int32_t dj) {
    if (di == 0 && dj == 0) return;
    const int32_t cells = rows * columns, step = blockDim.x, chunk = EACH * step, chunks = (cells + chunk - 1) / chunk;
    const int32_t step_rows = step / columns, step_columns = step % columns;
    const bool forward = di * columns + dj >= 0;  // so that no cell is overwritten before it is read
    for (int32_t n = 0; n < chunks; n++) {
        const int32_t start = (forward ? n : chunks - 1 - n) * chunk + threadIdx.x;
        int32_t i = start / columns + di, j = start % columns + dj;
        Value values[EACH];
#pragma unroll
        for (int e = 0; e < EACH; e++) {
            const bool stays = i >= 0 && i < rows && j >= 0 && j < columns && start + e * step < cells;
            values[e] = stays ? layer[i * columns + j] : blank;
            i += step_rows, j += step_columns;
            if (j >= columns + dj) i++, j -= columns;
        }
        __syncthreads();
#pragma unroll
        for (int e = 0; e < EACH; e++)
            if (start + e * step < cells) layer[start + e * step] = values[e];
    }
}

// Move this block's layer of this block's map, by the map's shift of (B, 2).
template <class Value>
inline void move_own(const Layers& layers, const int64_t* shifts, int64_t number, int64_t H, int64_t W) {
    const unsigned block = unsigned(blockIdx.x), b = block / unsigned(number), l = block % unsigned(number);
    const int64_t* shift = shifts + 2 * b;
    Value* layer = static_cast<Value*>(layers.cells[l]) + b * H * W;
    move<Value>(layer, Value(layers.blanks[l]), int32_t(H), int32_t(W), int32_t(shift[0]), int32_t(shift[1]));
}

extern "C" __global__ void move_floats(Layers layers, const int64_t* shifts, int64_t number, int64_t H, int64_t W) {
    move_own<float>(layers, shifts, number, H, W);
}

extern "C" __global__ void move_bytes(Layers layers, const int64_t* shifts, int64_t number, int64_t H, int64_t W) {
    move_own<uint8_t>(layers, shifts, number, H, W);
}
