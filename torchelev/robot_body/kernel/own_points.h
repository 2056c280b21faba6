// Which points lie on the robot's links: own_points.py and posing.py.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "kernels/simd.h"

namespace robot_body {

constexpr float TINY = 1e-12f;

// As `_packed` of own_kernel.py.
struct Capsule {
    float link, start[3], axis[3], squared, limit;  // [m] link frame; [m^2] of the length, and of radius with padding
};
struct Box {
    float link, center[3], rotation[9], half[3];  // [m] link frame; with padding
};

struct Body {
    const Capsule* capsules;
    const Box* boxes;
    int64_t num_capsules, num_boxes;
    float depth_tolerance;  // [m]
};

inline float dot(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// A rotation, its rows, and a position.
struct Pose {
    float R[9], t[3];

    explicit Pose(const double* T) {
        for (int row = 0; row < 3; row++) {
            for (int k = 0; k < 3; k++) R[3 * row + k] = float(T[4 * row + k]);
            t[row] = float(T[4 * row + 3]);
        }
    }
    void turn(const float* v, float* out) const {
        for (int row = 0; row < 3; row++) out[row] = dot(R + 3 * row, v);
    }
    void place(const float* v, float* out) const {
        turn(v, out);
        for (int row = 0; row < 3; row++) out[row] += t[row];
    }
};

// T_sensor_base from both poses in one frame, differenced in double precision: `relative_pose`.
inline Pose relative_pose(const double* T_map_sensor, const double* T_map_base) {
    double T[12];
    for (int i = 0; i < 3; i++) {
        const double column[] = {T_map_sensor[i], T_map_sensor[4 + i], T_map_sensor[8 + i]};
        for (int j = 0; j < 4; j++) {
            double other[3];
            for (int k = 0; k < 3; k++) other[k] = T_map_base[4 * k + j] - (j == 3 ? T_map_sensor[4 * k + 3] : 0);
            T[4 * i + j] = dot(column, other);
        }
    }
    return Pose(T);
}

// A capsule and a box as one sensor sees them: `PosedBody`.
struct PosedCapsule {
    float start[3], axis[3], start_start, start_axis, squared, limit;

    PosedCapsule(const Capsule& c, const Pose& base, const Pose& link) : squared(c.squared), limit(c.limit) {
        float in_base[3];
        link.place(c.start, in_base), base.place(in_base, start);
        link.turn(c.axis, in_base), base.turn(in_base, axis);
        start_start = dot(start, start), start_axis = dot(start, axis);
    }
};

struct PosedBox {
    float to_box[9], origin[3], half[3];

    PosedBox(const Box& b, const Pose& base, const Pose& link) {
        float in_base[3], in_sensor[3];
        for (int axis = 0; axis < 3; axis++) {
            const float column[] = {b.rotation[axis], b.rotation[3 + axis], b.rotation[6 + axis]};
            link.turn(column, in_base), base.turn(in_base, to_box + 3 * axis);
            half[axis] = b.half[axis];
        }
        link.place(b.center, in_base), base.place(in_base, in_sensor);
        for (int axis = 0; axis < 3; axis++) origin[axis] = -dot(to_box + 3 * axis, in_sensor);
    }
};

// Pieces of rays that begin at points: `_pieces_behind`.
struct Pieces {
    Lanes direction[3], near, far;

    Pieces(Lanes x, Lanes y, Lanes z, float length) {
        near = root(larger(x * x + y * y + z * z, splat(TINY))), far = near + length;
        const Lanes inverse = 1 / near;
        direction[0] = x * inverse, direction[1] = y * inverse, direction[2] = z * inverse;
    }
    Lanes along(const float* v) const { return direction[0] * v[0] + direction[1] * v[1] + direction[2] * v[2]; }
};

// Squared distance from a capsule's axis, less its squared radius: `_excess_of_capsule`.
inline Lanes excess(const Pieces& p, const PosedCapsule& c) {
    const Lanes on_start = p.along(c.start), on_axis = p.along(c.axis);
    const auto within = [&](Lanes t) { return smaller(larger(t, p.near), p.far); };
    if (!(c.squared > 0)) {
        const Lanes t = within(on_start);
        return t * (t - 2 * on_start) + c.start_start - c.limit;
    }
    Lanes v = clamp((on_start * on_axis - c.start_axis) / larger(c.squared - on_axis * on_axis, splat(TINY)), 0, 1);
    const Lanes t = within(on_start + v * on_axis);
    v = clamp((t * on_axis - c.start_axis) / c.squared, 0, 1);
    const Lanes distance2 =
        t * (t - 2 * (on_start + v * on_axis)) + c.start_start + v * (2 * c.start_axis + v * c.squared);
    return distance2 - c.limit;
}

// How far apart along the ray pieces and a box are: `_excess_of_box` and `cross_slabs`.
inline Lanes excess(const Pieces& p, const PosedBox& b) {
    Lanes enter = p.near, leave = p.far;
    for (int axis = 0; axis < 3; axis++) {
        const Lanes d = p.along(b.to_box + 3 * axis);
        const Lanes inverse = 1 / pick(absolute(d) < TINY, splat(TINY), d);
        const Lanes one = (-b.half[axis] - b.origin[axis]) * inverse, other = (b.half[axis] - b.origin[axis]) * inverse;
        enter = larger(enter, smaller(one, other)), leave = smaller(leave, larger(one, other));
    }
    return enter - leave;
}

// The links' shapes as sensors see them; keeps its memory.
struct Posed {
    std::vector<PosedCapsule> capsules;
    std::vector<PosedBox> boxes;

    void pose(const Body& body, const double* T_map_sensor, const double* T_map_base, const double* T_base_links) {
        const Pose base = relative_pose(T_map_sensor, T_map_base);
        capsules.clear(), boxes.clear();
        for (int64_t k = 0; k < body.num_capsules; k++)
            capsules.emplace_back(body.capsules[k], base, Pose(T_base_links + 16 * int64_t(body.capsules[k].link)));
        for (int64_t k = 0; k < body.num_boxes; k++)
            boxes.emplace_back(body.boxes[k], base, Pose(T_base_links + 16 * int64_t(body.boxes[k].link)));
    }

    // Mark those of points (N, 3) of the sensor's frame that lie on the robot.
    void find(const float* points, int64_t N, float depth_tolerance, uint8_t* own) const {
        for (int64_t first = 0; first < N; first += LANES) {
            float x[LANES]{}, y[LANES]{}, z[LANES]{};
            const int count = int(std::min<int64_t>(LANES, N - first));
            const float* xyz = points + 3 * first;
            for (int l = 0; l < count; l++) x[l] = xyz[3 * l], y[l] = xyz[3 * l + 1], z[l] = xyz[3 * l + 2];
            const Pieces pieces(load(x), load(y), load(z), depth_tolerance);
            Flags found{};
            for (const PosedCapsule& capsule : capsules) found |= excess(pieces, capsule) <= 0;
            for (const PosedBox& box : boxes) found |= excess(pieces, box) <= 0;
            store_bytes(own + first, found & 1, count);
        }
    }
};

}  // namespace robot_body
