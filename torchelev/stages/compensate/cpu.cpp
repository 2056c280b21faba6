// Height drift compensation: stage.py.

#include <algorithm>
#include <limits>
#include <vector>

#include "stages/cells.h"
#include "stages/chosen_cells.h"
#include "stages/compensate/equation.h"
#include "stages/disagreement/equation.h"
#include "stages/disagreement/sensors.h"

namespace {

constexpr int64_t AT_A_TIME = 16384;  // points that are worth a thread
constexpr int64_t IN_FLOAT = 1024;  // points whose sums keep float's precision
constexpr float NONE = std::numeric_limits<float>::infinity();

// Sums over the points that measure the drift.
struct Sums {
    double error = 0, noise = 0;
    int64_t number = 0;

    float mean() const { return float(error / double(std::max<int64_t>(number, 1))); }
    float mean_noise() const { return float(noise / double(std::max<int64_t>(number, 1))); }
};

// `Sums` of vectors, of few points.
struct Totals {
    PartialSums error, noise;
    int64_t number = 0;

    void add(int64_t k, Flags counts, Lanes own, Lanes own_noise) {
        error.add(k, zero_unless(counts, own)), noise.add(k, zero_unless(counts, own_noise));
        number += count_set(counts);
    }
    void add_to(Sums& sums) const {
        sums.error += error.total<double>(), sums.noise += noise.total<double>(), sums.number += number;
    }
};

struct Errors {
    Buffer<float> of;  // (M) [m] of each point; infinite where it does not count
};

// Sum over the points by parts, in an order that does not depend on the threads: `add(k, count, totals)`.
template <class Add> Sums sum_up(const Update& u, const Add& add) {
    const int64_t number = u.measurement.number, parts = (number + AT_A_TIME - 1) / AT_A_TIME;
    auto& sums = u.memory.get<std::vector<Sums>>();
    sums.assign(parts, Sums());
    u.each(parts, 1, [&](int64_t, int64_t begin, int64_t end) {
        for (int64_t p = begin; p < end; p++)
            for (int64_t k = p * AT_A_TIME; k < std::min(number, (p + 1) * AT_A_TIME); k += IN_FLOAT) {
                Totals totals;
                const int64_t last = std::min({number, (p + 1) * AT_A_TIME, k + IN_FLOAT});
                for_vectors(k, last, [&](int64_t at, auto count) { add(at, count, totals); });
                totals.add_to(sums[p]);
            }
    });
    Sums all;
    for (const Sums& part : sums) all.error += part.error, all.noise += part.noise, all.number += part.number;
    return all;
}

template <class Count> Flags load_slots(const int32_t* slots, Count count) {
    Flags found = Flags{} - 1;
    std::memcpy(&found, slots, sizeof(int32_t) * count);
    return found;
}

// Find the height error of each point: `height_error` where it counts.
Sums find_errors(Update& u, float* errors) {
    const CompensateSettings& s = u.settings.compensate;
    const Measurement& m = u.measurement;
    const MapState& map = u.state;
    return sum_up(u, [&](int64_t k, auto count, Totals& totals) {
        const Flags slots = load_slots(&m.slot[k], count), cells = pick_int(slots >= 0, slots, Flags{});
        Flags counts = (slots >= 0) & (gather(map.validity, cells) > 0);
        counts &= drift::suits(gather(map.traversability, cells), gather(map.variance, cells), s);
        Lanes error = splat(NONE);
        if (any(counts)) {
            const Lanes gx = gather(map.gradient_x, cells), gy = gather(map.gradient_y, cells);
            error = drift::height_error(load(&m.x[k], count), load(&m.y[k], count), load(&m.z[k], count),
                                        gather(map.elevation, cells), gx, gy, s);
            counts &= absolute(error) <= s.max_error;
            error = pick(counts, error, splat(NONE));
            totals.add(k, counts, error, Lanes{});
        }
        store(errors + k, error, count);
    });
}

// Add the correction [m] to elevations, challengers and upper bounds.
void shift_heights(Update& u, float shift) {
    const MapState& map = u.state;
    auto add = [&](float* layer, const uint8_t* where) {
        for_chosen(u, where, [&](int64_t k, Flags chosen, auto count) {
            store(layer + k, load(layer + k, count) + zero_unless(chosen, splat(shift)), count);
        });
    };
    add(map.elevation, map.validity), add(map.challenger, map.challenger_support), add(map.upper_bound, map.bounded);
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
    const Sums near = sum_up(u, [&](int64_t k, auto count, Totals& totals) {
        Lanes error = splat(NONE), noise{};
        std::memcpy(&error, errors + k, sizeof(float) * count), noise = load(&m.noise[k], count);
        totals.add(k, drift::is_near_mean(error, splat(first_mean), noise, s), error, noise + s.relief_square);
    });
    const float mean = near.mean();
    const bool applies = drift::applies(mean, near.number, u.inputs.moving, s);
    const float correction = applies ? s.gain * mean : 0;
    const Statistics& to = u.state.statistics;
    if (m.sensors == 1) {
        const float error_variance = near.mean_noise() / float(std::max<int64_t>(near.number, 1));
        *to.disagreement = disagreement::compare_scans(*to.drift_correction, *to.disagreement, correction,
                                                       error_variance, u.settings.disagreement);
    }
    if (correction != 0) shift_heights(u, correction);
    *to.drift_points = near.number, *to.drift_error = mean, *to.drift_correction = correction;
    return applies;
}

}  // namespace

extern "C" void run_compensate(Update& u) {
    if (u.measurement.sensors > 1) *u.state.statistics.disagreement = disagreement::compare_sensors(u);
    share_pose_error(u, u.settings.compensate.has_drift && compensate(u));
}
