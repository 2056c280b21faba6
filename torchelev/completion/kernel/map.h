// One map, and what lies around its cells: surroundings.py, and the sums of context.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "kernels/simd.h"
#include "weights.h"

constexpr int ROWS[] = {1, -1, 0, 0, 1, -1, 1, -1}, COLUMNS[] = {0, 0, 1, -1, 1, -1, -1, 1};
constexpr float REACHES[] = {REACH_0, REACH_1};
constexpr double RADII[] = {RADIUS_0, RADIUS_1};
constexpr int NUM_SUMS = 7;

struct Layers {
    const float *elevation, *variance, *upper_bound, *age;
    const uint8_t *known, *bounded;  // 0 or 1
    float *mean, *std;
};

// Reads one map after the other, into the same memory.
struct Map {
    const int H, W, stride;  // of the ground, which has a rim of one cell
    const double resolution;
    Layers layers;
    double level;                // [m] mean height
    float level_rest;            // [m] what a float of it lacks
    std::vector<float> ground;   // (H + 2, stride) [m], UNKNOWN where it does not count
    std::vector<int16_t> steps;  // (8, H, W)
    std::vector<double> sums;    // (H + 1, 7, W + 1), over all cells before a corner

    Map(int H, int W, double resolution)
        : H(H), W(W), stride(W + 2 + LANES), resolution(resolution), ground(size_t(H + 2) * stride, UNKNOWN),
          steps(size_t(NUM_DIRECTIONS) * H * W, 1), sums(size_t(NUM_SUMS) * (H + 1) * (W + 1)) {}

    void read(const Layers& its_layers) {
        layers = its_layers;
        double total = 0;
        int64_t count = 0;
        for (int i = 0; i < H; i++)
            for (int j = 0; j < W; j++) {
                const bool is_known = layers.known[i * W + j];
                const float height = is_known ? layers.elevation[i * W + j] : 0;
                ground[index(i, j)] = is_known ? height : UNKNOWN;
                total += height, count += is_known;
            }
        level = total / double(std::max<int64_t>(count, 1));
        level_rest = float(level - double(float(level)));
    }

    // How far the level is above heights [m].
    Lanes above(Lanes height) const { return (splat(float(level)) - height) + level_rest; }

    int index(int i, int j) const { return (i + 1) * stride + j + 1; }

    // The steps to the next known cell, or off the map: one where the neighbour is known, else one more than its steps.
    // Without branches, which would often be guessed wrong.
    void count_steps() {
        for (int d = 0; d < NUM_DIRECTIONS; d++)
            for (int k = 0; k < H; k++) {
                const int i = ROWS[d] > 0 ? H - 1 - k : k, next = i + ROWS[d];
                if (next < 0 || next >= H) continue;
                int16_t* row = &steps[(size_t(d) * H + i) * W];
                const uint8_t* is_known = layers.known + next * W;
                if (ROWS[d] == 0) {
                    int last = -1;  // in the order of n
                    for (int n = 0; n < W; n++) {
                        const int j = COLUMNS[d] < 0 ? n : W - 1 - n;
                        row[j] = int16_t(n - last);
                        last = std::max(last, is_known[j] * (n + 1) - 1);
                    }
                } else {
                    const int16_t* ahead = &steps[(size_t(d) * H + next) * W] + COLUMNS[d];
                    const int first = std::max(0, -COLUMNS[d]), last = W - std::max(0, COLUMNS[d]);
                    is_known += COLUMNS[d];
#pragma GCC ivdep
                    for (int j = first; j < last; j++) row[j] = int16_t(ahead[j] * (1 - is_known[j]) + 1);
                }
            }
    }

    size_t row_of_sums(int layer, int i) const { return (size_t(i) * NUM_SUMS + layer) * (W + 1); }

    void sum_layers() {
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

    // Values of the cells from those of all cells of some rows, or of the map.
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
        around.known[d] = one_if(is_known), around.height[d] = pick(is_known, height, splat(0));
        around.distance[d] = pick(is_known, run, splat(0));
        for (int r = 0; r < NUM_REACHES; r++) {
            const int more = std::max(3, int(std::nearbyint(REACHES[r] / length)));
            const Lanes far = read(steps + more);
            around.has_slope[r][d] = one_if(far < UNKNOWN);
            around.slope[r][d] = pick(far < UNKNOWN, (height - far) * (1 / (more * length)), splat(0));
        }
    }
}
