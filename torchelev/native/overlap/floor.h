// The ground and the floor of a robot: stages/overlap/clear.py. Heights [m] count from its base's.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>

// `OverlapConfig`, and which rows and columns may lie within the radius: C++ looks at no others.
struct Settings {
    float radius_square, slope, height, base_height, max_base_height;
    int32_t first_row, end_row, first_column, end_column;
};

// A sum of weights, and of heights times their weights.
struct Total {
    float weight, moment;

    float mean() const { return moment / std::max(weight, 1e-12f); }
};

// The height of the ground, by the cells below the base: the weight of all, and the heights of those within reach of a
// standing robot and of those just hit.
inline float ground_of(float weight, Total within, Total hit, const Settings& s) {
    const bool is_most = within.weight > 0.5f * weight;
    const bool is_level = hit.weight == 0 || hit.mean() <= within.mean() + 0.5f * s.height;
    return is_most && is_level ? within.mean() : hit.mean();
}

// The heights that belong to the robot's floor: `own_floor`.
struct Floor {
    float lower, upper;

    Floor(float ground, const Settings& s) {
        const bool flies = ground < -s.max_base_height;
        const float robot = flies ? 0.0f : std::min(ground + s.base_height, 0.0f);
        lower = flies ? -std::numeric_limits<float>::infinity() : robot - s.height;
        upper = std::max(robot + s.height, 0.0f);
    }
    template <class Heights> auto is_outside(Heights height, Heights allowance) const {
        return (height < lower - allowance) | (height > upper + allowance);
    }
};
