// The ground at unknown cells: predict.py.
#pragma once

#include "map.h"

struct Answer {
    Lanes mean, std;  // [m]
};

inline Answer predict(const Weights& weights, const Map& map, const Squares& of_row, const Cells& cells) {
    Surroundings around;
    look_around(map, cells, around);
    Lanes upper_bound, is_bounded;
    for (int l = 0; l < LANES; l++) {
        const int place = cells.row[l] * map.W + cells.column[l];
        is_bounded[l] = map.layers.bounded[place];
        upper_bound[l] = is_bounded[l] ? map.layers.upper_bound[place] : 0;
    }

    // Heights from the mean of those around each cell, in which nearer ones count more.
    Lanes has_any{}, lowest = all(NOWHERE), reach = all(NOWHERE);
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        const Flags is_known = around.known[d] > 0;
        has_any = larger(has_any, around.known[d]);
        lowest = smaller(lowest, pick(is_known, around.height[d], all(NOWHERE)));
        reach = smaller(reach, pick(is_known, around.distance[d], all(NOWHERE)));
    }
    lowest = pick(has_any > 0, lowest, all(float(map.level)));
    const Lanes nearest = smaller(reach, all(FARTHEST));
    Lanes distance[NUM_DIRECTIONS], near[NUM_DIRECTIONS], height[NUM_DIRECTIONS], sum{}, total{};
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        distance[d] = smaller(around.distance[d], all(FARTHEST));
        near[d] = nearest / larger(distance[d], all(1e-6f)) * around.known[d];
        height[d] = (around.height[d] - lowest) * around.known[d];
        sum += near[d] * height[d], total += near[d];
    }
    const Lanes mean = sum / larger(total, all(1e-6f)), low = -mean;
    Lanes high = all(-NOWHERE);
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        height[d] = (height[d] - mean) * around.known[d];
        high = larger(high, pick(around.known[d] > 0, height[d], all(-NOWHERE)));
    }
    high = pick(has_any > 0, high, all(0));
    const Lanes bound = (upper_bound - lowest - mean) * is_bounded;
    auto read = [&](const std::vector<float>& values) { return cells.read(values.data(), cells.column); };
    Lanes squares[NUM_RADII], has_square[NUM_RADII];
    for (int r = 0; r < NUM_RADII; r++) {
        has_square[r] = one_if(read(of_row.known[r]) > 0);
        for (int l = 0; l < LANES; l++)
            squares[r][l] = float(map.level + of_row.mean[r][cells.column[l]] - double(lowest[l]) - double(mean[l]));
        squares[r] *= has_square[r];
    }

    // What each direction proposes and what the network makes of it.
    Lanes candidates[NUM_CANDIDATES][NUM_DIRECTIONS], exists[NUM_CANDIDATES][NUM_DIRECTIONS];
    Lanes views[NUM_DIRECTIONS][VIEWS], pooled[NUM_POOLED], across;
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        const int o = d ^ 1;
        const Lanes known = around.known[d], both = known * around.known[o];
        if (d < o) across = both / larger(distance[d] + distance[o], all(1e-6f));
        const Lanes share = distance[o] * across;
        const Lanes step = (height[o] - height[d]) * both;
        candidates[0][d] = height[d], exists[0][d] = known;
        candidates[1][d] = height[d] + (1 - share) * step, exists[1][d] = both;
        Lanes features[NUM_VIEW] = {known, near[d], log(1 + distance[d] * (1 / NEAR_STEP)), squash(height[d], SQUASH),
                                    squash(height[d] - low, SQUASH) * known, both, share, squash(step, SQUASH)};
        for (int r = 0; r < NUM_REACHES; r++) {
            const Lanes slope = clamp(around.slope[r][d], -STEEPEST, STEEPEST);
            candidates[2 + r][d] = height[d] + slope * distance[d], exists[2 + r][d] = around.has_slope[r][d];
            features[8 + r] = around.has_slope[r][d], features[8 + NUM_REACHES + r] = slope;
        }
        Lanes channels[VIEWS];
        affine<VIEWS, NUM_VIEW>(weights.view, weights.view_bias, features, channels);
        relu<VIEWS>(channels);
        affine<VIEWS, VIEWS>(weights.view_inner, weights.view_inner_bias, channels, views[d]);
        relu<VIEWS>(views[d]);
        for (int k = 0; k < VIEWS; k++) {
            pooled[k] = d ? pooled[k] + views[d][k] : views[d][k];
            pooled[VIEWS + k] = d ? larger(pooled[VIEWS + k], views[d][k]) : views[d][k];
        }
    }
    for (int k = 0; k < VIEWS; k++) pooled[k] *= 1.0f / NUM_DIRECTIONS;

    // What it knows of the cell.
    Lanes num_known{};
    for (const Lanes& known : around.known) num_known += known;
    Lanes* cell = pooled + 2 * VIEWS;
    const Lanes usual = all(float(map.resolution) / USUAL);
    for (Lanes value : {squash(high - low, SQUASH), squash(low, SQUASH), is_bounded,
                        squash(bound - low, SQUASH) * is_bounded, squash(bound, SQUASH), log(1 + nearest * (1 / NEAR_STEP)),
                        log(usual), num_known * (1.0f / NUM_DIRECTIONS)})
        *cell++ = value;
    write_features(of_row, squares, read, cell);
    Lanes outer[CELLS], inner[CELLS], told[VIEWS], of_cell[NUM_CANDIDATES];
    affine<CELLS, NUM_POOLED>(weights.cell, weights.cell_bias, pooled, outer);
    relu<CELLS>(outer);
    affine<CELLS, CELLS>(weights.cell_inner, weights.cell_inner_bias, outer, inner);
    relu<CELLS>(inner);
    affine<VIEWS, CELLS>(weights.to_view, weights.to_view_bias, inner, told);
    affine<NUM_CANDIDATES, CELLS>(weights.vote_cell, weights.vote_bias, inner, of_cell);

    // The votes.
    Lanes votes[NUM_CANDIDATES][NUM_DIRECTIONS], of_squares[NUM_RADII], most = all(NO_VOTE);
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        Lanes channels[VIEWS], voted[NUM_CANDIDATES];
        for (int k = 0; k < VIEWS; k++) channels[k] = larger(views[d][k] + told[k], all(0));
        for (int v = 0; v < NUM_CANDIDATES; v++) voted[v] = of_cell[v];
        affine<NUM_CANDIDATES, VIEWS>(weights.vote, nullptr, channels, voted);
        for (int v = 0; v < NUM_CANDIDATES; v++) {
            votes[v][d] = pick(exists[v][d] > 0, voted[v], all(NO_VOTE));
            most = larger(most, votes[v][d]);
        }
    }
    affine<NUM_RADII, CELLS>(weights.vote_square, weights.vote_square_bias, inner, of_squares);
    for (int r = 0; r < NUM_RADII; r++) {
        of_squares[r] = pick(has_square[r] > 0, of_squares[r], all(NO_VOTE));
        most = larger(most, of_squares[r]);
    }
    Lanes voters{}, answer{}, spread{};
    auto count = [&](Lanes vote, Lanes candidate) {
        const Lanes share = exp(vote - most);
        voters += share, answer += share * candidate;
        return share;
    };
    for (int v = 0; v < NUM_CANDIDATES; v++)
        for (int d = 0; d < NUM_DIRECTIONS; d++) votes[v][d] = count(votes[v][d], candidates[v][d]);
    for (int r = 0; r < NUM_RADII; r++) of_squares[r] = count(of_squares[r], squares[r]);
    const Lanes per_voter = 1 / voters;
    answer *= per_voter;
    auto deviate = [&](Lanes share, Lanes candidate) { spread += share * (candidate - answer) * (candidate - answer); };
    for (int v = 0; v < NUM_CANDIDATES; v++)
        for (int d = 0; d < NUM_DIRECTIONS; d++) deviate(votes[v][d], candidates[v][d]);
    for (int r = 0; r < NUM_RADII; r++) deviate(of_squares[r], squares[r]);
    spread = spread * per_voter + NO_SPREAD * NO_SPREAD;

    Lanes last[2];  // correction and factor on the spread
    affine<2, CELLS>(weights.answer, weights.answer_bias, inner, last);
    answer = pick(has_any > 0, answer + tanh(last[0]) * (high - low + MARGIN), all(0));
    answer = pick(is_bounded > 0, smaller(answer, bound), answer);
    const Lanes log_std = 0.5f * log(spread) + clamp(last[1], -LARGEST_LOG, LARGEST_LOG) + weights.calibration[0];
    const Lanes fade = reach * reach / (reach * reach + FADE * FADE);
    const Lanes log_faded = (1 - fade) * log_std + fade * weights.prior[0];
    return {lowest + mean + answer, exp(pick(has_any > 0, log_faded, all(weights.prior[0])))};
}
