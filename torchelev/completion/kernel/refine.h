// The ground at measured cells: refine.py.
#pragma once

#include "squares.h"

// Refine the measured cells of a row; others become arbitrary.
inline void refine(const Weights& weights, const Map& map, const Squares& of_rows, int i) {
    const Lanes usual = log(splat(float(map.resolution) / USUAL));
    for (int j = 0; j < map.W; j += LANES) {
        const int count = std::min(LANES, map.W - j), place = i * map.W + j;
        const float* here = &map.ground[map.index(i, j)];
        const Lanes center = load(here);
        const Flags known = center < UNKNOWN;
        if (!any(known)) continue;
        const Lanes height = pick(known, center, splat(0));
        Lanes pairs{}, bend{}, rough{}, tilt{};
        auto add = [&](int to) {
            const Lanes ahead = load(here + to), behind = load(here - to);
            const Flags both = (ahead < UNKNOWN) & (behind < UNKNOWN) & known;
            const Lanes bent = pick(both, 0.5f * ((ahead - height) + (behind - height)), splat(0));
            pairs += one_if(both), bend += bent, rough += absolute(bent);
            tilt += pick(both, absolute(ahead - behind), splat(0));
        };
        for (int to : {map.stride + 1, map.stride, map.stride - 1, 1}) add(to);
        const Lanes per_pair = 1 / larger(pairs, splat(1));
        bend *= per_pair, rough *= per_pair, tilt *= per_pair;
        const Lanes variance = pick(known, load(map.layers.variance + place, count), splat(0));
        const Lanes age = pick(known, load(map.layers.age + place, count), splat(0));
        const Lanes sigma = root(larger(variance, splat(MIN_STD * MIN_STD)));
        Lanes features[NUM_MEASURED][1] = {{log(sigma)}, {absolute(bend) / (absolute(bend) + sigma)},
                                           {squash(rough, SMALL_STEP)}, {squash(tilt, SQUASH)}, {pairs * 0.25f},
                                           {log(1 + clamp(age, 0, LONG_AGO))}, {usual}};
        auto read = [&](const std::vector<float>& values) { return load(&values[of_rows.index(i, j)]); };
        Lanes squares[NUM_RADII];
        for (int r = 0; r < NUM_RADII; r++) squares[r] = read(of_rows.mean[r]) + map.above(height);
        write_features(of_rows, squares, read, features + NUM_CLOSE, 0);
        Lanes channels[MEASURED][1], answer[2][1];
        hidden<MEASURED, NUM_MEASURED>(weights.measured, weights.measured_bias, features, channels);
        affine<2, MEASURED>(weights.measured_answer, weights.measured_answer_bias, channels, answer);
        const Lanes twice = 2 * sigma;
        const Lanes extra = exp(2 * clamp(answer[1][0], -10, 2));
        store(map.layers.mean + place, height + twice * tanh(sigmoid(answer[0][0]) * bend / twice), count);
        store(map.layers.std + place, root(sigma * sigma + extra) * std::exp(weights.calibration[1]), count);
    }
}
