// Walls and steps within a cell, and what stands around it: edges.py and `look_around` of challenge.py.
#pragma once

#include "stages/fusion/cell.h"

namespace fusion {

// Heights of points above `base`, or below it for sign = -1.
struct Heights {
    float base, sign;
    INLINE float z(const Point<float>& q) const { return sign * (q.z - base); }
};

// The highest level that `number` points reach, give or take a standard deviation: `level_reached`.
template <class Points> INLINE float level_reached(const Points& points, const Heights& heights, int number) {
    auto reached = [&](const Point<float>& q) { return heights.z(q) + root(q.spread); };
    float level = NONE;
    points.each([&](const Point<float>& q) { level = larger(level, reached(q)); });
    level = points.highest(level);
    for (int round = 1; round < number; round++) {
        float next = NONE, at_level = 0;
        points.each([&](const Point<float>& q) {
            const float own = reached(q);
            at_level += own >= level;
            if (own < level) next = larger(next, own);
        });
        points.add_up(at_level);
        next = points.highest(next);
        if (at_level < number) level = next;
    }
    return level;
}

// The height of the step's top [m]: `top_of_step`.
template <class Points>
INLINE float top_of_step(const Points& points, const Heights& heights, int rounds, const FusionSettings& s) {
    const float highest = level_reached(points, heights, s.min_extreme);
    float height = 0;
    for (int round = 0; round < rounds; round++) {
        float moment = 0, total = 0;
        points.each([&](const Point<float>& q) {
            const float z = heights.z(q);
            if (z + s.margin * root(q.spread) >= height) moment += q.weight * z, total += q.weight;
        });
        points.add_up(moment, total);
        const float mean = moment / total;  // NaN where no point lies past the height, which compares as false
        if (highest >= mean) height = mean;
    }
    return height;
}

// A map before the scan, to look at beside a cell. `InScan` returns the mean of a cell's points [m], NO_HEIGHT without.
template <class InScan> struct Around {
    int32_t rows, columns;
    const float *elevation, *support;
    const uint8_t *known, *challenger_support;
    InScan in_scan;

    // Call `look(slot, di, dj)` for each of the eight neighbours that lie on the map.
    template <class Look> INLINE void each(int64_t slot, const Look& look) const {
        const int32_t i = int32_t(slot) / columns, j = int32_t(slot) % columns;
        for (int di = -1; di <= 1; di++)
            for (int dj = -1; dj <= 1; dj++) {
                const bool exists = i + di >= 0 && i + di < rows && j + dj >= 0 && j + dj < columns;
                if (exists && (di || dj)) look(slot + di * columns + dj, di, dj);
            }
    }
};

// Count the challengers in the 3 x 3 window, and find its highest settled elevation: `look_around`.
template <class InScan>
INLINE Neighbours look_around(const Around<InScan>& around, int64_t slot, const FusionSettings& s) {
    Neighbours found{0, NO_HEIGHT};
    auto look = [&](int64_t other, int, int) {
        found.challengers += around.challenger_support[other] > 0;
        const bool is_settled = around.known[other] && around.support[other] >= 0.5f * s.max_support;
        if (is_settled) found.settled = larger(found.settled, around.elevation[other]);
    };
    look(slot, 0, 0);
    around.each(slot, look);
    return found;
}

struct Side {
    float side, height;  // +1 top, -1 ground; [m] above the mean
};

// Which side of a step is the cell's: `side_of_step`.
template <class Points, class InScan>
INLINE Side side_of_step(const Points& points, float mean, int64_t slot, const Around<InScan>& around,
                         const FusionSettings& s) {
    const float top = top_of_step(points, Heights{mean, 1}, s.refinements, s);
    float low = 0, passed = 0, x = 0, y = 0;
    points.each_ray([&](const Point<float>& q, float ray_x, float ray_y, bool passes) {
        const bool is_low = q.z - mean < 0;
        low += is_low, passed += is_low && passes;
        x += ray_x, y += ray_y;
    });
    points.add_up(low, passed, x, y);
    const Side is_top{1, top};
    if (!(passed > s.min_passed * low)) return is_top;
    const float middle = mean + 0.5f * top, top_height = mean + top - s.relief;
    bool has_top_beside = false;
    around.each(slot, [&](int64_t other, int di, int dj) {
        if (has_top_beside) return;
        const bool stands = around.known[other] && around.elevation[other] >= top_height;
        has_top_beside = (stands && lies_behind(x, y, di, dj)) || around.in_scan(other) >= middle;
    });
    return has_top_beside ? Side{-1, -top_of_step(points, Heights{mean, -1}, 2, s)} : is_top;
}

}  // namespace fusion
