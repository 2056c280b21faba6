// Where the points of an update lie in the window: stages/measure of the maps, for what follows their updates. `Update`
// has the inputs of one, and the corners of the windows.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

namespace places {

constexpr int64_t FAR = int64_t(1) << 22;  // [cells] whole numbers up to it fit a float
constexpr float INFINITE = std::numeric_limits<float>::infinity(), TINY = std::numeric_limits<float>::min();

// Where the points of an update count from, as in `measure`: the cell below the base, or below the first sensor.
struct Origin {
    int64_t anchor[2];
    float base[3], to_base[9];  // [m] from the anchor's corner; rows of the inverse rotation
    bool has_base, is_sound = true;

    template <class Update> Origin(const Update& u, int64_t b) : base{}, to_base{}, has_base(u.T_map_base) {
        const double* T = has_base ? u.T_map_base + 16 * b : u.T_map_sensor + 16 * b * u.S;
        for (int n = 0; n < 12; n++) is_sound &= std::isfinite(T[n]);
        for (int axis = 0; axis < 2; axis++)
            anchor[axis] = is_sound ? int64_t(std::floor(T[4 * axis + 3] / u.resolution)) : 0;
        for (int row = 0; is_sound && row < 3; row++) {
            base[row] = relative(T, row, u.resolution);
            for (int k = 0; k < 3; k++) to_base[3 * k + row] = float(T[4 * row + k]);
        }
    }
    // A coordinate of a pose's position [m], of x and y from the anchor's corner.
    float relative(const double* T, int row, double resolution) const {
        return float(T[4 * row + 3] - (row < 2 ? double(anchor[row]) * resolution : 0));
    }
};

// Where a sensor's points lie in the window, and how much they count.
struct Frame {
    float R[9], t[3], first[2], resolution, H, W, noise_factor, noise_floor, nearest2, farthest2;
    int32_t width;
    Origin origin;

    template <class Update> Frame(const Update& u, int64_t b, const double* T, const Origin& origin)
        : resolution(float(u.resolution)), H(float(u.H)), W(float(u.W)), noise_factor(u.noise_factor),
          noise_floor(u.noise_floor), nearest2(u.min_distance * u.min_distance),
          farthest2(u.max_distance * u.max_distance), width(int32_t(u.W)), origin(origin) {
        for (int row = 0; row < 3; row++) {
            for (int k = 0; k < 3; k++) R[3 * row + k] = float(T[4 * row + k]);
            t[row] = origin.relative(T, row, u.resolution);
        }
        for (int axis = 0; axis < 2; axis++)
            first[axis] = float(std::clamp(origin.anchor[axis] - u.corner[2 * b + axis], -FAR, FAR));
    }

    // Find the place of a point [m], its cell, -1 out of the window, and sigma^2 [m^2].
    void place(float x, float y, float z, float& ax, float& ay, float& az, int32_t& cell, float& noise) const {
        const float d2 = x * x + y * y + z * z;
        ax = R[0] * x + R[1] * y + R[2] * z + t[0];
        ay = R[3] * x + R[4] * y + R[5] * z + t[1];
        az = R[6] * x + R[7] * y + R[8] * z + t[2];
        // As `Window::slot`: a point on the border of two cells belongs to that whose height it measures.
        const float i = std::floor(ax / resolution) + first[0], j = std::floor(ay / resolution) + first[1];
        const bool inside = (d2 >= nearest2) & (d2 <= farthest2) & (d2 < INFINITE) & (i >= 0) & (i < H) & (j >= 0) & (j < W);
        cell = inside ? int32_t(inside ? i : 0) * width + int32_t(inside ? j : 0) : -1;
        noise = noise_factor * d2 + noise_floor;
    }

    // Return whether a place [m] lies above the exclusion ramp: `above_ramp`.
    bool is_above(float x, float y, float z, const float* ramp) const {
        x -= t[0], y -= t[1], z -= t[2];
        const float r = std::sqrt(std::max(x * x + y * y, 1e-12f));
        return z > std::min(std::max(r - ramp[1], 0.0f) * ramp[0] + ramp[2], ramp[3]);
    }

    // Return whether a place [m] lies in the robot's box.
    bool is_inside(float x, float y, float z, const float* box) const {
        x -= origin.base[0], y -= origin.base[1], z -= origin.base[2];
        bool inside = true;
        for (int axis = 0; axis < 3; axis++) {
            const float* turn = origin.to_base + 3 * axis;
            const float c = turn[0] * x + turn[1] * y + turn[2] * z;
            inside &= (c >= box[axis]) & (c <= box[3 + axis]);
        }
        return inside;
    }
};

}  // namespace places
