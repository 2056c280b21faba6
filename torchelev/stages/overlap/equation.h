// The ground and the floor of a robot: stage.py, with the same names. Heights [m] count from its base's.
#pragma once

#include <limits>

#include "kernels/scalar.h"

namespace overlap {

// Weight of a cell in `ground_below`, by the square of its distance [m^2].
template <class V> INLINE V weight_of(V square_distance, const OverlapSettings& s) {
    return 1 / square(square_distance + s.stance_square);
}

// A sum of weights, and of heights times their weights: `weighted_mean`.
struct Total {
    float weight, moment;

    INLINE float mean() const { return moment / larger(weight, 1e-12f); }
};

// Height of the ground by the cells below the base: the weight of all, and the totals of those within reach of a
// standing robot and of those just hit.
INLINE float ground_below(float weight, Total within, Total hit, const OverlapSettings& s) {
    const bool is_most = within.weight > 0.5f * weight;
    const bool is_level = hit.weight == 0 || hit.mean() <= within.mean() + 0.5f * s.height;
    return is_most && is_level ? within.mean() : hit.mean();
}

// The heights that belong to the robot's floor.
struct Floor {
    float lower, upper;
};

INLINE Floor own_floor(float ground, const OverlapSettings& s) {
    const bool flies = ground < -s.max_base_height;
    const float robot = flies ? 0 : smaller(ground + s.base_height, 0);
    return {flies ? -std::numeric_limits<float>::infinity() : robot - s.height, larger(robot + s.height, 0)};
}

// Height [m] by which a cell that was just hit may differ more: a slope is no other floor.
template <class V> INLINE V allowance(V square_distance, const OverlapSettings& s) {
    return root(square_distance) * s.slope;
}

template <class V> INLINE auto is_outside(V height, const Floor& floor, V allowance) {
    return (height < floor.lower - allowance) | (height > floor.upper + allowance);
}

}  // namespace overlap
