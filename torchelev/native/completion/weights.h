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
    const float *to_view, *to_view_bias, *vote, *vote_cell, *vote_bias, *vote_square, *vote_square_bias;
    const float *answer, *answer_bias, *measured, *measured_bias, *measured_answer, *measured_answer_bias;
    const float *prior, *calibration;
    float told[NUM_TOLD * CELLS], told_bias[NUM_TOLD];  // all that is made of a cell's channels: to_view and so on

    explicit Weights(const float* next) {
        auto take = [&](int size) { return std::exchange(next, next + size); };
        view = take(VIEWS * NUM_VIEW), view_bias = take(VIEWS);
        view_inner = take(VIEWS * VIEWS), view_inner_bias = take(VIEWS);
        cell = take(CELLS * NUM_POOLED), cell_bias = take(CELLS);
        cell_inner = take(CELLS * CELLS), cell_inner_bias = take(CELLS);
        to_view = take(VIEWS * CELLS), to_view_bias = take(VIEWS);
        vote = take(NUM_CANDIDATES * VIEWS), vote_cell = take(NUM_CANDIDATES * CELLS), vote_bias = take(NUM_CANDIDATES);
        vote_square = take(NUM_RADII * CELLS), vote_square_bias = take(NUM_RADII);
        answer = take(2 * CELLS), answer_bias = take(2);
        measured = take(MEASURED * NUM_MEASURED), measured_bias = take(MEASURED);
        measured_answer = take(2 * MEASURED), measured_answer_bias = take(2);
        prior = take(1), calibration = take(2);
        float *matrix = told, *bias = told_bias;
        auto add = [&](const float* its_matrix, const float* its_bias, int size) {
            matrix = std::copy_n(its_matrix, size * CELLS, matrix), bias = std::copy_n(its_bias, size, bias);
        };
        add(to_view, to_view_bias, VIEWS), add(vote_cell, vote_bias, NUM_CANDIDATES);
        add(vote_square, vote_square_bias, NUM_RADII), add(answer, answer_bias, 2);
    }
};
