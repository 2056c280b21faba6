// One map, and what the prediction at all its cells shares: surroundings.py and context.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "../lanes.h"
#include "weights.h"

constexpr int ROWS[] = {1, -1, 0, 0, 1, -1, 1, -1}, COLUMNS[] = {0, 0, 1, -1, 1, -1, -1, 1};
constexpr float REACHES[] = {REACH_0, REACH_1};
constexpr double RADII[] = {RADIUS_0, RADIUS_1};
constexpr int16_t NONE = 32767;  // steps; maps are smaller
constexpr int NUM_SUMS = 7;

struct Layers {
    const float *elevation, *variance, *upper_bound, *age;
    const bool *known, *bounded;
    float *mean, *std;
};

struct Map {
    const Layers layers;
    const int H, W, stride;  // of the ground, which has a rim of one cell
    const double resolution;
    double level = 0;            // [m] mean height
    std::vector<float> ground;   // (H + 2, stride) [m], UNKNOWN where it does not count
    std::vector<int16_t> steps;  // (8, H, W)
    std::vector<double> sums;    // (7, H + 1, W + 1), over all cells before a corner

    Map(const Layers& layers, int H, int W, double resolution)
        : layers(layers), H(H), W(W), stride(W + 2 + LANES), resolution(resolution) {
        ground.assign(size_t(H + 2) * stride, UNKNOWN);
        double total = 0;
        int64_t count = 0;
        for (int i = 0; i < H; i++)
            for (int j = 0; j < W; j++)
                if (layers.known[i * W + j]) {
                    const float height = layers.elevation[i * W + j];
                    ground[index(i, j)] = height;
                    total += height, count++;
                }
        level = total / double(std::max<int64_t>(count, 1));
    }

    int index(int i, int j) const { return (i + 1) * stride + j + 1; }

    // The steps to the next known cell: one where the neighbour is known, else one more than the neighbour's.
    void count_steps() {
        steps.assign(size_t(NUM_DIRECTIONS) * H * W, NONE);
        for (int d = 0; d < NUM_DIRECTIONS; d++)
            for (int k = 0; k < H; k++) {
                const int i = ROWS[d] > 0 ? H - 1 - k : k, next = i + ROWS[d];
                if (next < 0 || next >= H) continue;
                int16_t* row = &steps[(size_t(d) * H + i) * W];
                const int16_t* ahead = &steps[(size_t(d) * H + next) * W] + COLUMNS[d];
                const bool* is_known = layers.known + next * W + COLUMNS[d];
                const int first = std::max(0, -COLUMNS[d]), last = W - std::max(0, COLUMNS[d]);
                auto step = [&](int j) {
                    const int16_t more = std::min<int16_t>(ahead[j], NONE - 1) + 1;
                    row[j] = is_known[j] ? 1 : more;
                };
                if (COLUMNS[d] > 0 && ROWS[d] == 0)
                    for (int j = last; j-- > first;) step(j);
                else
                    for (int j = first; j < last; j++) step(j);
            }
    }

    size_t row_of_sums(int layer, int i) const { return (size_t(layer) * (H + 1) + i) * (W + 1); }

    void sum_layers() {
        sums.assign(size_t(NUM_SUMS) * (H + 1) * (W + 1), 0.0);
        for (int i = 0; i < H; i++) {
            double row[NUM_SUMS] = {};
            const double* above[NUM_SUMS];
            double* below[NUM_SUMS];
            for (int k = 0; k < NUM_SUMS; k++)
                above[k] = &sums[row_of_sums(k, i) + 1], below[k] = &sums[row_of_sums(k, i + 1) + 1];
            for (int j = 0; j < W; j++) {
                const float* here = &ground[index(i, j)];
                if (*here < UNKNOWN) {
                    const double z = *here - level;
                    for (int to : {-stride, -1, 1, stride})
                        if (here[to] < UNKNOWN) row[2] += 1, row[3] += std::fabs(double(here[to]) - double(*here));
                    row[0] += 1, row[4] += z, row[5] += z * z, row[6] += z * z * z;
                } else
                    row[1] += layers.bounded[i * W + j];
                for (int k = 0; k < NUM_SUMS; k++) below[k][j] = above[k][j] + row[k];
            }
        }
    }
};

// LANES cells of a map.
struct Cells {
    Flags row, column;
    bool adjacent;  // one row's cells side by side: what they read lies in memory so, too

    // Values of the cells from those of all cells of the row, or of the map.
    template <class Value> auto read(const Value* values, Flags place) const {
        return adjacent ? load_as<Value>(values + place[0]) : gather(values, place);
    }
};

// The known ground in eight directions.
struct Surroundings {
    Lanes known[NUM_DIRECTIONS], distance[NUM_DIRECTIONS], height[NUM_DIRECTIONS];
    Lanes slope[NUM_REACHES][NUM_DIRECTIONS], has_slope[NUM_REACHES][NUM_DIRECTIONS];
};

inline void look_around(const Map& map, const Cells& cells, Surroundings& around) {
    const Flags place = cells.row * map.W + cells.column;
    const Flags here = (cells.row + 1) * map.stride + cells.column + 1;
    for (int d = 0; d < NUM_DIRECTIONS; d++) {
        const int stride = ROWS[d] * map.stride + COLUMNS[d];
        const float length = float(map.resolution) * std::sqrt(float(ROWS[d] * ROWS[d] + COLUMNS[d] * COLUMNS[d]));
        const Flags down = ROWS[d] > 0 ? map.H - 1 - cells.row : cells.row;
        const Flags right = COLUMNS[d] > 0 ? map.W - 1 - cells.column : cells.column;
        const Flags room = ROWS[d] == 0 ? right : COLUMNS[d] == 0 ? down : (down < right ? down : right);
        auto read = [&](Flags k) {  // the height k steps on; the first cell of the ground is on the rim, UNKNOWN
            const Flags index = k <= room ? here + k * stride : Flags{};
            return gather(map.ground.data(), index);
        };
        const Flags steps = cells.read(&map.steps[size_t(d) * map.H * map.W], place);
        const Lanes height = read(steps), run = __builtin_convertvector(steps, Lanes) * length;
        const Flags is_known = height < UNKNOWN;
        around.known[d] = one_if(is_known), around.height[d] = pick(is_known, height, all(0));
        around.distance[d] = pick(is_known, run, all(0));
        for (int r = 0; r < NUM_REACHES; r++) {
            const int more = std::max(3, int(std::nearbyint(REACHES[r] / length)));
            const Lanes far = read(steps + more);
            around.has_slope[r][d] = one_if(far < UNKNOWN);
            around.slope[r][d] = pick(far < UNKNOWN, (height - far) * (1 / (more * length)), all(0));
        }
    }
}

// The squares around the cells of a row, as the network sees them; mean heights count from the map's level [m].
struct Squares {
    std::vector<float> known[NUM_RADII], bounded[NUM_RADII], step[NUM_RADII], std[NUM_RADII], skewness[NUM_RADII];
    std::vector<double> mean[NUM_RADII];
};

inline Squares describe(const Map& map, int i) {
    const int W = map.W, padded = (W + LANES - 1) / LANES * LANES;
    Squares of_row;
    std::vector<double> squares(size_t(NUM_SUMS) * W);
    for (int r = 0; r < NUM_RADII; r++) {
        const int half = std::max(1, int(std::nearbyint(RADII[r] / map.resolution)));
        const int top = std::max(i - half, 0), bottom = std::min(i + half + 1, map.H);
        std::vector<double> band(W + 2 * half + 1);  // over its rows and all columns before; the map's sides are repeated
        for (int k = 0; k < NUM_SUMS; k++) {
            const double *above = &map.sums[map.row_of_sums(k, top)], *below = &map.sums[map.row_of_sums(k, bottom)];
            for (int j = 0; j <= W; j++) band[half + j] = below[j] - above[j];
            std::fill(band.end() - half, band.end(), band[half + W]);
            for (int j = 0; j < W; j++) squares[k * W + j] = band[j + 2 * half + 1] - band[j];
        }
        for (auto* values : {&of_row.known[r], &of_row.bounded[r], &of_row.step[r], &of_row.std[r],
                             &of_row.skewness[r]})
            values->assign(padded, 0.0f);
        of_row.mean[r].assign(padded, 0.0);
        const double* sums = squares.data();
        float *known = of_row.known[r].data(), *bounded = of_row.bounded[r].data(), *step = of_row.step[r].data();
        float *std = of_row.std[r].data(), *skewness = of_row.skewness[r].data();
        double* means = of_row.mean[r].data();
        const double per_area = 1 / (double(2 * half + 1) * (2 * half + 1));
#pragma GCC ivdep
        for (int j = 0; j < W; j++) {
            const double count = sums[j], pairs = sums[2 * W + j];
            const double per_cell = 1 / (count > 1 ? count : 1), mean = sums[4 * W + j] * per_cell;
            const double square = sums[5 * W + j] * per_cell - mean * mean, variance = square > 0 ? square : 0;
            const double third = sums[6 * W + j] * per_cell - 3 * mean * variance - mean * mean * mean;
            const float spread = __builtin_sqrtf(float(variance) + float(SMALLEST_STD * SMALLEST_STD));
            known[j] = float(count * per_area), bounded[j] = float(sums[W + j] * per_area);
            step[j] = float(sums[3 * W + j] / (pairs > 1 ? pairs : 1));
            std[j] = spread - float(SMALLEST_STD);
            skewness[j] = float(third) / (spread * spread * spread);
            means[j] = mean;
        }
        for (int j = 0; j < padded; j += LANES) {
            store(step + j, squash(load(step + j), SMALL_STEP));
            store(std + j, squash(load(std + j), SQUASH));
        }
    }
    return of_row;
}

// Write the features of squares whose mean heights are `means` [m]; `read` takes values of cells from those of the row.
template <class Read>
inline void write_features(const Squares& of_row, const Lanes* means, const Read& read, Lanes* features) {
    for (int r = 0; r < NUM_RADII; r++) {
        const Lanes values[] = {read(of_row.known[r]),      read(of_row.bounded[r]), read(of_row.step[r]),
                                squash(means[r], SQUASH), read(of_row.std[r]),     read(of_row.skewness[r])};
        for (int k = 0; k < 6; k++) features[k * NUM_RADII + r] = values[k];
    }
}
