// Places of cells and points in a window: stages/cells.py and `locate` in grid.py, for C++ and CUDA.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "generated.h"
#include "kernels/scalar.h"

// Difference of two cell numbers of the lattice as a float, which fits it exactly only if they are near; far ones are
// clamped, they are outside.
inline float cells_between(int64_t from, int64_t to) {
    const int64_t most = int64_t(1) << 22, cells = to - from;
    return float(cells < -most ? -most : cells > most ? most : cells);
}

// Where the measurement's horizontal origin lies, seen from the window's corner [m].
inline float lattice_offset(const int64_t* corner, const int64_t* anchor, int axis, float resolution) {
    return cells_between(corner[axis], anchor[axis]) * resolution;
}

// Place of the centre of row (axis 0) or column (axis 1) k [m], counted from the measurement's horizontal origin.
inline float center_offset(const int64_t* corner, const int64_t* anchor, int axis, int64_t k, float resolution) {
    return (float(k) + (cells_between(anchor[axis], corner[axis]) + 0.5f)) * resolution;
}

// The window on the lattice, as a measurement sees it.
struct Window {
    float resolution, first[2];  // [m]; [cells] of the measurement's horizontal origin
    int32_t rows, columns;

    Window(const int64_t* corner, const int64_t* anchor, const Sizes& sizes, float resolution)
        : resolution(resolution), rows(int32_t(sizes.H)), columns(int32_t(sizes.W)) {
        for (int axis = 0; axis < 2; axis++)
            first[axis] = rintf(lattice_offset(corner, anchor, axis, resolution) / resolution);
    }
    // Flat number of the cell that a point [m] lies in, -1 outside the window.
    template <class V> INLINE auto slot(V x, V y) const {
        // Divide before adding whole cells: the result is then the same wherever the window is.
        const V i = floor_of(x / resolution) + first[0], j = floor_of(y / resolution) + first[1];
        const V near_i = clamp(i, 0, float(rows - 1)), near_j = clamp(j, 0, float(columns - 1));
        return index_or_none((i == near_i) & (j == near_j), integers(near_i) * columns + integers(near_j));
    }
};
