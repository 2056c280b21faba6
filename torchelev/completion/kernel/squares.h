// The squares around cells: context.py.
#pragma once

#include "map.h"

// The squares around the cells of some rows, as the network sees them; mean heights count from the map's level [m].
struct Squares {
    int first, width;  // row; length of a row in these arrays, whose last numbers may lie beyond the map
    std::vector<float> known[NUM_RADII], bounded[NUM_RADII], step[NUM_RADII], mean[NUM_RADII], std[NUM_RADII],
        skewness[NUM_RADII];
    std::vector<double> sums;

    template <class Numbers> Numbers index(Numbers i, Numbers j) const { return (i - first) * width + j; }

    void describe(const Map& map, int its_first, int end) {
        const int W = map.W;
        first = its_first, width = (W + LANES - 1) / LANES * LANES;
        sums.resize(size_t(NUM_SUMS) * W);
        for (int r = 0; r < NUM_RADII; r++) {
            for (auto* values : {&known[r], &bounded[r], &step[r], &std[r], &skewness[r], &mean[r]})
                values->resize((end - first) * width);
            for (int i = first; i < end; i++) describe_row(map, i, r, (i - first) * width);
        }
    }

    void describe_row(const Map& map, int i, int r, int at) {
        const int W = map.W, half = std::max(1, int(std::nearbyint(RADII[r] / map.resolution)));
        const int top = std::max(i - half, 0), bottom = std::min(i + half + 1, map.H);
        const int inside = std::max(W - half, 0);  // columns before it have a whole square to the right
        for (int k = 0; k < NUM_SUMS; k++) {
            const double *above = &map.sums[map.row_of_sums(k, top)], *below = &map.sums[map.row_of_sums(k, bottom)];
            double* sum = &sums[k * W];
            const double whole = below[W] - above[W];
            for (int j = 0; j < inside; j++) sum[j] = below[j + half + 1] - above[j + half + 1];
            for (int j = inside; j < W; j++) sum[j] = whole;
            for (int j = half + 1; j < W; j++) sum[j] -= below[j - half] - above[j - half];
        }
        summarise(r, at, W, 1 / (double(2 * half + 1) * (2 * half + 1)));
        for (int j = at; j < at + width; j += LANES) {
            store(&step[r][j], squash(load(&step[r][j]), SMALL_STEP));
            store(&std[r][j], squash(load(&std[r][j]), SQUASH));
        }
    }

    void summarise(int r, int at, int W, double per_area) {
        const double* from = sums.data();
        float *knowns = &known[r][at], *bounds = &bounded[r][at], *steps = &step[r][at];
        float *stds = &std[r][at], *skews = &skewness[r][at], *means = &mean[r][at];
#pragma GCC ivdep
        for (int j = 0; j < W; j++) {
            const double count = from[j], pairs = from[2 * W + j];
            const double per_cell = 1 / (count > 1 ? count : 1), mean = from[4 * W + j] * per_cell;
            const double square = from[5 * W + j] * per_cell - mean * mean, variance = square > 0 ? square : 0;
            const double third = from[6 * W + j] * per_cell - 3 * mean * variance - mean * mean * mean;
            const float spread = __builtin_sqrtf(float(variance) + float(SMALLEST_STD * SMALLEST_STD));
            knowns[j] = float(count * per_area), bounds[j] = float(from[W + j] * per_area);
            steps[j] = float(from[3 * W + j] / (pairs > 1 ? pairs : 1));
            stds[j] = spread - float(SMALLEST_STD);
            skews[j] = float(third) / (spread * spread * spread);
            means[j] = float(mean);
        }
    }
};

// Write the features of squares whose mean heights are `means` [m] into a column; `read` takes values of cells from
// those of the rows.
template <int COLUMNS, class Read>
inline void write_features(const Squares& squares, const Lanes* means, const Read& read, Lanes (*features)[COLUMNS],
                           int column) {
    for (int r = 0; r < NUM_RADII; r++) {
        const Lanes values[] = {read(squares.known[r]),   read(squares.bounded[r]), read(squares.step[r]),
                                squash(means[r], SQUASH), read(squares.std[r]),     read(squares.skewness[r])};
        for (int k = 0; k < 6; k++) features[k * NUM_RADII + r][column] = values[k];
    }
}
