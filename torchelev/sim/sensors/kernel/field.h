// Rays against a height field: tracing.py, one in each lane of a vector, each as far as it needs.
#pragma once

#include "kernels/simd.h"
#include "surfaces.h"

constexpr int TOP = 6;    // level of the bound of the whole tile; the blocks of level l have 2^l cells along a side
constexpr int FIRST = 3;  // level that a ray begins at
constexpr float TINY = 1e-9f, ENDLESS = 1e9f;

inline Lanes power_of_two(Flags exponent) { return (Lanes)((exponent + 127) << 23); }

// A tile: HeightField, and its bounds.
struct Field {
    const float* heights;  // (rows + 1, columns + 1) samples, the rim included
    const float* bounds;   // highest points of the blocks, level by level
    int32_t offset[8];     // where each level begins, and an unused one: what `look_up` takes
    int rows, columns;     // cells
};

// A ray in each lane, all from one origin: position in cells and metres as in `Rays` of tracing.py.
struct Rays {
    const float* start;        // [cells, cells, m]
    const float resolution;    // [m]
    Lanes step[3];             // change per metre along the ray
    Lanes sign[2], inverse[2];  // direction along x and y, and metres along the ray per cell
    Lanes fastest, slowness;   // metres along the ray per cell of the faster of x and y, and per metre of descent
    Lanes along{};             // [m] up to which nothing is hit
    Lanes cell[2];             // that the ray is in
    Flags level{};             // of the block to jump over; below 0: intersect the cell
    Flags turns{};             // taken so far

    Rays(const float* origin, float resolution) : start(origin), resolution(resolution) {}

    // Start the rays of some lanes; `ray` has the index of each lane's.
    void begin(Flags fresh, const float* directions, const int32_t* ray) {
        Flags first;
        std::memcpy(&first, ray, sizeof first);
        for (int k = 0; k < 3; k++) {
            const Lanes d = gather(directions + k, 3 * first);
            step[k] = pick(absolute(d) <= __FLT_MAX__, k < 2 ? d / resolution : d, splat(0));
        }
        for (int k = 0; k < 2; k++) {
            sign[k] = pick(is_negative(step[k]), splat(-1), splat(1));
            inverse[k] = 1 / larger(absolute(step[k]), splat(TINY));
            cell[k] = pick(fresh, splat(__builtin_floorf(start[k])), cell[k]);
        }
        fastest = smaller(inverse[0], inverse[1]);
        slowness = 1 / larger(-step[2], splat(TINY));
        along = zero_unless(~fresh, along);
        level = pick_int(fresh, FIRST, level), turns &= ~fresh;
    }

    Lanes at(int k, Lanes distance) const { return start[k] + distance * step[k]; }
};

// Jump over the free space of a block, and go on to larger blocks; or, where the ray meets the block's height, to
// smaller ones. See `skip` in tracing.py.
inline void jump(const Field& field, Rays& rays, Flags jumping) {
    const Flags level = jumping & rays.level, is_top = level == TOP;
    const Lanes edge = power_of_two(level), inverse_edge = power_of_two(-level), ahead = rays.along + rays.fastest * edge;
    const Flags last_row = pick_int(is_top, 0, (field.rows - 1) >> level);
    const Flags last_column = pick_int(is_top, 0, (field.columns - 1) >> level);
    const Lanes row = smaller(larger(rays.at(0, ahead) * inverse_edge, splat(0)), numbers(last_row));
    const Lanes column = smaller(larger(rays.at(1, ahead) * inverse_edge, splat(0)), numbers(last_column));
    const Flags place = look_up(field.offset, level) + integers(row) * (last_column + 1) + integers(column);
    const Lanes free = (rays.at(2, rays.along) - gather(field.bounds, place)) * rays.slowness;
    const Lanes reach = pick(is_top, splat(ENDLESS), 2 * edge) * rays.fastest;
    const Flags moves = jumping & (free >= 0.5f * rays.fastest), is_through = free >= reach;
    rays.along = pick(moves, rays.along + smaller(free, reach), rays.along);
    for (int k = 0; k < 2; k++) rays.cell[k] = pick(moves, floor_of(rays.at(k, rays.along)), rays.cell[k]);
    const Flags next = pick_int(is_through, pick_int(is_top, TOP, level + 1), level - 1);
    rays.level = pick_int(jumping, next, rays.level);
}

// Intersect the rays with the surface of their cells, and go on to the next ones. Returns which hit;
// `along` is then that distance.
template <Surface surface> inline Flags cross(const Field& field, Rays& rays, Flags crossing) {
    const Lanes u = rays.at(0, rays.along) - rays.cell[0], v = rays.at(1, rays.along) - rays.cell[1];
    const int width = field.columns + 1;
    const Flags row = integers(clamp(rays.cell[0], 0, field.rows - 1));
    const Flags first = row * width + integers(clamp(rays.cell[1], 0, field.columns - 1));
    const Lanes leave_x = larger(rays.inverse[0] * (0.5f - rays.sign[0] * (u - 0.5f)), splat(0));
    const Lanes leave_y = larger(rays.inverse[1] * (0.5f - rays.sign[1] * (v - 0.5f)), splat(0));
    const Lanes leave = smaller(leave_x, leave_y);
    const Meeting meeting = meet<surface>(coefficients(field.heights, first, width), u, v, rays.at(2, rays.along), rays.step, leave);
    const Lanes ahead = meeting.ahead;
    const Flags is_below = meeting.over <= 0, hits = crossing & (is_below | ((ahead >= 0) & (ahead <= leave)));
    const Flags through_x = leave_x <= leave_y, goes = crossing & ~hits;
    rays.along = pick(hits, rays.along + pick(is_below, splat(0), ahead), pick(goes, rays.along + leave, rays.along));
    rays.cell[0] = pick(goes & through_x, rays.cell[0] + rays.sign[0], rays.cell[0]);
    rays.cell[1] = pick(goes & ~through_x, rays.cell[1] + rays.sign[1], rays.cell[1]);
    rays.level = pick_int(goes & (meeting.above * rays.slowness > 2 * rays.fastest), 0, rays.level);
    return hits;
}
