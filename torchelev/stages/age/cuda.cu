// Process noise, on a GPU: stage.py.

#include "kernels/cuda/update.h"
#include "stages/age/equation.h"

// Advance clocks and variances. A thread for each cell.
extern "C" __global__ void age(Update u) {
    const Place at = place(u.cells());
    const MapState map = u.state.at(at.row, u.sizes);
    const float dt = u.scratch.dt[at.row], added = u.settings.age.variance_rate * dt;
    if (at.k == 0) *map.elapsed += int64_t(rint(double(dt) * 1e9));
    if (at.k >= u.cells() || !map.validity[at.k]) return;
    map.time[at.k] += dt;
    map.variance[at.k] = aging::grow(map.variance[at.k], added, u.settings.fusion.max_variance);
}
