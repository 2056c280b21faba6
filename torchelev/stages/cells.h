// Which cell of the window each point falls into, once in an update: stages/cells.py.
#pragma once

#include <atomic>

#include "kernels/update.h"
#include "stages/window.h"

// As in window.h, of an update's window and measurement.
inline float lattice_offset(const Update& u, int axis, float resolution) {
    return lattice_offset(u.state.corner, u.measurement.anchor, axis, resolution);
}

inline float center_offset(const Update& u, int axis, int64_t k, float resolution) {
    return center_offset(u.state.corner, u.measurement.anchor, axis, k, resolution);
}

// Find the cell of each point that measures the ground.
inline void locate(Update& u, float resolution) {
    Measurement& m = u.measurement;
    if (m.is_located) return;
    const Window window(u.state.corner, m.anchor, u.sizes, resolution);
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
