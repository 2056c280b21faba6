// Cells of other floors than the robot's, on a GPU: stages/overlap/clear.py. A block for each part of a map.

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "floor.h"
#include "threads.h"

constexpr int32_t PART = 4096;  // cells

// Maps (B, H, W), of which the bytes change: masks and a count; and the numbers (B) of the cells cleared.
struct Layers {
    const float *elevation, *upper_bound, *time;
    uint8_t *validity, *bounded, *challenger_support;
    int64_t* numbers;

    // The layers from a cell on.
    Layers from(int64_t cell) const {
        return {elevation + cell, upper_bound + cell,        time + cell, validity + cell,
                bounded + cell,   challenger_support + cell, numbers};
    }
};

// The cells' places as seen from the bases (B, H) and (B, W), and the bases' heights (B) [m].
struct Around {
    const float *x, *y, *z;
};

// The sums of a part of a map that its ground is made of: `ground_of`.
struct Sums {
    float weight;
    Total within, hit;
};

// A block's part of a map.
struct Part {
    int64_t map;
    int32_t first, end, rows, columns;

    Part(int64_t H, int64_t W) : rows(int32_t(H)), columns(int32_t(W)) {
        const int32_t cells = rows * columns, parts = (cells + PART - 1) / PART;
        map = unsigned(blockIdx.x) / unsigned(parts);
        first = int32_t(unsigned(blockIdx.x) % unsigned(parts)) * PART, end = std::min(cells, first + PART);
    }
    // Call `look(cell, square)` with this thread's cells of the map and the squares [m^2] of their distances.
    template <class Look> void each(const Around& around, const Look& look) const {
        const float *x = around.x + map * rows, *y = around.y + map * columns;
        const int32_t step = blockDim.x, step_rows = step / columns, step_columns = step % columns;
        int32_t i = (first + int32_t(threadIdx.x)) / columns, j = (first + int32_t(threadIdx.x)) % columns;
#pragma unroll 2
        for (int32_t cell = first + threadIdx.x; cell < end; cell += step) {
            look(cell, x[i] * x[i] + y[j] * y[j]);
            i += step_rows, j += step_columns;
            if (j >= columns) i++, j -= columns;
        }
    }
};

inline Total sum_of_block(Total own, float* memory) {
    return {sum_of_block(own.weight, memory), sum_of_block(own.moment, memory)};
}

// Sum up what lies below the bases, for each part of each map.
extern "C" __global__ void sum_below(Around around, Layers layers, Sums* sums, int64_t H, int64_t W, float stance,
                                     Settings s) {
    const Part part(H, W);
    const Layers map = layers.from(part.map * H * W);
    const float z = around.z[part.map];
    Sums own{};
    part.each(around, [&](int32_t cell, float square) {
        const float height = map.elevation[cell] - z, time = map.time[cell];
        if (!(square <= s.radius_square && map.validity[cell] && height <= 0)) return;
        const float spread = square + stance * stance, weight = 1 / (spread * spread), moment = weight * height;
        own.weight += weight;
        if (height >= -s.max_base_height) own.within.weight += weight, own.within.moment += moment;
        if (time == 0) own.hit.weight += weight, own.hit.moment += moment;
    });
    float* memory = reinterpret_cast<float*>(block_memory());
    own = {sum_of_block(own.weight, memory), sum_of_block(own.within, memory), sum_of_block(own.hit, memory)};
    if (threadIdx.x == 0) sums[blockIdx.x] = own;
}

// Clear the cells and bounds of other floors.
extern "C" __global__ __launch_bounds__(512, 3) void clear_other_floors(Around around, Layers layers, const Sums* sums,
                                                                        int64_t H, int64_t W, Settings s) {
    const Part part(H, W);
    const int64_t parts = (H * W + PART - 1) / PART;
    Sums all{};
    for (int64_t p = part.map * parts; p < (part.map + 1) * parts; p++) {
        all.weight += sums[p].weight;
        all.within.weight += sums[p].within.weight, all.within.moment += sums[p].within.moment;
        all.hit.weight += sums[p].hit.weight, all.hit.moment += sums[p].hit.moment;
    }
    const Floor floor(ground_of(all.weight, all.within, all.hit, s), s);
    const Layers map = layers.from(part.map * H * W);
    const float z = around.z[part.map];
    int32_t number = 0;
    part.each(around, [&](int32_t cell, float square) {
        const bool near = square <= s.radius_square, known = map.validity[cell], bounded = map.bounded[cell];
        const float height = map.elevation[cell] - z, bound = map.upper_bound[cell] - z;
        const float allowance = known && map.time[cell] == 0 ? std::sqrt(square) * s.slope : 0;
        const bool other = near & known & floor.is_outside(height, allowance);
        const bool other_bound = other | (near & bounded & floor.is_outside(bound, 0.0f));
        if (other) map.validity[cell] = 0, map.challenger_support[cell] = 0;
        if (other_bound) map.bounded[cell] = 0;
        number += other;
    });
    add_of_warp(&layers.numbers[part.map], number);
}
