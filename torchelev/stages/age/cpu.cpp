// Process noise: stage.py.

#include <cmath>

#include "stages/chosen_cells.h"
#include "stages/age/equation.h"

extern "C" void run_age(Update& u) {
    const float dt = u.measurement.dt, added = u.settings.age.variance_rate * dt;
    *u.state.elapsed += int64_t(std::nearbyint(double(dt) * 1e9));
    const float limit = u.settings.fusion.max_variance;
    float *time = u.state.time, *variance = u.state.variance;
    for_chosen(u, u.state.validity, [&](int64_t k, Flags known, auto count) {
        const Lanes before = load(variance + k, count);
        store(time + k, load(time + k, count) + zero_unless(known, splat(dt)), count);
        store(variance + k, pick(known, aging::grow(before, added, limit), before), count);
    });
}
