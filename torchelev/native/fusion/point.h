// A point of the scan, as the height update needs it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

constexpr float NO_HEIGHT = -1e30f;  // [m] below all heights
constexpr float TINY = std::numeric_limits<float>::min();

inline float ratio(float numerator, float denominator) { return numerator / std::max(denominator, TINY); }
inline float square(float value) { return value * value; }

// Settings of the update, as stages/fusion/native.py fills them in.
struct Settings {
    float resolution, relief;  // [m]
    float gate, max_gate_std, floor, outlier_variance, max_support, max_variance;
    int32_t min_above, max_above_per_scan, min_challengers, has_rays, has_edges;
    int32_t min_points, min_extreme, refinements;
    float min_share, min_passed, margin, min_settled;
};

#ifdef __CUDACC__
struct alignas(16) Point {
    float z, spread, weight, shared, ray_x, ray_y;  // see `ScanPoints`
    int32_t passed, filler;  // of 32 bytes that a GPU writes whole: it reads what it writes in part
};
#else
struct Point {
    float z, spread, weight, shared, ray_x, ray_y;  // see `ScanPoints`
    bool passed;
};
#endif

// Whether a ray passed over the middle of its cell before it hit: `passed_center`.
inline bool passed_center(float x, float y, float ray_x, float ray_y, float resolution) {
    const float from_x = x - (std::floor(x / resolution) + 0.5f) * resolution;
    const float from_y = y - (std::floor(y / resolution) + 0.5f) * resolution;
    return from_x * ray_x + from_y * ray_y > std::fabs(from_x * ray_y - from_y * ray_x);
}

// A point as the update needs it.
inline Point make_point(const float* xyz, const float* origin, float noise, float shared, const Settings& s) {
    const float ray_x = xyz[0] - origin[0], ray_y = xyz[1] - origin[1];
    const bool passed = passed_center(xyz[0], xyz[1], ray_x, ray_y, s.resolution);
    return {xyz[2], noise + square(s.relief) + shared, 1.0f / noise, shared, ray_x, ray_y, passed};
}
