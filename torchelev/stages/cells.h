// Which cell of the window each point falls into: stages/cells.py, with the same names.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>

#include "kernels/update.h"

// Difference of two cell numbers of the lattice as a float, which fits it exactly only if they are near; far ones are
// clamped, they are outside.
inline float cells_between(int64_t from, int64_t to) {
    return float(std::clamp<int64_t>(to - from, -(int64_t(1) << 22), int64_t(1) << 22));
}

// Where the measurement's horizontal origin lies, seen from the window's corner [m].
inline float lattice_offset(const Update& u, int axis, float resolution) {
    return cells_between(u.state.corner[axis], u.measurement.anchor[axis]) * resolution;
}

// Place of the centre of row (axis 0) or column (axis 1) k [m], counted from the measurement's horizontal origin.
inline float center_offset(const Update& u, int axis, int64_t k, float resolution) {
    return (float(k) + (cells_between(u.measurement.anchor[axis], u.state.corner[axis]) + 0.5f)) * resolution;
}

// The window on the lattice, as a measurement sees it: `locate` in grid.py.
struct Window {
    float resolution, first[2];  // [m]; [cells] of the measurement's horizontal origin
    int32_t rows, columns;

    Window(const Update& u, float resolution) : resolution(resolution), rows(int(u.sizes.H)), columns(int(u.sizes.W)) {
        for (int axis = 0; axis < 2; axis++)
            first[axis] = std::nearbyint(lattice_offset(u, axis, resolution) / resolution);
    }
    // Flat number of the cell that a point [m] lies in, -1 outside the window.
    int32_t slot(float x, float y) const {
        // Divide before adding whole cells: the result is then the same wherever the window is.
        const float i = std::floor(x / resolution) + first[0], j = std::floor(y / resolution) + first[1];
        const bool is_inside = i >= 0 && i < rows && j >= 0 && j < columns;
        return is_inside ? int32_t(i) * columns + int32_t(j) : -1;
    }
};

// Find the cell of each point that measures the ground, once in an update.
inline void locate(Update& u, float resolution) {
    Measurement& m = u.measurement;
    if (m.is_located) return;
    const Window window(u, resolution);
    int32_t* slots = m.slot.resize(m.number);
    std::atomic<int64_t> inside{0}, used{0};
    u.each(m.number, 16384, [&](int64_t, int64_t first, int64_t last) {
        int64_t own_inside = 0, own_used = 0;
        for (int64_t k = first; k < last; k++) {
            slots[k] = m.used[k] ? window.slot(m.x[k], m.y[k]) : -1;
            own_inside += slots[k] >= 0, own_used += m.used[k];
        }
        inside += own_inside, used += own_used;
    });
    m.inside = inside, m.outside = used - inside, m.is_located = true;
}
