// The distances that rays measure: casting.py.

#include <algorithm>
#include <cstddef>
#include <iterator>
#include <vector>

#include "kernels/threads.h"
#include "boxes.h"
#include "field.h"
#include "order.h"

namespace {

constexpr int AT_A_TIME = 1024;           // rays that a thread takes
constexpr float FARTHEST = 8388608.0f;  // [cells] float32 cannot count cells farther out, where the ground is level

// Traces rays from one origin; a lane takes the next ray as soon as its own has ended. Two groups of lanes take turns, so
// that one computes while the other one waits for memory. Nothing branches on single lanes, and jumps and crossings
// alternate in a fixed order: processors cannot foresee what rays need.
template <Surface surface> class Tracer {
    static constexpr int JUMPS = 4;  // before each crossing

    struct Group {
        Rays rays;
        int32_t ray[LANES];  // of each lane
        Lanes measured{};
        Flags active = ~Flags{}, ends = ~Flags{};
    };

    const Field& field;
    const float* directions;
    const int count;
    const float max_range;
    const int max_turns;  // a ray crosses at most two borders per cell length, and may try to jump before each
    float* distance;
    Group groups[2];
    int next = 0;

    void cross_cells(Group& group) {
        Rays& rays = group.rays;
        const Flags hits = cross<surface>(field, rays, group.active & (rays.level < 0));
        rays.turns += 1;
        group.ends = group.active & (hits | (rays.along > max_range) | (rays.turns > max_turns));
        group.measured = pick(group.ends, pick(hits, rays.along, splat(__builtin_inff())), group.measured);
    }

    void take_next(Group& group) {
        for (int l = 0; l < LANES; l++) {
            distance[group.ray[l]] = group.measured[l];  // a ray that is on its way is overwritten at its end
            const bool takes = group.ends[l] & (next < count);
            group.active[l] &= -int(takes | !group.ends[l]);
            group.ray[l] = takes ? next : group.ray[l], next += takes;
        }
    }

    Tracer(const Field& field, const float* origin, const float* directions, int count, float resolution,
           float max_range, float* distance)
        : field(field), directions(directions), count(count), max_range(max_range),
          max_turns(int(std::min(1e9f, 64 + 8 * max_range / resolution))), distance(distance),
          groups{{{origin, resolution}}, {{origin, resolution}}} {
        for (Group& group : groups)
            for (int32_t& ray : group.ray) ray = std::min(next++, count - 1);  // some lanes may have the same one
    }

    void run() {
        while (any(groups[0].active | groups[1].active)) {
            for (Group& group : groups) group.rays.begin(group.ends, directions, group.ray);
            for (int k = 0; k < JUMPS; k++)
                for (Group& group : groups) jump(field, group.rays, group.active & (group.rays.level >= 0));
            for (Group& group : groups) cross_cells(group), take_next(group);
        }
    }

  public:
    static void trace(const Field& field, const float* origin, const float* directions, int count, float resolution,
                      float max_range, float* distance) {
        Tracer(field, origin, directions, count, resolution, max_range, distance).run();
    }
};

// Return the boxes of an environment that rays of `max_range` can reach.
std::vector<Box> select_near(const Box* boxes, int num_boxes, float max_range) {
    std::vector<Box> near;
    std::copy_if(boxes, boxes + num_boxes, std::back_inserter(near), [&](const Box& box) { return can_reach(box, max_range); });
    return near;
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

// K tiles, and how rays are traced there.
struct Tiles {
    const float *heights, *bounds;
    const int64_t *levels, *sizes;
    int rows, columns;
    Surface surface;
    float resolution, max_range;

    Field field(int64_t tile) const {
        Field field{heights + tile * (rows + 1) * (columns + 1), bounds + tile * sizes[0], {}, rows, columns};
        for (int l = 0; l <= TOP; l++) field.offset[l] = int32_t(levels[l] + tile * sizes[l] - tile * sizes[0]);
        return field;
    }

    void trace_from(int64_t tile, const float* origin, const float* directions, int count, float* distance) const {
        const auto trace = surface == BILINEAR ? Tracer<BILINEAR>::trace
                           : surface == RISING ? Tracer<RISING>::trace
                                               : Tracer<FALLING>::trace;
        trace(field(tile), origin, directions, count, resolution, max_range, distance);
    }

    // A place [m] in the frame of a tile, in cells and metres as rays start there: casting.py.
    void place(const float* xyz, int step, float* origin) const {
        for (int k = 0; k < 3; k++) {
            const float middle = k < 2 ? 0.5f * (k ? columns : rows) : 0, x = xyz[k * step];
            origin[k] = k < 2 ? x / resolution + middle : x;
            if (!__builtin_isfinite(origin[k])) origin[k] = 0;
            if (k < 2) origin[k] = std::min(std::max(origin[k], -FARTHEST), FARTHEST);
        }
    }
};

// Turn unit vectors (count, 3) with the rotation of a pose (4, 4).
void turn(const float* pose, const float* rays, int count, float* directions) {
    for (int k = 0; k < count; k++)
        for (int row = 0; row < 3; row++) {
            const float *r = pose + 4 * row, *ray = rays + 3 * k;
            directions[3 * k + row] = r[0] * ray[0] + r[1] * ray[1] + r[2] * ray[2];
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
    const Tiles all{heights, bounds, levels, sizes, rows, columns, Surface(surface), resolution, max_range};
    const int parts = (M + AT_A_TIME - 1) / AT_A_TIME;
    return code_of([&] {
        const std::vector<int> order = order_by_tile(tiles, B);
        for_each(B * parts, num_threads, [&](int task) {
            const size_t b = order[task / parts], first = b * M + task % parts * AT_A_TIME;
            const int count = std::min(AT_A_TIME, M - task % parts * AT_A_TIME);
            all.trace_from(tiles[b], origins + 3 * b, directions + 3 * first, count, distance + first);
            const std::vector<Box> near = select_near(boxes + b * num_boxes, num_boxes, max_range);
            if (!near.empty()) stop_at_boxes(near.data(), int(near.size()), directions + 3 * first, count, distance + first);
        });
    });
}

// Points (B, M, 3) that sensors see, NaN where nothing is hit from `min_range` to `max_range`. `poses` are (B, 4, 4),
// `rays` (M, 3) unit vectors, both of the sensor's frame.
extern "C" int see(const float* heights, const float* bounds, const int64_t* levels, const int64_t* sizes,
                   const int64_t* tiles, const float* poses, const float* rays, float* points, int surface, int rows,
                   int columns, int B, int M, float resolution, float min_range, float max_range, int num_threads) {
    const Tiles all{heights, bounds, levels, sizes, rows, columns, Surface(surface), resolution, max_range};
    const int parts = (M + AT_A_TIME - 1) / AT_A_TIME;
    struct Part {
        float directions[3 * AT_A_TIME], distance[AT_A_TIME];
    };
    return code_of([&] {
        const std::vector<int> order = order_by_tile(tiles, B);
        const auto make = [] { return std::vector<Part>(1); };
        for_each(B * parts, num_threads, make, [&](int task, std::vector<Part>& own) {
            const size_t b = order[task / parts], offset = task % parts * AT_A_TIME, first = b * M + offset;
            const int count = std::min(AT_A_TIME, int(M - offset));
            const float *pose = poses + 16 * b, *ray = rays + 3 * offset;
            float origin[3], *distance = own[0].distance;
            all.place(pose + 3, 4, origin);
            turn(pose, ray, count, own[0].directions);
            all.trace_from(tiles[b], origin, own[0].directions, count, distance);
            const bool is_placed = __builtin_isfinite(pose[3] + pose[7] + pose[11]);
            for (int k = 0; k < count; k++) {
                const bool is_seen = is_placed & (distance[k] >= min_range) & (distance[k] <= max_range);
                for (int c = 0; c < 3; c++)
                    points[3 * (first + k) + c] = is_seen ? ray[3 * k + c] * distance[k] : __builtin_nanf("");
            }
        });
    });
}
