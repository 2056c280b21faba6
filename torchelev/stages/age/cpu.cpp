// Process noise: stage.py.

#include <cmath>

#include "kernels/simd.h"
#include "kernels/update.h"
#include "stages/age/equation.h"

extern "C" void run_age(Update& u) {
    const float dt = u.measurement.dt, added = u.settings.age.variance_rate * dt;
    *u.state.elapsed += int64_t(std::nearbyint(double(dt) * 1e9));
    const float limit = u.settings.fusion.max_variance;
    float *time = u.state.time, *variance = u.state.variance;
    const uint8_t* known = u.state.validity;
    u.each(u.cells(), 65536, [&](int64_t, int64_t first, int64_t last) {
        for_vectors(first, last, [&](int64_t k, auto count) {
            store(time + k, load(time + k, count) + dt, count);
            const Lanes grown = aging::grow(load(variance + k, count), added, limit);
            store(variance + k, pick(load_bytes(known + k, count) > 0, grown, all(1)), count);
        });
    });
}
