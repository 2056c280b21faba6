// Means and medians of windows: filters/smoothing.py.

#include <algorithm>

#include "runtime/source/filters/filters.h"

namespace {

// Sum along one dimension: `step` from a cell to the next, `at` its place, `size` the number of cells along it.
double sum_along(const std::vector<double>& values, int64_t k, int64_t at, int64_t size, int64_t step,
                 const std::vector<double>& weights) {
    const int64_t radius = int64_t(weights.size()) - 1;
    double total = 0;
    for (int64_t d = -std::min(radius, at); d <= std::min(radius, size - 1 - at); d++)
        total += weights[d < 0 ? -d : d] * values[k + d * step];
    return total;
}

std::vector<double> window_sums(const FilterGrid& grid, std::vector<double> values, const std::vector<double>& weights) {
    std::vector<double> rows(values.size());
    for (int64_t k = 0; k < grid.cells(); k++) rows[k] = sum_along(values, k, k % grid.W, grid.W, 1, weights);
    for (int64_t k = 0; k < grid.cells(); k++) values[k] = sum_along(rows, k, k / grid.W, grid.H, grid.W, weights);
    return values;
}

}  // namespace

void filters::mean(const FilterGrid& grid, const Cells& from, const std::vector<double>& weights, Cells& to) {
    std::vector<double> values(from.values.begin(), from.values.end()), known(from.known.begin(), from.known.end());
    const std::vector<double> sums = window_sums(grid, values, weights), numbers = window_sums(grid, known, weights);
    for (int64_t k = 0; k < grid.cells(); k++) to.values[k] = from.known[k] ? float(sums[k] / numbers[k]) : 0;
    to.known = from.known;
}

void filters::median(const FilterGrid& grid, const Cells& from, int64_t radius, Cells& to) {
    std::vector<float> window;
    for (int64_t k = 0; k < grid.cells(); k++) {
        to.values[k] = 0;
        if (!from.known[k]) continue;
        const int64_t i = k / grid.W, j = k % grid.W;
        window.clear();
        for (int64_t row = std::max<int64_t>(0, i - radius); row <= std::min(grid.H - 1, i + radius); row++)
            for (int64_t n = row * grid.W + std::max<int64_t>(0, j - radius);
                 n <= row * grid.W + std::min(grid.W - 1, j + radius); n++)
                if (from.known[n]) window.push_back(from.values[n]);
        const auto above = window.begin() + window.size() / 2;
        std::nth_element(window.begin(), above, window.end());
        const float below = window.size() % 2 ? *above : *std::max_element(window.begin(), above);
        to.values[k] = 0.5f * (below + *above);
    }
    to.known = from.known;
}
