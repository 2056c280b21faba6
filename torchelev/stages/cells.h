// Which cell of the window each point falls into, once in an update: stages/cells.py.
#pragma once

#include <atomic>

#include "kernels/simd.h"
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
        for_vectors(first, last, [&](int64_t k, auto count) {
            const Flags is_used = load_bytes(&m.used[k], count) > 0;
            const Flags found = window.slot(load(&m.x[k], count), load(&m.y[k], count)) | ~is_used;
            std::memcpy(slots + k, &found, sizeof(int32_t) * count);
            own_inside += count_set(found >= 0), own_used += count_set(is_used);
        });
        inside += own_inside, used += own_used;
    });
    m.inside = inside, m.outside = used - inside, m.is_located = true;
}
