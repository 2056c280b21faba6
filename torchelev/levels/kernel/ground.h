// Which surface of each cell is the ground: ground.py, with the same names.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

namespace levels {

constexpr float SLOPE = 0.5f, NEAR = 1.0f;
constexpr int8_t NONE = -1, UNDECIDED = -2;

struct Standing {
    int64_t cell = 0;
    int surface = 0;
    float height = 0;
    bool found = false;
};

// The search over the surfaces of a window, whose rim of cells without any spares the questions for its border. Its
// memory is kept between updates.
struct Search {
    std::vector<float> height;        // (K, cells) [m] NaN: no surface
    std::vector<float> guess;         // (cells) [m]
    std::vector<int32_t> blind;       // (cells) cells since the last surface
    std::vector<int32_t> decided_in;  // (cells) the step in which a cell of several surfaces was reached first
    std::vector<uint16_t> firm;       // (cells) surfaces of many points, a bit each
    std::vector<uint16_t> open;       // (cells) surfaces that were not reached, a bit each, and flags
    std::vector<int8_t> first;        // (cells)
    std::vector<int32_t> wave, next;  // nodes: surface << SHIFT | cell

    int64_t H, W, pitch, cells;
    int K;
    float max_step, rise;
    int32_t max_blind;
    int32_t step = 0;
    static constexpr int SHIFT = 27;
    // Bits of `open`: the guess was not reached; it came in this step; the cell may be reached on several surfaces.
    static constexpr uint16_t GUESS = 1 << 13, FRESH = 1 << 14, SEVERAL = 1 << 15;

    void start(int64_t rows, int64_t columns, int surfaces) {
        H = rows, W = columns, pitch = W + 2, cells = (H + 2) * pitch, K = surfaces;
        height.assign(K * cells, NAN), guess.resize(cells), blind.resize(cells), open.resize(cells), firm.resize(cells);
        decided_in.resize(cells), first.assign(cells, UNDECIDED);
        if (next.size() <= size_t(K + 1) * cells) wave.resize((K + 1) * cells + 1), next.resize((K + 1) * cells + 1);
    }

    // The cell of a row and a column of the window.
    int64_t at(int64_t i, int64_t j) const { return (i + 1) * pitch + j + 1; }

    // Find the highest surface below the base in the cell nearest to it that has one, or in the nearest within NEAR
    // where that has many points.
    Standing find_standing(const float* base, const float* x, const float* y) const {
        const int64_t i = nearest_of(x, H, base[0]), j = nearest_of(y, W, base[1]);
        const float step = H > 1 ? x[1] - x[0] : 1;
        const int64_t around = int64_t(std::ceil(NEAR / step)) + 1;
        float square;
        const Standing settled = search(base, x, y, i - around, i + around, j - around, j + around, true, square);
        if (settled.found && square <= NEAR * NEAR) return settled;
        const Standing weak = search(base, x, y, i - around, i + around, j - around, j + around, false, square);
        return weak.found && square <= NEAR * NEAR ? weak : search(base, x, y, 0, H - 1, 0, W - 1, false, square);
    }

    // Whether one of these levels (nodes) lies beside ground that is within a step of it: else none can be reached.
    bool touches_ground(const std::vector<int32_t>& nodes) const {
        for (const int32_t node : nodes) {
            const int64_t c = node % cells;
            for (const int64_t beside : {c - pitch, c + pitch, c - 1, c + 1})
                if (std::fabs(height[beside] - height[node]) <= max_step) return true;
        }
        return false;
    }

    // Search until the cells of several surfaces are reached; `is_whole`: until all are.
    void run(const Standing& standing, bool is_whole) {
        std::fill(open.begin(), open.end(), uint16_t(0));
        int64_t several = 0;
        for (int64_t i = 0; i < H; i++)
            for (int64_t c = at(i, 0); c < at(i, W); c++) {
                uint16_t bits = 0;
                for (int k = 0; k < K; k++) bits |= uint16_t(height[k * cells + c] == height[k * cells + c]) << k;
                open[c] = uint16_t(bits | (bits & 1 ? 0 : GUESS) | (bits > 1 ? SEVERAL : 0));
                several += bits > 1;
            }
        step = 0, number = 0, undecided = several, fresh.clear();
        if (standing.found) reach(standing.surface, standing.cell);
        for (step = 1; step <= H + W && number && (undecided || is_whole); step++) {
            wave.swap(next);
            spread(std::exchange(number, 0));
            for (const int32_t c : fresh) open[c] &= uint16_t(~FRESH);
            fresh.clear();
        }
    }

    bool is_reached(int64_t c) const { return !(open[c] & 1) && height[c] == height[c]; }

  private:
    int64_t number = 0;          // of nodes in `next`
    int64_t undecided = 0;       // cells of several surfaces that were not reached
    std::vector<int32_t> fresh;  // cells whose guess came in this step

    static int64_t nearest_of(const float* centers, int64_t size, float value) {
        int64_t best = 0;
        for (int64_t k = 1; k < size; k++)
            if (std::fabs(centers[k] - value) < std::fabs(centers[best] - value)) best = k;
        return best;
    }

    Standing search(const float* base, const float* x, const float* y, int64_t i0, int64_t i1, int64_t j0, int64_t j1,
                    bool is_firm, float& square) const {
        Standing best;
        square = std::numeric_limits<float>::infinity();
        for (int64_t i = std::max<int64_t>(i0, 0); i <= std::min(i1, H - 1); i++)
            for (int64_t j = std::max<int64_t>(j0, 0); j <= std::min(j1, W - 1); j++) {
                const float dx = x[i] - base[0], dy = y[j] - base[1], away = dx * dx + dy * dy;
                if (!(away < square)) continue;
                int top = -1;
                for (int k = 0; k < K; k++) {
                    const float h = height[k * cells + at(i, j)];
                    if (h <= base[2] && (top < 0 || h > height[top * cells + at(i, j)])) top = k;
                }
                if (top < 0 || (is_firm && !(firm[at(i, j)] >> top & 1))) continue;
                best = {at(i, j), top, height[top * cells + at(i, j)], true}, square = away;
            }
        return best;
    }

    void reach(int k, int64_t c) {
        open[c] &= uint16_t(~(k == K ? GUESS : 1 << k)), next[number++] = int32_t(k) << SHIFT | int32_t(c);
        if (!(open[c] & SEVERAL)) return;
        const int8_t surface = k == K ? NONE : int8_t(k);
        if (first[c] == UNDECIDED) first[c] = surface, decided_in[c] = step, undecided--;
        else if (decided_in[c] == step && surface != NONE && (first[c] == NONE || surface < first[c])) first[c] = surface;
    }

    // Reach the cells beside those of the first `size` nodes of the wave.
    void spread(int64_t size) {
        const float* const ground = height.data();
        const int32_t* const nodes = wave.data();
        uint16_t* const left = open.data();
        int32_t* const to = next.data();
        const int64_t aside[] = {-pitch, pitch, -1, 1};
        int64_t count = 0;
        for (int64_t n = 0; n < size; n++) {
            const int k = nodes[n] >> SHIFT;
            const int64_t c = nodes[n] & ((1 << SHIFT) - 1);
            const float from = k < K ? height[k * cells + c] : guess[c];
            const int32_t gone = k < K ? 0 : blind[c];
            const float limit = max_step + rise * float(gone);
            for (const int64_t away : aside) {
                const int64_t beside = c + away;
                const uint16_t bits = left[beside];
                if (bits & ~1) {
                    number = count, visit(beside, from, gone, limit), count = number;
                } else {  // mostly: the ground alone, or nothing, without a branch
                    const bool reaches = (bits & 1) & (std::fabs(ground[beside] - from) <= limit);
                    to[count] = int32_t(beside), count += reaches, left[beside] = uint16_t(bits ^ reaches);
                }
            }
        }
        number = count;
    }

    void visit(int64_t c, float from, int32_t gone, float limit) {
        for (int k = 0; k < (gone ? 1 : K); k++)  // what is guessed leads to the ground alone
            if ((open[c] >> k & 1) && std::fabs(height[k * cells + c] - from) <= limit) reach(k, c);
        if (gone >= max_blind) return;
        if (open[c] & GUESS) {
            guess[c] = from, blind[c] = gone + 1;
            reach(K, c), open[c] |= FRESH, fresh.push_back(int32_t(c));
        } else if (open[c] & FRESH) {
            blind[c] = from < guess[c] ? gone + 1 : from == guess[c] ? std::min(blind[c], gone + 1) : blind[c];
            guess[c] = std::min(guess[c], from);
        }
    }
};

}  // namespace levels
