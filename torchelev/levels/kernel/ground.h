// Which surface of each cell is the ground: ground.py, with the same names.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace levels {

constexpr float SLOPE = 0.5f;
constexpr int8_t NONE = -1, UNDECIDED = -2;

struct Standing {
    int64_t cell = 0;
    int surface = 0;
    float height = 0;
    bool found = false;
};

// Memory of the search, kept between updates.
struct Search {
    std::vector<float> height;    // (K, H W) [m] NaN: no surface
    std::vector<float> guess;     // (H W) [m]
    std::vector<int32_t> blind;   // (H W) cells since the last surface
    std::vector<int32_t> reached_in;  // (H W) the step in which the guess came
    std::vector<int32_t> decided_in;  // (H W) the step in which the cell was reached first
    std::vector<uint16_t> open;   // (H W) surfaces that were not reached, a bit each; bit K: the guess
    std::vector<int8_t> first;    // (H W)
    std::vector<int32_t> wave, next;  // surface * cells + cell

    int64_t H, W, cells;
    int K;
    float max_step, rise;
    int32_t max_blind;
    int32_t step = 0;

    void start(int64_t rows, int64_t columns, int surfaces) {
        H = rows, W = columns, cells = H * W, K = surfaces;
        height.resize(K * cells), guess.resize(cells), blind.resize(cells), open.resize(cells);
        reached_in.assign(cells, -1), decided_in.assign(cells, -1), first.assign(cells, UNDECIDED);
    }

    // Find the highest surface below the base in the cell nearest to it that has one.
    Standing find_standing(const float* base, const float* x, const float* y) const {
        const int64_t i = nearest_of(x, H, base[0]), j = nearest_of(y, W, base[1]);
        constexpr int64_t NEAR = 8;
        float square = std::numeric_limits<float>::infinity();
        Standing best = search(base, x, y, i - NEAR, i + NEAR, j - NEAR, j + NEAR, square);
        const float reach = std::min(std::fabs(x[1] - x[0]), 1e9f) * (NEAR - 1);
        if (!best.found || square > reach * reach) best = search(base, x, y, 0, H - 1, 0, W - 1, square);
        return best;
    }

    void run(const Standing& standing) {
        for (int64_t c = 0; c < cells; c++) {
            uint16_t bits = 0;
            for (int k = 0; k < K; k++) bits |= uint16_t(height[k * cells + c] == height[k * cells + c]) << k;
            open[c] = bits & 1 ? bits : uint16_t(bits | 1 << K);
        }
        wave.clear(), step = 0;
        if (standing.found) reach(standing.surface, standing.cell, wave);
        for (step = 1; step <= H + W && !wave.empty(); step++) {
            next.clear();
            for (const int32_t node : wave) spread(node / cells, node % cells);
            wave.swap(next);
        }
        for (int8_t& surface : first) surface = surface == UNDECIDED ? NONE : surface;
    }

    bool is_reached(int64_t c) const { return !(open[c] & 1) && height[c] == height[c]; }

  private:
    static int64_t nearest_of(const float* centers, int64_t size, float value) {
        int64_t best = 0;
        for (int64_t k = 1; k < size; k++)
            if (std::fabs(centers[k] - value) < std::fabs(centers[best] - value)) best = k;
        return best;
    }

    Standing search(const float* base, const float* x, const float* y, int64_t i0, int64_t i1, int64_t j0, int64_t j1,
                    float& square) const {
        Standing best;
        square = std::numeric_limits<float>::infinity();
        for (int64_t i = std::max<int64_t>(i0, 0); i <= std::min(i1, H - 1); i++)
            for (int64_t j = std::max<int64_t>(j0, 0); j <= std::min(j1, W - 1); j++) {
                const float dx = x[i] - base[0], dy = y[j] - base[1], away = dx * dx + dy * dy;
                if (!(away < square)) continue;
                for (int k = 0; k < K; k++) {
                    const float h = height[k * cells + i * W + j];
                    if (!(h <= base[2]) || (away == square && !(h > best.height))) continue;
                    best = {i * W + j, k, h, true}, square = away;
                }
            }
        return best;
    }

    void reach(int k, int64_t c, std::vector<int32_t>& to) {
        open[c] &= uint16_t(~(1 << k)), to.push_back(int32_t(k * cells + c));
        const int8_t surface = k == K ? NONE : int8_t(k);
        if (first[c] == UNDECIDED) first[c] = surface, decided_in[c] = step;
        else if (decided_in[c] == step && surface != NONE && (first[c] == NONE || surface < first[c])) first[c] = surface;
    }

    // Reach the cells beside one.
    void spread(int64_t k, int64_t c) {
        const float from = k < K ? height[k * cells + c] : guess[c];
        const int32_t gone = k < K ? 0 : blind[c];
        const float limit = max_step + rise * float(gone);
        const int64_t i = c / W, j = c % W;
        if (i > 0) visit(c - W, from, gone, limit);
        if (i < H - 1) visit(c + W, from, gone, limit);
        if (j > 0) visit(c - 1, from, gone, limit);
        if (j < W - 1) visit(c + 1, from, gone, limit);
    }

    void visit(int64_t c, float from, int32_t gone, float limit) {
        if (!open[c] && reached_in[c] != step) return;
        for (int k = 0; k < K; k++)
            if ((open[c] >> k & 1) && std::fabs(height[k * cells + c] - from) <= limit) reach(k, c, next);
        if (gone >= max_blind) return;
        if (open[c] >> K & 1) {
            guess[c] = from, blind[c] = gone + 1, reached_in[c] = step;
            reach(K, c, next);
        } else if (reached_in[c] == step) {
            blind[c] = from < guess[c] ? gone + 1 : from == guess[c] ? std::min(blind[c], gone + 1) : blind[c];
            guess[c] = std::min(guess[c], from);
        }
    }
};

}  // namespace levels
