// From a sensor's points to a measurement, on a CPU: stage.py.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>

#include "kernels/simd.h"
#include "kernels/update.h"
#include "stages/measure/equation.h"

namespace {

using measurement::Vector;
constexpr int64_t AT_A_TIME = 8192;  // points that are worth a thread
constexpr float INFINITE = std::numeric_limits<float>::infinity(), TINY = std::numeric_limits<float>::min();

// Whether `number` poses may become cell numbers; NaN may not: `is_near`.
bool is_near(const double* poses, int64_t number, float farthest) {
    return !poses || std::all_of(poses, poses + 16 * number, [&](double v) { return std::fabs(v) <= farthest; });
}

// The axes and the position of a pose (4, 4) in the map's precision; all zero in an unsound environment.
struct Pose {
    float R[9];        // rows of the rotation
    double position[3];

    Pose(const double* T, bool sound) {
        for (int row = 0; row < 3; row++) {
            for (int k = 0; k < 3; k++) R[3 * row + k] = sound ? float(T[4 * row + k]) : 0;
            position[row] = sound ? T[4 * row + 3] : 0;
        }
    }
    // The position with x and y counted from the anchor cell's corner: `relative_to`.
    void put_relative(const int64_t* anchor, double resolution, float* out) const {
        for (int k = 0; k < 3; k++) out[k] = float(position[k] - (k < 2 ? double(anchor[k]) * resolution : 0.0));
    }
    // The inverse rotation.
    void transpose() { std::swap(R[1], R[3]), std::swap(R[2], R[6]), std::swap(R[5], R[7]); }
};

struct Counts {
    int64_t finite = 0, in_range = 0, casts = 0, used = 0;
};

// The points of one sensor.
struct Sensor {
    const Update& u;
    const MeasureSettings& s;
    int64_t first;            // number of its first point
    bool sound;
    float R[9], origin[3], to_base[9];
    const float* covariance;  // (6, 6) or null

    // Measure points k to k + count of this sensor's.
    template <class Count> void measure(int64_t k, Count count, Counts& counts) const {
        const int64_t n = first + k;
        Measurement& m = u.measurement;
        Vector<Lanes> p = read(3 * n, count);
        const Lanes largest = larger(larger(absolute(p.x), absolute(p.y)), absolute(p.z));
        const Lanes given = u.inputs.variance ? load(u.inputs.variance + n, count) : splat(1);
        const Flags is_number = (p.x == p.x) & (p.y == p.y) & (p.z == p.z);
        const Flags finite = exists(count) & is_number & (largest < INFINITE) & (given >= TINY) & (given < INFINITE);
        // Zeroed before any product: the square of 1e30 would be infinite.
        const Flags small = finite & (largest <= s.max_distance);
        p = {pick(small, p.x, splat(0)), pick(small, p.y, splat(0)), pick(small, p.z, splat(0))};
        const Lanes d2 = p.x * p.x + p.y * p.y + p.z * p.z;
        const Flags in_range = small & (d2 >= s.min_square) & (d2 <= s.max_square);
        const Vector<Lanes> relative = measurement::rotate<Lanes>(R, p.x, p.y, p.z);
        const Vector<Lanes> at{relative.x + origin[0], relative.y + origin[1], relative.z + origin[2]};
        const Flags casts = in_range & ~own(n, count, at);
        Flags used = s.has_ramp ? casts & ~measurement::above_ramp(relative, s) : casts;
        if (u.inputs.aside) used &= load_bytes(u.inputs.aside + n, count) == 0;
        const Lanes noise = u.inputs.variance ? pick(finite, given, splat(1)) : measurement::noise_of(d2, s);
        store(&m.x[n], at.x, count), store(&m.y[n], at.y, count), store(&m.z[n], at.z, count);
        store(&m.noise[n], noise, count);
        if (covariance)
            store(&m.of_pose[n], measurement::project_covariance(covariance, relative.x, relative.y), count);
        store_bytes(&m.casts[n], casts & 1, count), store_bytes(&m.used[n], used & 1, count);
        counts.finite += count_set(finite), counts.in_range += count_set(in_range);
        counts.casts += count_set(casts), counts.used += count_set(used);
    }

  private:
    template <class Count> Vector<Lanes> read(int64_t place, Count count) const {
        float x[LANES]{}, y[LANES]{}, z[LANES]{};
        const float* xyz = u.inputs.points + place;
        for (int l = 0; l < count; l++) x[l] = xyz[3 * l], y[l] = xyz[3 * l + 1], z[l] = xyz[3 * l + 2];
        return {load(x), load(y), load(z)};
    }

    template <class Count> static Flags exists(Count count) {
        Flags flags;
        for (int l = 0; l < LANES; l++) flags[l] = l < count ? -1 : 0;
        return flags;
    }

    // Which points, at places of the map [m], lie on the robot.
    template <class Count> Flags own(int64_t n, Count count, const Vector<Lanes>& at) const {
        const Measurement& m = u.measurement;
        if (u.inputs.own) return load_bytes(u.inputs.own + n, count) > 0;
        if (!s.has_box || !m.has_base) return Flags{};
        const Lanes x = at.x - m.base[0], y = at.y - m.base[1], z = at.z - m.base[2];
        return measurement::inside_body(measurement::rotate<Lanes>(to_base, x, y, z), s);
    }
};

// Where the measurement counts from, and the base: `anchor_of`, `relative_to`, `nan_where_unsound`.
void place(Update& u, bool sound, Sensor& sensor) {
    const MeasureSettings& s = u.settings.measure;
    Measurement& m = u.measurement;
    m.has_base = u.inputs.T_map_base, m.moves = m.has_base && sound;
    const double* followed = m.has_base ? u.inputs.T_map_base : u.inputs.T_map_sensor;
    Pose base(followed, sound);
    for (int k = 0; k < 2; k++) m.anchor[k] = int64_t(std::floor(base.position[k] / s.resolution));
    base.put_relative(m.anchor, s.resolution, m.base);
    base.transpose();
    std::copy_n(base.R, 9, sensor.to_base);
}

Counts measure_sensor(const Update& u, const Sensor& sensor) {
    std::atomic<int64_t> finite{0}, in_range{0}, casts{0}, used{0};
    const int64_t groups = u.sizes.N / LANES;
    u.each(groups, AT_A_TIME / LANES, [&](int64_t, int64_t first, int64_t last) {
        Counts own;
        for (int64_t g = first; g < last; g++) sensor.measure(g * LANES, std::integral_constant<int, LANES>(), own);
        if (last == groups && u.sizes.N > groups * LANES)
            sensor.measure(groups * LANES, int(u.sizes.N - groups * LANES), own);
        finite += own.finite, in_range += own.in_range, casts += own.casts, used += own.used;
    });
    return {finite, in_range, casts, used};
}

}  // namespace

extern "C" void run_measure(Update& u) {
    const MeasureSettings& s = u.settings.measure;
    Measurement& m = u.measurement;
    m.sensors = u.sizes.S, m.number = u.sizes.S * u.sizes.N, m.is_located = false;
    m.has_covariance = u.inputs.pose_covariance;
    for (Buffer<float>* buffer : {&m.x, &m.y, &m.z, &m.noise}) buffer->resize(m.number);
    if (m.has_covariance) m.of_pose.resize(m.number);
    m.used.resize(m.number), m.casts.resize(m.number), m.origin.resize(3 * m.sensors);
    const bool sound = is_near(u.inputs.T_map_sensor, m.sensors, s.farthest) &&
                       is_near(u.inputs.T_map_base, 1, s.farthest) &&
                       is_near(u.inputs.T_base_links, u.sizes.K, s.farthest);
    Sensor sensor{u, s, 0, sound, {}, {}, {}, nullptr};
    place(u, sound, sensor);
    for (int row = 0; m.has_covariance && row < 3; row++)
        std::copy_n(u.inputs.pose_covariance + 6 * row, 3, m.pose_covariance + 3 * row);
    const float dt = *u.inputs.dt;
    m.dt = dt > 0 && dt < INFINITE ? dt : 0;
    m.counts = {};
    for (int64_t k = 0; k < m.sensors; k++) {
        const Pose pose(u.inputs.T_map_sensor + 16 * k, sound);
        std::copy_n(pose.R, 9, sensor.R);
        pose.put_relative(m.anchor, s.resolution, &m.origin[3 * k]);
        std::copy_n(&m.origin[3 * k], 3, sensor.origin);
        sensor.first = k * u.sizes.N;
        sensor.covariance = m.has_covariance ? u.inputs.pose_covariance + 36 * k : nullptr;
        const Counts counts = measure_sensor(u, sensor);
        m.counts.finite += counts.finite, m.counts.in_range += counts.in_range;
        m.counts.casts += counts.casts, m.counts.used += counts.used;
    }
    if (!sound) {
        m.counts = {};
        std::fill_n(m.used.data(), m.number, uint8_t(0)), std::fill_n(m.casts.data(), m.number, uint8_t(0));
    }
}

// Set the statistics to zero, and to what the gates rejected; `disagreement` and `drift_correction` are carried on.
extern "C" void run_reset_statistics(Update& u) {
    const Statistics& to = u.state.statistics;
    const Measurement& m = u.measurement;
    for (int64_t* number : {to.points_used, to.rejected_outside, to.rejected_outlier, to.rejected_edge, to.drift_points,
                            to.cleared_seen_through, to.cleared_other_floors, to.cells_bounded})
        *number = 0;
    *to.drift_error = 0;
    *to.rejected_invalid = m.number - m.counts.finite, *to.rejected_range = m.counts.finite - m.counts.in_range;
    *to.rejected_body = m.counts.in_range - m.counts.casts, *to.rejected_overhang = m.counts.casts - m.counts.used;
}
