// Cells of other floors than the robot's, on a GPU: stages/overlap/clear.py. A block for each part of a map.

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "floor.h"
#include "threads.h"

constexpr int32_t PART = 4096;  // cells

// Maps (B, H, W) whose masks are bytes; what is left of them; and the numbers (B) of the cells cleared.
struct Layers {
    const float *elevation, *upper_bound, *time;
    const uint8_t *validity, *bounded, *challenger_support;
    uint8_t *new_validity, *new_bounded, *new_challenger_support;
    int64_t* numbers;
};

// The cells' places as seen from the bases (B, H) and (B, W), and the bases' heights (B) [m].
struct Around {
    const float *x, *y, *z;
};

// The sums of a part of a map that its ground is made of: `ground_of`.
struct Sums {
    Total all, within, hit;
};

// A block's part of a map.
struct Part {
    int64_t map;
    int32_t first, end, columns;

    Part(int64_t H, int64_t W) : columns(int32_t(W)) {
        const int32_t cells = int32_t(H * W), parts = (cells + PART - 1) / PART;
        map = unsigned(blockIdx.x) / unsigned(parts);
        first = int32_t(unsigned(blockIdx.x) % unsigned(parts)) * PART, end = std::min(cells, first + PART);
    }
    // Call `look(place, square)` with this thread's cells and the squares [m^2] of their distances from the base.
    template <class Look> void each(const Around& around, int64_t H, const Look& look) const {
        for (int32_t k = first + threadIdx.x; k < end; k += blockDim.x) {
            const float x = around.x[map * H + k / columns], y = around.y[map * columns + k % columns];
            look(map * H * columns + k, x * x + y * y);
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
    const float z = around.z[part.map];
    Sums own{};
    part.each(around, H, [&](int64_t place, float square) {
        const float height = layers.elevation[place] - z;
        if (!(square <= s.radius_square && layers.validity[place] && height <= 0)) return;
        const float spread = square + stance * stance, weight = 1 / (spread * spread), moment = weight * height;
        own.all.weight += weight;
        if (height >= -s.max_base_height) own.within.weight += weight, own.within.moment += moment;
        if (layers.time[place] == 0) own.hit.weight += weight, own.hit.moment += moment;
    });
    float* memory = reinterpret_cast<float*>(block_memory());
    own = {sum_of_block(own.all, memory), sum_of_block(own.within, memory), sum_of_block(own.hit, memory)};
    if (threadIdx.x == 0) sums[blockIdx.x] = own;
}

// Clear the cells and bounds of other floors.
extern "C" __global__ void clear_other_floors(Around around, Layers layers, const Sums* sums, int64_t H, int64_t W,
                                              Settings s) {
    const Part part(H, W);
    const int64_t parts = (H * W + PART - 1) / PART;
    Sums all{};
    for (int64_t p = part.map * parts; p < (part.map + 1) * parts; p++) {
        all.all.weight += sums[p].all.weight;
        all.within.weight += sums[p].within.weight, all.within.moment += sums[p].within.moment;
        all.hit.weight += sums[p].hit.weight, all.hit.moment += sums[p].hit.moment;
    }
    const Floor floor(ground_of(all.all, all.within, all.hit, s), s);
    const float z = around.z[part.map];
    int32_t number = 0;
    part.each(around, H, [&](int64_t place, float square) {
        const bool near = square <= s.radius_square, known = layers.validity[place], bounded = layers.bounded[place];
        const float allowance = known && layers.time[place] == 0 ? std::sqrt(square) * s.slope : 0;
        const bool other = near && known && floor.is_outside(layers.elevation[place] - z, allowance);
        const bool other_bound = other || (near && bounded && floor.is_outside(layers.upper_bound[place] - z, 0.0f));
        layers.new_validity[place] = known && !other, layers.new_bounded[place] = bounded && !other_bound;
        layers.new_challenger_support[place] = other ? 0 : layers.challenger_support[place];
        number += other;
    });
    add_of_warp(&layers.numbers[part.map], number);
}
