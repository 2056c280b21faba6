// Which surface of each cell is the ground: ground.py, with the same names.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "levels/kernel/surfaces.h"

namespace levels {

constexpr float SLOPE = 0.5f, NEAR = 1.0f;
constexpr int8_t NONE = -1, UNDECIDED = -2;
constexpr int MAX_LEVELS = 8;  // surfaces of a cell: MAX_LEVELS of config.py

struct Standing {
    int64_t cell = 0;
    int surface = 0;
    float height = 0;
    bool found = false;
};

// A cell with levels.
struct Several {
    int64_t cell;
    float height[MAX_LEVELS];  // [m] of the surfaces, 0 the ground; NaN: not there, or of too few points
    uint16_t firm = 0;         // surfaces of many points, a bit each
    uint16_t entered = 0;      // levels that a way from the ground may lead to, a bit each
    bool may_change = false;   // one of them may be reached before the ground
    int8_t first = UNDECIDED;
    int32_t decided_in = 0;    // the step in which it was reached first
};

// The search over the surfaces of a window, whose rim of cells without any spares the questions for its border. Its
// memory is kept between updates.
struct Search {
    std::vector<float> height;   // (cells) [m] of the ground, or where it is guessed to be; NaN: neither
    std::vector<int32_t> entry;  // (cells) place in `several`, -1 for none
    std::vector<Several> several;
    const float* support;        // (H W) of the ground
    int64_t H, W, pitch, cells;
    int64_t sides[4];            // from a cell to those beside it
    int K;
    float max_step, rise;
    int32_t max_blind;

    // Begin with a window; `height` within the rim is the caller's to set, and `several` to add to.
    void start(int64_t rows, int64_t columns, int surfaces) {
        H = rows, W = columns, pitch = W + 2, cells = (H + 2) * pitch, K = surfaces;
        sides[0] = -pitch, sides[1] = pitch, sides[2] = -1, sides[3] = 1;
        height.resize(cells), entry.assign(cells, -1), several.clear();
        std::fill_n(height.begin(), pitch, NAN), std::fill_n(height.end() - pitch, pitch, NAN);
        for (int64_t i = 0; i < H; i++) height[at(i, -1)] = height[at(i, W)] = NAN;
    }

    // The cell of a row and a column of the window.
    int64_t at(int64_t i, int64_t j) const { return (i + 1) * pitch + j + 1; }

    Several& add(int64_t c) {
        entry[c] = int32_t(several.size());
        several.emplace_back().cell = c;
        return several.back();
    }

    // Find the highest surface below the base in the cell nearest to it that has one, or in the nearest within NEAR
    // where that has many points.
    Standing find_standing(const float* base, const float* x, const float* y) const {
        const Standing settled = nearest(base, x, y, true, NEAR * NEAR);
        return settled.found ? settled : nearest(base, x, y, false, std::numeric_limits<float>::infinity());
    }

    // Find the cells of which a level may be reached before the ground; return whether there are any. A way may lead to
    // levels a step from ground, and on to those a step from them. A level that is entered only from where the ground
    // below it is entered too is never first.
    bool enter(const Standing& standing) {
        undecided = 0, nodes.clear();
        if (standing.surface > 0) {
            Several& here = several[entry[standing.cell]];
            here.may_change = true, undecided++, mark(here, standing.surface);
        }
        for (Several& here : several)
            for (int k = 1; k < K; k++)
                if (touches_ground(here, k)) mark(here, k);
        while (!nodes.empty()) {
            Several& here = several[nodes.back().first];
            const int k = nodes.back().second;
            nodes.pop_back();
            for (const int64_t away : sides) {
                const int64_t c = here.cell + away;
                lead_to(here, k, height[c]);
                if (entry[c] < 0) continue;
                Several& other = several[entry[c]];
                for (int m = 1; m < K; m++)
                    if (std::fabs(other.height[m] - here.height[k]) <= max_step)
                        mark(other, m), lead_to(other, m, here.height[k]);
            }
        }
        return undecided > 0;
    }

    // Search until the cells that may change are reached; `is_whole`: until all are.
    void run(const Standing& standing, bool is_whole) {
        unreached.assign(cells, 0), blind.resize(cells);
        if (next.size() <= size_t(K + 1) * cells) wave.resize((K + 1) * cells + 1), next.resize((K + 1) * cells + 1);
        for (int64_t i = 0; i < H; i++)
            for (int64_t c = at(i, 0); c < at(i, W); c++) unreached[c] = height[c] == height[c] ? 1 | KNOWN : GUESS;
        for (const Several& here : several) {
            for (int k = 1; k < K; k++) unreached[here.cell] |= uint16_t(here.height[k] == here.height[k]) << k;
            if (here.may_change) unreached[here.cell] |= MAY_CHANGE;
        }
        step = 0, number = 0, fresh.clear();
        if (standing.found) reach(standing.surface, standing.cell);
        for (step = 1; step <= H + W && number && (undecided || is_whole); step++) {
            wave.swap(next);
            spread(std::exchange(number, 0));
            for (const int32_t c : fresh) unreached[c] &= uint16_t(~FRESH);
            fresh.clear();
        }
    }

    bool is_reached(int64_t c) const { return (unreached[c] & (1 | KNOWN)) == KNOWN; }

  private:
    // Bits of `unreached` besides those of the surfaces that were not reached: the ground is known; its guess was not
    // reached; it came in this step; a level may be first.
    static constexpr uint16_t KNOWN = 1 << 12, GUESS = 1 << 13, FRESH = 1 << 14, MAY_CHANGE = 1 << 15;
    static constexpr int SHIFT = 27;
    std::vector<uint16_t> unreached;  // (cells)
    std::vector<int32_t> blind;       // (cells) cells since the last surface
    std::vector<int32_t> wave, next;  // nodes: surface << SHIFT | cell
    std::vector<int32_t> fresh;       // cells whose guess came in this step
    std::vector<std::pair<int32_t, int>> nodes;  // entry and surface
    int64_t number = 0;                          // of nodes in `next`
    int64_t undecided = 0;                       // cells that may change and were not reached
    int32_t step = 0;

    static int64_t nearest_of(const float* centers, int64_t size, float value) {
        int64_t best = 0;
        for (int64_t k = 1; k < size; k++)
            if (std::fabs(centers[k] - value) < std::fabs(centers[best] - value)) best = k;
        return best;
    }

    // The highest surface of a cell below some height, -1 for none.
    int top_below(int64_t c, float limit) const {
        int top = height[c] <= limit ? 0 : -1;
        if (entry[c] < 0) return top;
        const float* const all = several[entry[c]].height;
        for (int k = 1; k < K; k++)
            if (all[k] <= limit && (top < 0 || all[k] > all[top])) top = k;
        return top;
    }

    // Of cells at one distance the first; rows and columns outwards, so that the nearest come first.
    Standing nearest(const float* base, const float* x, const float* y, bool is_firm, float square) const {
        Standing best;
        if (!(base[0] == base[0] && base[1] == base[1])) return best;
        const int64_t middle = nearest_of(x, H, base[0]), column = nearest_of(y, W, base[1]);
        const auto try_cell = [&](int64_t i, int64_t j, float dx) {
            const float dy = y[j] - base[1], away = dx * dx + dy * dy;
            if (away > square) return false;
            const int64_t c = at(i, j);
            if (best.found && away == square && c > best.cell) return true;
            const int top = top_below(c, base[2]);
            if (top < 0 || (is_firm && !has_many(i, j, top))) return true;
            best = {c, top, top > 0 ? several[entry[c]].height[top] : height[c], true}, square = away;
            return true;
        };
        const auto try_row = [&](int64_t i) {
            const float dx = x[i] - base[0];
            if (dx * dx > square) return false;
            for (int64_t j = column; j < W && try_cell(i, j, dx); j++) {}
            for (int64_t j = column - 1; j >= 0 && try_cell(i, j, dx); j--) {}
            return true;
        };
        for (int64_t i = middle; i < H && try_row(i); i++) {}
        for (int64_t i = middle - 1; i >= 0 && try_row(i); i--) {}
        return best;
    }

    bool has_many(int64_t i, int64_t j, int surface) const {
        const int64_t k = entry[at(i, j)];
        return k < 0 ? support[i * W + j] >= SETTLED : several[k].firm >> surface & 1;
    }

    bool touches_ground(const Several& here, int k) const {
        for (const int64_t away : sides)
            if (std::fabs(height[here.cell + away] - here.height[k]) <= max_step) return true;
        return false;
    }

    // Note that a way may lead from a height to a level, and not to the ground of its cell.
    void lead_to(Several& here, int k, float from) {
        if (here.may_change || !(std::fabs(from - here.height[k]) <= max_step) || std::fabs(from - here.height[0]) <= max_step)
            return;
        here.may_change = true, undecided++;
    }

    void mark(Several& here, int k) {
        if (here.entered >> k & 1) return;
        here.entered |= uint16_t(1 << k), nodes.emplace_back(int32_t(&here - several.data()), k);
    }

    void reach(int k, int64_t c) {
        unreached[c] &= uint16_t(~(k == K ? GUESS : 1 << k)), next[number++] = int32_t(k) << SHIFT | int32_t(c);
        if (!(unreached[c] & MAY_CHANGE)) return;
        Several& here = several[entry[c]];
        const int8_t surface = k == K ? NONE : int8_t(k);
        if (here.first == UNDECIDED) here.first = surface, here.decided_in = step, undecided--;
        else if (here.decided_in == step && surface != NONE && (here.first == NONE || surface < here.first)) here.first = surface;
    }

    // Reach the cells beside those of the first `size` nodes of the wave.
    void spread(int64_t size) {
        const float* const ground = height.data();
        const int32_t* const nodes_of_wave = wave.data();
        uint16_t* const left = unreached.data();
        int32_t* const to = next.data();
        int64_t count = 0;
        for (int64_t n = 0; n < size; n++) {
            const int k = nodes_of_wave[n] >> SHIFT;
            const int64_t c = nodes_of_wave[n] & ((1 << SHIFT) - 1);
            const float from = k == 0 || k == K ? height[c] : several[entry[c]].height[k];
            const int32_t num_blind = k < K ? 0 : blind[c];
            const float limit = max_step + rise * float(num_blind);
            for (const int64_t away : sides) {
                const int64_t beside = c + away;
                const uint16_t bits = left[beside];
                if (bits & ~(1 | KNOWN)) {
                    number = count, visit(beside, from, num_blind, limit), count = number;
                } else {  // mostly: the ground alone, or nothing, without a branch
                    const bool reaches = (bits & 1) & (std::fabs(ground[beside] - from) <= limit);
                    to[count] = int32_t(beside), count += reaches, left[beside] = uint16_t(bits ^ reaches);
                }
            }
        }
        number = count;
    }

    void visit(int64_t c, float from, int32_t num_blind, float limit) {
        if ((unreached[c] & 1) && std::fabs(height[c] - from) <= limit) reach(0, c);
        for (int k = 1; k < K && !num_blind && entry[c] >= 0; k++)  // what is guessed leads to the ground alone
            if ((unreached[c] >> k & 1) && std::fabs(several[entry[c]].height[k] - from) <= limit) reach(k, c);
        if (num_blind >= max_blind) return;
        if (unreached[c] & GUESS) {
            height[c] = from, blind[c] = num_blind + 1;
            reach(K, c), unreached[c] |= FRESH, fresh.push_back(int32_t(c));
        } else if (unreached[c] & FRESH) {
            blind[c] = from < height[c] ? num_blind + 1 : from == height[c] ? std::min(blind[c], num_blind + 1) : blind[c];
            height[c] = std::min(height[c], from);
        }
    }
};

}  // namespace levels
