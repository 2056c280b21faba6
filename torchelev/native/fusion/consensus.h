// The height that the points of a cell agree on: stages/fusion/{consensus,edges}.py. Include points_of_thread.h or
// points_of_warp.h first.
#pragma once

// The mean of the points, weighted [m].
inline float mean_height(const Points& p) {
    float weight = 0, moment = 0;
    for (const Point& point : p) weight += point.weight, moment += point.weight * point.z;
    p.add_up(weight, moment);
    return ratio(moment, weight);
}

// The mean of z - height, points far from zero reduced in weight.
inline float reduced_mean(const Points& p, float height) {
    float moment = 0, total = 0;
    for (const Point& point : p) {
        const float residual = point.z - height;
        const float reduced = point.weight / square(1.0f + square(residual) / point.spread);
        moment += reduced * residual, total += reduced;
    }
    p.add_up(moment, total);
    return ratio(moment, total);
}

// The height [m] from `base` on that the points reach: `robust_mean`.
inline float robust_mean(const Points& p, float base) {
    const float height = reduced_mean(p, base);
    return height + reduced_mean(p, base + height);
}

// Heights of the points above `base`, or below it for sign = -1.
struct Heights {
    const Points& p;
    float base, sign;
    float z(const Point& point) const { return sign * (point.z - base); }
};

// The highest level that `number` points reach, give or take a standard deviation: `level_reached`.
inline float level_reached(const Heights& heights, int number) {
    constexpr float NONE = -std::numeric_limits<float>::infinity();
    auto reached = [&](const Point& point) { return heights.z(point) + std::sqrt(point.spread); };
    float level = NONE;
    for (const Point& point : heights.p) level = std::max(level, reached(point));
    level = heights.p.highest(level);
    for (int round = 1; round < number; round++) {
        float next = NONE;
        int32_t at_level = 0;
        for (const Point& point : heights.p) {
            const float own = reached(point);
            at_level += own >= level;
            if (own < level) next = std::max(next, own);
        }
        heights.p.add_up(at_level);
        next = heights.p.highest(next);
        if (at_level < number) level = next;
    }
    return level;
}

// The step's top: `top_of_step`.
inline float top_of_step(const Heights& heights, int rounds, const Settings& s) {
    const float highest = level_reached(heights, s.min_extreme);
    float height = 0;
    for (int round = 0; round < rounds; round++) {
        float moment = 0, total = 0;
        for (const Point& point : heights.p) {
            const float z = heights.z(point);
            if (z + s.margin * std::sqrt(point.spread) < height) continue;
            moment += point.weight * z, total += point.weight;
        }
        heights.p.add_up(moment, total);
        const float mean = moment / total;  // NaN where no point lies past the height, which compares as false
        if (highest >= mean) height = mean;
    }
    return height;
}

// The heights of a map before the scan and of the scan itself, to look at beside a cell.
struct Around {
    int64_t rows, columns;
    const float *elevation, *in_scan;  // `in_scan` is NO_HEIGHT without points
    const uint8_t* known;

    // Call `look(slot, di, dj)` for each of the eight neighbours that lie on the map.
    template <class Look> void each(int64_t slot, const Look& look) const {
        const int32_t i = int32_t(slot) / int32_t(columns), j = int32_t(slot) % int32_t(columns);  // fast on a GPU
        for (int di = -1; di <= 1; di++)
            for (int dj = -1; dj <= 1; dj++) {
                const bool exists = i + di >= 0 && i + di < rows && j + dj >= 0 && j + dj < columns;
                if (exists && (di || dj)) look(slot + di * columns + dj, di, dj);
            }
    }
};

struct Side {
    float side, height;  // +1 top, -1 ground; [m] above the mean
};

// Whether a neighbour lies behind a cell, within 50 degrees of where its rays go: `lie_behind`.
inline bool lies_behind(float x, float y, int di, int dj) {
    const float limit = 0.64278760968653936f * std::sqrt(float(di * di + dj * dj));  // cos(50 degrees)
    return x * di + y * dj > limit * std::sqrt(x * x + y * y);
}

// Tell which side of a step is the cell's: `side_of_step`.
inline Side side_of_step(const Points& p, float mean, int64_t slot, const Around& around, const Settings& s) {
    const float top = top_of_step({p, mean, 1}, s.refinements, s), bottom = -top_of_step({p, mean, -1}, 2, s);
    float low = 0, passed = 0, x = 0, y = 0;
    for (const Point& point : p) {
        const bool is_low = point.z - mean < 0;
        low += is_low, passed += is_low && point.passed;
        x += point.ray_x, y += point.ray_y;
    }
    p.add_up(low, passed, x, y);
    const float middle = mean + 0.5f * top, top_height = mean + top - s.relief;
    bool elsewhere = false;
    around.each(slot, [&](int64_t other, int di, int dj) {
        const bool stands = around.known[other] && around.elevation[other] >= top_height;
        elsewhere |= around.in_scan[other] >= middle || (stands && lies_behind(x, y, di, dj));
    });
    const bool is_ground = passed > s.min_passed * low && elsewhere;
    return is_ground ? Side{-1, bottom} : Side{1, top};
}

// Whether a cell holds a step, by the number of its points and of those far from the estimate: `EdgeConfig.has_step`.
inline bool has_step(float number, float far, const Settings& s) {
    return s.has_edges && number >= s.min_points && far >= s.min_share * number;
}

// The height of a contested cell, and the side of its step, 0 without: `resolve_contested`.
inline Side resolve(const Points& p, float mean, bool is_step, int64_t slot, const Around& around, const Settings& s) {
    const float settled = robust_mean(p, mean);
    float far = 0;
    for (const Point& point : p) far += square(point.z - mean - settled) > square(s.gate) * point.spread;
    p.add_up(far);
    Side side{0, settled};
    if (is_step || has_step(p.number, far, s)) side = side_of_step(p, mean, slot, around, s);
    return {side.side, mean + side.height};
}
