// The disagreement taken out of variances, and put in again, on a GPU: stage.py.

#include "kernels/cuda/update.h"
#include "stages/disagreement/equation.h"

// A thread for each cell, as below.
extern "C" __global__ void subtract_disagreement(Update u) {
    const Place at = place(u.cells());
    const MapState map = u.state.at(at.row, u.sizes);
    const float d = *map.statistics.disagreement;
    if (d == 0 || at.k >= u.cells()) return;
    map.variance[at.k] =
        disagreement::without(map.variance[at.k], map.validity[at.k] ? d * d : 0.0f, u.settings.disagreement);
}

extern "C" __global__ void add_disagreement(Update u) {
    const Place at = place(u.cells());
    const MapState map = u.state.at(at.row, u.sizes);
    const float d = *map.statistics.disagreement;
    if (d == 0 || at.k >= u.cells()) return;
    map.variance[at.k] += map.validity[at.k] ? d * d : 0.0f;
}
