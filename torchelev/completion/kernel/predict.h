// The ground at unknown cells: predict.py.
#pragma once

#include "squares.h"

constexpr int GROUPS = 2;  // of cells at a time: one alone would leave the processor waiting for results
constexpr int NUM_COLUMNS = GROUPS * NUM_DIRECTIONS;

struct Answer {
    Lanes mean, std;  // [m]
};

// What the answer at LANES cells is made of. Heights [m] count from the mean of those around each cell.
struct Scene {
    Surroundings around;
    Lanes has_any, is_bounded, reach, nearest;
    Lanes base, low, high, bound;  // `base`, that mean itself, is absolute
    Lanes candidates[NUM_CANDIDATES][NUM_DIRECTIONS], exists[NUM_CANDIDATES][NUM_DIRECTIONS];
    Lanes squares[NUM_RADII], has_square[NUM_RADII];
};

// Write the features of each direction into columns from `first` on, and the heights that it proposes.
inline void view(Scene& scene, const Lanes* near, const Lanes* distance, const Lanes* height,
                 Lanes (*features)[NUM_COLUMNS], int first) {
    const Surroundings& around = scene.around;
    Lanes across;
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        const int o = d ^ 1;
        const Lanes known = around.known[d], both = known * around.known[o];
        if (d < o) across = both / larger(distance[d] + distance[o], splat(1e-6f));
        const Lanes share = distance[o] * across;
        const Lanes step = (height[o] - height[d]) * both;
        scene.candidates[0][d] = height[d], scene.exists[0][d] = known;
        scene.candidates[1][d] = height[d] + (1 - share) * step, scene.exists[1][d] = both;
        const Lanes values[] = {known, near[d], log(1 + distance[d] * (1 / NEAR_STEP)), squash(height[d], SQUASH),
                                squash(height[d] - scene.low, SQUASH) * known, both, share, squash(step, SQUASH)};
        for (int k = 0; k < 8; k++) features[k][first + d] = values[k];
        for (int r = 0; r < NUM_REACHES; r++) {
            const Lanes slope = clamp(around.slope[r][d], -STEEPEST, STEEPEST);
            scene.candidates[2 + r][d] = height[d] + slope * distance[d];
            scene.exists[2 + r][d] = around.has_slope[r][d];
            features[8 + r][first + d] = around.has_slope[r][d], features[8 + NUM_REACHES + r][first + d] = slope;
        }
    }
}

// Fill the scene of group g, and write the features of its directions and of its cells.
inline void look(const Map& map, const Squares& of_rows, const Cells& cells, int g, Scene& scene,
                 Lanes (*views)[NUM_COLUMNS], Lanes (*features)[GROUPS]) {
    Surroundings& around = scene.around;
    look_around(map, cells, around);
    const Flags in_map = cells.row * map.W + cells.column, has_bound = gather(map.layers.bounded, in_map) > 0;
    const Lanes upper_bound = pick(has_bound, gather(map.layers.upper_bound, in_map), splat(0));
    scene.is_bounded = one_if(has_bound);

    // Heights from the mean of those around each cell, in which nearer ones count more.
    Lanes has_any{}, lowest = splat(NOWHERE), reach = splat(NOWHERE);
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        const Flags is_known = around.known[d] > 0;
        has_any = larger(has_any, around.known[d]);
        lowest = smaller(lowest, pick(is_known, around.height[d], splat(NOWHERE)));
        reach = smaller(reach, pick(is_known, around.distance[d], splat(NOWHERE)));
    }
    lowest = pick(has_any > 0, lowest, splat(float(map.level)));
    const Lanes nearest = smaller(reach, splat(FARTHEST));
    Lanes distance[NUM_DIRECTIONS], near[NUM_DIRECTIONS], height[NUM_DIRECTIONS], sum{}, total{};
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        distance[d] = smaller(around.distance[d], splat(FARTHEST));
        near[d] = nearest / larger(distance[d], splat(1e-6f)) * around.known[d];
        height[d] = (around.height[d] - lowest) * around.known[d];
        sum += near[d] * height[d], total += near[d];
    }
    const Lanes mean = sum / larger(total, splat(1e-6f)), low = -mean;
    Lanes high = splat(-NOWHERE);
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        height[d] = (height[d] - mean) * around.known[d];
        high = larger(high, pick(around.known[d] > 0, height[d], splat(-NOWHERE)));
    }
    high = pick(has_any > 0, high, splat(0));
    scene.has_any = has_any, scene.reach = reach, scene.nearest = nearest;
    scene.base = lowest + mean, scene.low = low, scene.high = high;
    scene.bound = (upper_bound - lowest - mean) * scene.is_bounded;
    const Flags place = of_rows.index(cells.row, cells.column);
    auto read = [&](const std::vector<float>& values) { return cells.read(values.data(), place); };
    for (int r = 0; r < NUM_RADII; r++) {
        scene.has_square[r] = one_if(read(of_rows.known[r]) > 0);
        scene.squares[r] = (read(of_rows.mean[r]) + map.above(lowest) - mean) * scene.has_square[r];
    }
    view(scene, near, distance, height, views, g * NUM_DIRECTIONS);

    Lanes num_known{};
    for (const Lanes& known : around.known) num_known += known;
    const Lanes usual = splat(float(map.resolution) / USUAL), bound = scene.bound, is_bounded = scene.is_bounded;
    for (Lanes value : {squash(high - low, SQUASH), squash(low, SQUASH), is_bounded,
                        squash(bound - low, SQUASH) * is_bounded, squash(bound, SQUASH),
                        log(1 + nearest * (1 / NEAR_STEP)), log(usual), num_known * (1.0f / NUM_DIRECTIONS)})
        (*features++)[g] = value;
    write_features(of_rows, scene.squares, read, features, g);
}

// The answer at group g: the mean of the candidates, each counting by its vote, and the spread around it. `of_cell`
// holds the votes for the squares, a correction of the mean and a factor on the spread.
inline Answer answer(const Weights& weights, const Scene& scene, int g, const Lanes (*of_views)[NUM_COLUMNS],
                     const Lanes (*of_cell)[GROUPS]) {
    Lanes votes[NUM_CANDIDATES][NUM_DIRECTIONS], of_squares[NUM_RADII];
    Lanes most = splat(NO_VOTE), voters{}, answer{}, spread{};
    for (int v = 0; v < NUM_CANDIDATES; v++)
        for (int d = 0; d < NUM_DIRECTIONS; d++) {
            votes[v][d] = pick(scene.exists[v][d] > 0, of_views[v][g * NUM_DIRECTIONS + d], splat(NO_VOTE));
            most = larger(most, votes[v][d]);
        }
    for (int r = 0; r < NUM_RADII; r++) {
        of_squares[r] = pick(scene.has_square[r] > 0, of_cell[r][g], splat(NO_VOTE));
        most = larger(most, of_squares[r]);
    }
    auto count = [&](Lanes vote, Lanes candidate) {
        const Lanes share = exp(vote - most);
        voters += share, answer += share * candidate;
        return share;
    };
    for (int v = 0; v < NUM_CANDIDATES; v++)
        for (int d = 0; d < NUM_DIRECTIONS; d++) votes[v][d] = count(votes[v][d], scene.candidates[v][d]);
    for (int r = 0; r < NUM_RADII; r++) of_squares[r] = count(of_squares[r], scene.squares[r]);
    const Lanes per_voter = 1 / voters;
    answer *= per_voter;
    auto deviate = [&](Lanes share, Lanes candidate) { spread += share * (candidate - answer) * (candidate - answer); };
    for (int v = 0; v < NUM_CANDIDATES; v++)
        for (int d = 0; d < NUM_DIRECTIONS; d++) deviate(votes[v][d], scene.candidates[v][d]);
    for (int r = 0; r < NUM_RADII; r++) deviate(of_squares[r], scene.squares[r]);
    spread = spread * per_voter + NO_SPREAD * NO_SPREAD;

    const Lanes correction = of_cell[NUM_RADII][g], factor = of_cell[NUM_RADII + 1][g];
    answer = pick(scene.has_any > 0, answer + tanh(correction) * (scene.high - scene.low + MARGIN), splat(0));
    answer = pick(scene.is_bounded > 0, smaller(answer, scene.bound), answer);
    const Lanes log_std = 0.5f * log(spread) + clamp(factor, -LARGEST_LOG, LARGEST_LOG) + weights.calibration[0];
    const Lanes fade = scene.reach * scene.reach / (scene.reach * scene.reach + FADE * FADE);
    const Lanes log_faded = (1 - fade) * log_std + fade * weights.prior[0];
    return {scene.base + answer, exp(pick(scene.has_any > 0, log_faded, splat(weights.prior[0])))};
}

// The answers at some groups of cells.
inline void predict(const Weights& weights, const Map& map, const Squares& of_rows, const Cells* cells,
                    Answer* answers) {
    Scene scenes[GROUPS];
    Lanes features[NUM_VIEW][NUM_COLUMNS], channels[VIEWS][NUM_COLUMNS], views[VIEWS][NUM_COLUMNS];
    Lanes pooled[NUM_POOLED][GROUPS], outer[CELLS][GROUPS], inner[CELLS][GROUPS], told[NUM_TOLD][GROUPS];
    for (int g = 0; g < GROUPS; g++) look(map, of_rows, cells[g], g, scenes[g], features, pooled + 2 * VIEWS);
    hidden<VIEWS, NUM_VIEW>(weights.view, weights.view_bias, features, channels);
    hidden<VIEWS, VIEWS>(weights.view_inner, weights.view_inner_bias, channels, views);
    for (int k = 0; k < VIEWS; k++)
        for (int g = 0; g < GROUPS; g++) {
            const Lanes* of_cell = views[k] + g * NUM_DIRECTIONS;
            Lanes sum = of_cell[0], most = of_cell[0];
            for (int d = 1; d < NUM_DIRECTIONS; d++) sum += of_cell[d], most = larger(most, of_cell[d]);
            pooled[k][g] = sum * (1.0f / NUM_DIRECTIONS), pooled[VIEWS + k][g] = most;
        }
    hidden<CELLS, NUM_POOLED>(weights.cell, weights.cell_bias, pooled, outer);
    hidden<CELLS, CELLS>(weights.cell_inner, weights.cell_inner_bias, outer, inner);
    affine<NUM_TOLD, CELLS>(weights.told, weights.told_bias, inner, told);
    Lanes votes[NUM_CANDIDATES][NUM_COLUMNS];
    for (int g = 0; g < GROUPS; g++)
        for (int c = g * NUM_DIRECTIONS; c < (g + 1) * NUM_DIRECTIONS; c++) {
            for (int k = 0; k < VIEWS; k++) channels[k][c] = larger(views[k][c] + told[k][g], splat(0));
            for (int v = 0; v < NUM_CANDIDATES; v++) votes[v][c] = told[VIEWS + v][g];
        }
    affine<NUM_CANDIDATES, VIEWS>(weights.vote, nullptr, channels, votes);
    for (int g = 0; g < GROUPS; g++)
        answers[g] = answer(weights, scenes[g], g, votes, told + VIEWS + NUM_CANDIDATES);
}
