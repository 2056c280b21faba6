// The sizes and the parameters of the network, in the order of `Weights` in parameters.py.
// VIEWS, CELLS and MEASURED, its numbers of channels, and all constants in capitals that no file here defines, are
// given by torchelev/completion/native.py.
#pragma once

#include <algorithm>
#include <utility>

constexpr int NUM_DIRECTIONS = 8, NUM_REACHES = 2, NUM_RADII = 2;
constexpr int NUM_VIEW = 8 + 2 * NUM_REACHES, NUM_CELL = 8 + 6 * NUM_RADII, NUM_CANDIDATES = 2 + NUM_REACHES;
constexpr int NUM_TOLD = VIEWS + NUM_CANDIDATES + NUM_RADII + 2;
constexpr int NUM_POOLED = 2 * VIEWS + NUM_CELL, NUM_CLOSE = 7, NUM_MEASURED = NUM_CLOSE + 6 * NUM_RADII;

struct Weights {
    const float *view, *view_bias, *view_inner, *view_inner_bias, *cell, *cell_bias, *cell_inner, *cell_inner_bias;
    const float *vote, *measured, *measured_bias, *measured_answer, *measured_answer_bias, *prior, *calibration;
    // One matrix and bias of all that is made of a cell's channels: to_view, vote_cell, vote_square and answer.
    float told[NUM_TOLD * CELLS], told_bias[NUM_TOLD];

    explicit Weights(const float* next) {
        auto take = [&](int size) { return std::exchange(next, next + size); };
        float *matrix = told, *bias = told_bias;
        auto tell = [&](int size) {
            matrix = std::copy_n(take(size * CELLS), size * CELLS, matrix), bias = std::copy_n(take(size), size, bias);
        };
        view = take(VIEWS * NUM_VIEW), view_bias = take(VIEWS);
        view_inner = take(VIEWS * VIEWS), view_inner_bias = take(VIEWS);
        cell = take(CELLS * NUM_POOLED), cell_bias = take(CELLS);
        cell_inner = take(CELLS * CELLS), cell_inner_bias = take(CELLS);
        tell(VIEWS), vote = take(NUM_CANDIDATES * VIEWS);
        tell(NUM_CANDIDATES), tell(NUM_RADII), tell(2);
        measured = take(MEASURED * NUM_MEASURED), measured_bias = take(MEASURED);
        measured_answer = take(2 * MEASURED), measured_answer_bias = take(2);
        prior = take(1), calibration = take(2);
    }
};
