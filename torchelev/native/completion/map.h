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
constexpr int NUM_SUMS = 8;      // the last one fills a cache line

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
    std::vector<double> sums;    // (H + 1, W + 1, 8), over all cells before a corner

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

    void sum_layers() {
        sums.assign(size_t(H + 1) * (W + 1) * NUM_SUMS, 0.0);
        for (int i = 0; i < H; i++) {
            double row[NUM_SUMS] = {};
            const double* above = &sums[size_t(i) * (W + 1) * NUM_SUMS];
            double* below = &sums[size_t(i + 1) * (W + 1) * NUM_SUMS];
            for (int j = 0; j < W; j++) {
                const float* here = &ground[index(i, j)];
                if (*here < UNKNOWN) {
                    const double z = *here - level;
                    for (int to : {-stride, -1, 1, stride})
                        if (here[to] < UNKNOWN) row[2] += 1, row[3] += std::fabs(double(here[to]) - double(*here));
                    row[0] += 1, row[4] += z, row[5] += z * z, row[6] += z * z * z;
                } else
                    row[1] += layers.bounded[i * W + j];
                above += NUM_SUMS, below += NUM_SUMS;
                for (int k = 0; k < NUM_SUMS; k++) below[k] = above[k] + row[k];
            }
        }
    }
};

// LANES cells of a map.
struct Cells {
    Flags row, column;
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
        const Flags steps = gather(&map.steps[size_t(d) * map.H * map.W], place);
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

// The squares around cells; `mean` is relative to the map's level [m].
struct Context {
    Lanes known[NUM_RADII], bounded[NUM_RADII], step[NUM_RADII], std[NUM_RADII], skewness[NUM_RADII];
    double mean[NUM_RADII][LANES];
};

inline void describe(const Map& map, const Cells& cells, Context& context) {
    typedef double Sums __attribute__((vector_size(8 * NUM_SUMS)));
    for (int r = 0; r < NUM_RADII; r++) {
        const int half = std::max(1, int(std::nearbyint(RADII[r] / map.resolution)));
        const double area = double(2 * half + 1) * (2 * half + 1);
        double sums[NUM_SUMS][LANES];
        for (int l = 0; l < LANES; l++) {
            const int top = std::max(cells.row[l] - half, 0), bottom = std::min(cells.row[l] + half + 1, map.H);
            const int left = std::max(cells.column[l] - half, 0);
            const int right = std::min(cells.column[l] + half + 1, map.W);
            auto corner = [&](int i, int j) {
                Sums values;
                std::memcpy(&values, &map.sums[(size_t(i) * (map.W + 1) + j) * NUM_SUMS], sizeof values);
                return values;
            };
            const Sums square = corner(bottom, right) - corner(bottom, left) - corner(top, right) + corner(top, left);
            for (int k = 0; k < NUM_SUMS; k++) sums[k][l] = square[k];
        }
        const double per_area = 1 / area;
        Lanes variance, third, pairs;
        for (int l = 0; l < LANES; l++) {
            const double per_cell = 1 / std::max(sums[0][l], 1.0), mean = sums[4][l] * per_cell;
            const double spread = sums[5][l] * per_cell - mean * mean;
            variance[l] = float(std::max(spread, 0.0));
            third[l] = float(sums[6][l] * per_cell - 3 * mean * std::max(spread, 0.0) - mean * mean * mean);
            context.known[r][l] = float(sums[0][l] * per_area), context.bounded[r][l] = float(sums[1][l] * per_area);
            context.step[r][l] = float(sums[3][l]), pairs[l] = float(std::max(sums[2][l], 1.0));
            context.mean[r][l] = mean;
        }
        const Lanes spread = root(variance + float(SMALLEST_STD) * float(SMALLEST_STD));
        context.step[r] /= pairs;
        context.std[r] = spread - float(SMALLEST_STD);
        context.skewness[r] = third / (spread * spread * spread);
    }
}
