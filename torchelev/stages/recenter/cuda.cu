// Windows follow their robots by whole cells, in place, on a GPU: stage.py. Then points find their cells: stages/cells.py.

#include <algorithm>

#include "kernels/cuda/update.h"
#include "stages/recenter/equation.h"
#include "stages/window.h"

constexpr int EACH = 8;  // cells that a thread moves at a time

// Find by how many cells each window moves, and note where it is then. A thread for each map.
extern "C" __global__ void find_shift(Update u) {
    const int64_t b = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (b >= u.sizes.B) return;
    const Scratch scan = u.scratch.at(b, u.sizes);
    const MapState map = u.state.at(b, u.sizes);
    const int64_t size[2] = {u.sizes.H, u.sizes.W}, largest = std::max(size[0], size[1]);
    const bool moves = u.inputs.T_map_base && *scan.sound;
    for (int axis = 0; axis < 2; axis++) {
        const float first = recentering::first_cell(scan.base[axis], size[axis], u.settings.recenter.resolution);
        const int64_t corner = moves ? scan.anchor[axis] + int64_t(first) : map.corner[axis];
        scan.shift[axis] = std::clamp(corner - map.corner[axis], -largest, largest);
        map.corner[axis] = corner;
    }
    if (moves) *map.base_height = scan.base[2];
}

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
        __syncthreads();
    }
}

// Move the layers. A block for each layer of each map.
extern "C" __global__ void move_layers(Update u) {
    const unsigned b = blockIdx.x / 14, l = blockIdx.x % 14;
    const MapState map = u.state.at(b, u.sizes);
    const int64_t* shift = u.scratch.at(b, u.sizes).shift;
    float* const numbers[] = {map.elevation,   map.support,    map.challenger, map.time,          map.upper_bound,
                              map.gradient_x,  map.gradient_y, map.traversability, map.variance};
    uint8_t* const bytes[] = {map.validity, map.challenger_support, map.bounded, map.has_normal, map.rated};
    const int32_t H = int32_t(u.sizes.H), W = int32_t(u.sizes.W), di = int32_t(shift[0]), dj = int32_t(shift[1]);
    if (l < 9) move(numbers[l], l == 8 ? 1.0f : 0.0f, H, W, di, dj);
    else move(bytes[l - 9], uint8_t(0), H, W, di, dj);
}

// Start counting the points inside and outside the window. A thread for each map.
extern "C" __global__ void clear_located(Update u) {
    const int64_t b = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (b < u.sizes.B) u.scratch.located[2 * b] = u.scratch.located[2 * b + 1] = 0;
}

// Find the cell of each point that measures the ground. A thread for each point.
extern "C" __global__ void locate_points(Update u) {
    const Place at = place(u.sizes.M);
    const Scratch scan = u.scratch.at(at.row, u.sizes);
    bool used = false, inside = false;
    if (at.k < u.sizes.M) {
        const Window window(u.state.at(at.row, u.sizes).corner, scan.anchor, u.sizes, u.settings.recenter.resolution);
        used = scan.used[at.k];
        const int32_t slot = used ? window.slot(scan.x[at.k], scan.y[at.k]) : -1;
        scan.slot[at.k] = slot, inside = slot >= 0;
    }
    add_of_warp(scan.located + 0, inside), add_of_warp(scan.located + 1, used && !inside);
}
