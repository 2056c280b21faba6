// From sensors' points to measurements, on a GPU: stage.py.

#include "kernels/cuda/update.h"
#include "stages/measure/equation.h"

using measurement::Vector;

// Whether `number` poses may become cell numbers; NaN may not: `is_near`.
inline bool is_near(const double* poses, int64_t number, float farthest) {
    for (int64_t k = 0; poses && k < 16 * number; k++)
        if (!(fabs(poses[k]) <= double(farthest))) return false;
    return true;
}

// A position (x, y and z in the last column of a pose) with x and y counted from the anchor: `relative_to`.
inline void put_relative(const double* T, bool sound, const int64_t* anchor, double resolution, float* out) {
    for (int k = 0; k < 3; k++) {
        const double position = sound ? T[4 * k + 3] : 0.0;
        out[k] = float(position - (k < 2 ? double(anchor[k]) * resolution : 0.0));
    }
}

// Find where each map's measurement counts from, its sensors and its base. A thread for each map.
extern "C" __global__ void place_measurement(Update u) {
    const int64_t b = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (b >= u.sizes.B) return;
    const MeasureSettings& s = u.settings.measure;
    const Inputs in = u.inputs.at(b, u.sizes);
    const Scratch to = u.scratch.at(b, u.sizes);
    const bool sound = is_near(in.T_map_sensor, u.sizes.S, s.farthest) && is_near(in.T_map_base, 1, s.farthest) &&
                       is_near(in.T_base_links, u.sizes.K, s.farthest);
    const double* followed = in.T_map_base ? in.T_map_base : in.T_map_sensor;
    for (int k = 0; k < 2; k++)
        to.anchor[k] = int64_t(floor((sound ? followed[4 * k + 3] : 0.0) / s.resolution));
    put_relative(followed, sound, to.anchor, s.resolution, to.base);
    for (int64_t k = 0; k < u.sizes.S; k++)
        put_relative(in.T_map_sensor + 16 * k, sound, to.anchor, s.resolution, to.origin + 3 * k);
    *to.sound = sound;
    const float dt = *in.dt;
    *to.dt = dt > 0 && dt < 3e38f ? dt : 0;
    for (int k = 0; k < 4; k++) to.gated[k] = 0;
}

// R p of a pose's rotation, or of its inverse.
inline Vector<float> turn(const double* T, bool inverse, float x, float y, float z) {
    float R[9];
    for (int row = 0; row < 3; row++)
        for (int k = 0; k < 3; k++) R[3 * row + k] = float(inverse ? T[4 * k + row] : T[4 * row + k]);
    return measurement::rotate(R, x, y, z);
}

// Measure each point. A thread for each.
extern "C" __global__ void measure_points(Update u) {
    const Place at = place(u.sizes.M);
    const MeasureSettings& s = u.settings.measure;
    const Inputs in = u.inputs.at(at.row, u.sizes);
    const Scratch to = u.scratch.at(at.row, u.sizes);
    bool finite = false, in_range = false, casts = false, used = false;
    if (at.k < u.sizes.M) {
        const int64_t k = at.k, sensor = k / u.sizes.N;
        const double* T = in.T_map_sensor + 16 * sensor;
        float x = in.points[3 * k], y = in.points[3 * k + 1], z = in.points[3 * k + 2];
        const float given = in.variance ? in.variance[k] : 1.0f;
        const float largest = larger(larger(absolute(x), absolute(y)), absolute(z));
        finite = *to.sound && x == x && y == y && z == z && largest <= 3.4028234e38f &&
                 given >= 1.17549435e-38f && given <= 3.4028234e38f;
        const bool small = finite && largest <= s.max_distance;
        x = small ? x : 0, y = small ? y : 0, z = small ? z : 0;
        const float d2 = x * x + y * y + z * z;
        in_range = small && d2 >= s.min_square && d2 <= s.max_square;
        const float* origin = to.origin + 3 * sensor;
        Vector<float> relative = *to.sound ? turn(T, false, x, y, z) : Vector<float>{0, 0, 0};
        const Vector<float> p{relative.x + origin[0], relative.y + origin[1], relative.z + origin[2]};
        bool own = in.own && in.own[k];
        if (!in.own && s.has_box && in.T_map_base && in_range)
            own = measurement::inside_body(
                turn(in.T_map_base, true, p.x - to.base[0], p.y - to.base[1], p.z - to.base[2]), s);
        casts = in_range && !own, used = casts && !(s.has_ramp && measurement::above_ramp(relative, s));
        used = used && !(in.aside && in.aside[k]);
        to.x[k] = p.x, to.y[k] = p.y, to.z[k] = p.z;
        to.noise[k] = !in.variance ? measurement::noise_of(d2, s) : finite ? given : 1.0f;
        to.of_pose[k] = !in.pose_covariance ? 0
                            : measurement::project_covariance(in.pose_covariance + 36 * sensor, relative.x, relative.y);
        to.casts[k] = casts, to.used[k] = used;
    }
    add_of_warp(to.gated + 0, finite), add_of_warp(to.gated + 1, in_range);
    add_of_warp(to.gated + 2, casts), add_of_warp(to.gated + 3, used);
}

// Set the statistics to zero, and to what the gates rejected. A thread for each map.
extern "C" __global__ void reset_statistics(Update u) {
    const int64_t b = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (b >= u.sizes.B) return;
    const Statistics to = u.state.statistics.at(b, u.sizes);
    const int64_t* gated = u.scratch.at(b, u.sizes).gated;
    int64_t* const zeros[] = {to.points_used,          to.rejected_outside,     to.rejected_outlier, to.rejected_edge,
                              to.drift_points,         to.cleared_seen_through, to.cleared_other_floors,
                              to.cells_bounded};
    for (int64_t* number : zeros) *number = 0;
    *to.drift_error = 0;
    *to.rejected_invalid = u.sizes.M - gated[0], *to.rejected_range = gated[0] - gated[1];
    *to.rejected_body = gated[1] - gated[2], *to.rejected_overhang = gated[2] - gated[3];
}
