// Holes that are filled from known cells: filters/inpainting/inpaint.py and holes.py.

#include <algorithm>
#include <cmath>

#include "runtime/source/filters/filters.h"

namespace {

// Call `work(n)` for the eight neighbours of a cell.
template <class Work>
void each_neighbour(const FilterGrid& grid, int64_t k, const Work& work) {
    const int64_t i = k / grid.W, j = k % grid.W;
    for (int64_t row = std::max<int64_t>(0, i - 1); row <= std::min(grid.H - 1, i + 1); row++)
        for (int64_t column = std::max<int64_t>(0, j - 1); column <= std::min(grid.W - 1, j + 1); column++)
            if (row != i || column != j) work(row * grid.W + column);
}

// Fill the hole of a cell with the lowest height of its border; `hole` is memory for its cells.
void fill_hole(const FilterGrid& grid, const Cells& from, int64_t first, std::vector<int64_t>& hole,
               std::vector<uint8_t>& seen, Cells& to) {
    float lowest = INFINITY;
    hole.assign(1, first), seen[first] = 1;
    for (size_t k = 0; k < hole.size(); k++)
        each_neighbour(grid, hole[k], [&](int64_t n) {
            if (from.known[n]) lowest = std::min(lowest, from.values[n]);
            else if (!seen[n]) hole.push_back(n), seen[n] = 1;
        });
    if (std::isinf(lowest)) return;
    for (int64_t k : hole) to.values[k] = lowest, to.known[k] = 1;
}

// As above within so many steps from the border.
void fill_steps(const FilterGrid& grid, const Cells& from, int64_t iterations, Cells& to) {
    std::vector<float> lowest(grid.cells()), next(grid.cells());
    for (int64_t k = 0; k < grid.cells(); k++) lowest[k] = from.known[k] ? from.values[k] : INFINITY;
    bool is_changing = true;
    for (int64_t step = 0; step < iterations && is_changing; step++) {
        is_changing = step == 0;  // when known cells give way to the hole's
        for (int64_t k = 0; k < grid.cells(); k++) {
            next[k] = from.known[k] ? INFINITY : lowest[k];
            if (!from.known[k]) each_neighbour(grid, k, [&](int64_t n) { next[k] = std::min(next[k], lowest[n]); });
            is_changing |= next[k] < lowest[k];
        }
        lowest.swap(next);
    }
    for (int64_t k = 0; k < grid.cells(); k++)
        if (!from.known[k] && std::isfinite(lowest[k])) to.values[k] = lowest[k], to.known[k] = 1;
}

}  // namespace

void filters::inpaint_minimum(const FilterGrid& grid, const Cells& from, std::optional<int64_t> iterations, Cells& to) {
    to = from;
    if (iterations) return fill_steps(grid, from, *iterations, to);
    std::vector<uint8_t> seen(grid.cells());
    std::vector<int64_t> hole;
    for (int64_t k = 0; k < grid.cells(); k++)
        if (!from.known[k] && !seen[k]) fill_hole(grid, from, k, hole, seen, to);
}

// By the exact distance; of equally near cells the one with the lowest index.
void filters::inpaint_nearest(const FilterGrid& grid, const Cells& from, Cells& to) {
    const int64_t H = grid.H, W = grid.W, none = 2 * (H + W);
    std::vector<int64_t> row_of(grid.cells(), none);  // of the nearest known cell in the same column
    for (int64_t j = 0; j < W; j++) {
        int64_t last = -none;
        for (int64_t i = 0; i < H; i++) row_of[i * W + j] = last = from.known[i * W + j] ? i : last;
        last = none + H;
        for (int64_t i = H - 1; i >= 0; i--) {
            int64_t& row = row_of[i * W + j];
            last = from.known[i * W + j] ? i : last;
            if (last - i < i - row) row = last;
        }
    }
    to = from;
    for (int64_t k = 0; k < grid.cells(); k++) {
        if (from.known[k]) continue;
        const int64_t i = k / W, j = k % W;
        int64_t best = INT64_MAX, source = -1;
        for (int64_t d = 0; d < W && d * d <= best; d++)
            for (int64_t column : {j - d, j + d}) {
                if (column < 0 || column >= W) continue;
                const int64_t row = row_of[i * W + column], square = d * d + (row - i) * (row - i);
                if (row < 0 || row >= H) continue;
                const int64_t n = row * W + column;
                if (square < best || (square == best && n < source)) best = square, source = n;
            }
        if (source >= 0) to.values[k] = from.values[source], to.known[k] = 1;
    }
}

void filters::fill_from(const Cells& from, const Cells& other, Cells& to) {
    to = from;
    for (size_t k = 0; k < to.values.size(); k++)
        if (!from.known[k]) to.values[k] = other.values[k], to.known[k] = other.known[k];
}
