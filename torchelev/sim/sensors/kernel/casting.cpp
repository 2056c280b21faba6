// The distances that rays measure: casting.py.

#include <algorithm>
#include <cstddef>
#include <numeric>
#include <vector>

#include "kernels/threads.h"
#include "boxes.h"
#include "field.h"

namespace {

constexpr int AT_A_TIME = 1024;  // rays that a thread takes

// Trace rays from one origin; a lane takes the next ray as soon as its own has ended.
template <Surface surface>
void trace(const Field& field, const float* origin, const float* directions, int count, float resolution,
           float max_range, float* distance) {
    // Along a unit vector a ray crosses at most two borders per cell length, and may try to jump before each.
    const int max_turns = int(std::min(1e9f, 64 + 8 * max_range / resolution));
    Rays rays{};
    Flags active{};
    int ray[LANES], next = 0;
    for (int l = 0; l < LANES && next < count; l++)
        ray[l] = next, rays.set(l, origin, directions + 3 * next++, resolution), active[l] = -1;
    for (int left; (left = count_set(active)) > 0;) {
        const Flags jumping = active & (rays.level >= 0);
        const bool jumps = 2 * count_set(jumping) > left;  // a turn is one kind of work: what more of the rays need
        if (jumps) jump(field, rays, jumping);
        const Flags hits = jumps ? Flags{} : cross<surface>(field, rays, active & ~jumping);
        rays.turns -= jumps ? jumping : active & ~jumping;
        const Flags ends = active & (hits | (rays.along > max_range) | (rays.turns > max_turns));
        if (!count_set(ends)) continue;
        for (int l = 0; l < LANES; l++) {
            if (!ends[l]) continue;
            distance[ray[l]] = hits[l] ? rays.along[l] : __builtin_inff();
            if (next < count)
                ray[l] = next, rays.set(l, origin, directions + 3 * next++, resolution);
            else
                active[l] = 0;
        }
    }
}

// Shorten distances to those of the nearest box.
void stop_at_boxes(const Box* boxes, int num_boxes, const float* directions, int count, float* distance) {
    for (int first = 0; first < count; first += LANES) {
        const int lanes = std::min(LANES, count - first);
        Lanes direction[3]{}, nearest{};
        for (int l = 0; l < lanes; l++)
            for (int k = 0; k < 3; k++) direction[k][l] = directions[3 * (first + l) + k];
        nearest = smaller(load(distance + first, lanes), distance_to_boxes(boxes, num_boxes, direction));
        store(distance + first, nearest, lanes);
    }
}

}  // namespace

// Distances (B, M) of rays from origins (B, 3) [cells, cells, m], counted from the rim of the tiles, along directions
// (B, M, 3). `heights` are (K, rows + 1, columns + 1), `bounds` and `sizes` those of `Bounds`, tile by tile within each
// level, `surface` a `Surface`. Returns what `code_of` does.
extern "C" int cast(const float* heights, const float* bounds, const int64_t* levels, const int64_t* sizes,
                    const int64_t* tiles, const float* origins, const float* directions, const Box* boxes,
                    float* distance, int surface, int rows, int columns, int B, int M, int num_boxes, float resolution,
                    float max_range, int num_threads) {
    const auto trace_surface = surface == BILINEAR ? trace<BILINEAR> : surface == RISING ? trace<RISING> : trace<FALLING>;
    const int parts = (M + AT_A_TIME - 1) / AT_A_TIME;
    return code_of([&] {
        std::vector<int> order(B);  // robots on the same tile one after the other, while it is in the caches
        std::iota(order.begin(), order.end(), 0);
        std::sort(order.begin(), order.end(), [&](int a, int b) { return tiles[a] < tiles[b]; });
        for_each(B * parts, num_threads, [&](int task) {
            const size_t b = order[task / parts], first = b * M + task % parts * AT_A_TIME;
            const int count = std::min(AT_A_TIME, M - task % parts * AT_A_TIME);
            Field field{heights + tiles[b] * (rows + 1) * (columns + 1), bounds + tiles[b] * sizes[0], {}, rows, columns};
            for (int l = 0; l <= TOP; l++)
                field.offset[l] = int32_t(levels[l] + tiles[b] * sizes[l] - tiles[b] * sizes[0]);
            trace_surface(field, origins + 3 * b, directions + 3 * first, count, resolution, max_range, distance + first);
            if (num_boxes) stop_at_boxes(boxes + b * num_boxes, num_boxes, directions + 3 * first, count, distance + first);
        });
    });
}
