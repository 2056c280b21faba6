// Height drift compensation: stage.py.
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF  // rounded as in torch
#else
#pragma GCC optimize("fp-contract=off")
#endif

#include <algorithm>
#include <limits>
#include <vector>

#include "kernels/update.h"
#include "stages/cells.h"
#include "stages/compensate/equation.h"
#include "stages/disagreement/equation.h"
#include "stages/disagreement/sensors.h"

namespace {

constexpr int64_t AT_A_TIME = 16384;  // points that are worth a thread
constexpr float NONE = std::numeric_limits<float>::infinity();

// Sums over the points that measure the drift.
struct Sums {
    double error = 0, noise = 0;
    int64_t number = 0;

    float mean() const { return float(error / double(std::max<int64_t>(number, 1))); }
    float mean_noise() const { return float(noise / double(std::max<int64_t>(number, 1))); }
};

struct Errors {
    Buffer<float> of;  // (M) [m] of each point; infinite where it does not count
};

// Sum over the points by parts, in an order that does not depend on the threads.
template <class Add> Sums sum_up(const Update& u, const Add& add) {
    const int64_t number = u.measurement.number, parts = (number + AT_A_TIME - 1) / AT_A_TIME;
    std::vector<Sums> sums(parts);
    u.each(parts, 1, [&](int64_t, int64_t begin, int64_t end) {
        for (int64_t p = begin; p < end; p++)
            for (int64_t k = p * AT_A_TIME; k < std::min(number, (p + 1) * AT_A_TIME); k++) add(k, sums[p]);
    });
    Sums all;
    for (const Sums& part : sums) all.error += part.error, all.noise += part.noise, all.number += part.number;
    return all;
}

// Find the height error of each point: `height_error` where it counts.
Sums find_errors(Update& u, float* errors) {
    const CompensateSettings& s = u.settings.compensate;
    const Measurement& m = u.measurement;
    const MapState& map = u.state;
    const int32_t columns = int32_t(u.sizes.W);
    return sum_up(u, [&](int64_t k, Sums& sums) {
        errors[k] = NONE;
        const int32_t cell = m.slot[k];
        if (cell < 0 || !drift::suits(map.validity[cell], map.traversability[cell], map.variance[cell], s)) return;
        const float x = center_offset(u, 0, cell / columns, s.resolution);
        const float y = center_offset(u, 1, cell % columns, s.resolution);
        const float error = drift::height_error(m.x[k], m.y[k], m.z[k], map.elevation[cell], map.gradient_x[cell],
                                                map.gradient_y[cell], x, y);
        if (absolute(error) <= s.max_error) errors[k] = error, sums.error += error, sums.number++;
    });
}

// Add the correction [m] to elevations, challengers and upper bounds.
void shift_heights(Update& u, float shift) {
    const MapState& map = u.state;
    u.each(u.cells(), 65536, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t k = first; k < last; k++) {
            map.elevation[k] += map.validity[k] ? shift : 0.0f;
            map.challenger[k] += map.challenger_support[k] ? shift : 0.0f;
            map.upper_bound[k] += map.bounded[k] ? shift : 0.0f;
        }
    });
}

bool is_empty(const Update& u) {
    return std::none_of(u.state.validity, u.state.validity + u.cells(), [](uint8_t known) { return known; });
}

// Note how uncertain the position is that the map's heights count from: `share_pose_error`.
void share_pose_error(Update& u, bool applies) {
    if (!u.measurement.has_covariance) return;
    const bool follows = applies || is_empty(u);
    float* own = u.state.pose_covariance;
    const float shared = follows ? 0 : own[8];
    for (int k = 0; k < 9; k++)
        own[k] = !follows && (k / 3 == 2 || k % 3 == 2) ? 0 : u.measurement.pose_covariance[k];
    const float limit = u.settings.fusion.max_variance;
    for (int64_t k = 0; shared != 0 && k < u.cells(); k++) {
        float& variance = u.state.variance[k];
        variance = u.state.validity[k] ? smaller(variance + shared, limit) : variance;
    }
}

// Compensate the drift; return whether a correction applies.
bool compensate(Update& u) {
    const CompensateSettings& s = u.settings.compensate;
    const Measurement& m = u.measurement;
    locate(u, s.resolution);
    float* errors = u.memory.get<Errors>().of.resize(m.number);
    const float first_mean = find_errors(u, errors).mean();
    // Again around the mean: the foot of a wall that was not seen before stands on ground that looks flat.
    const Sums near = sum_up(u, [&](int64_t k, Sums& sums) {
        if (!drift::is_near_mean(errors[k], first_mean, m.noise[k], s)) return;
        sums.error += errors[k], sums.noise += m.noise[k] + s.relief_square, sums.number++;
    });
    const float mean = near.mean(), correction = drift::correction(mean, near.number, s);
    const Statistics& to = u.state.statistics;
    if (m.sensors == 1) {
        const float error_variance = near.mean_noise() / float(std::max<int64_t>(near.number, 1));
        *to.disagreement = disagreement::compare_scans(*to.drift_correction, *to.disagreement, correction,
                                                       error_variance, u.settings.disagreement);
    }
    if (correction != 0) shift_heights(u, correction);
    *to.drift_points = near.number, *to.drift_error = mean, *to.drift_correction = correction;
    return near.number >= s.min_points && absolute(mean) <= s.max_drift;
}

}  // namespace

extern "C" void run_compensate(Update& u) {
    if (u.measurement.sensors > 1) *u.state.statistics.disagreement = disagreement::compare_sensors(u);
    share_pose_error(u, u.settings.compensate.has_drift && compensate(u));
}
