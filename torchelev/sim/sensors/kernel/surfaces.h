// The surface of a cell: surfaces.py; and where rays meet it: crossing.py.
#pragma once

#include "kernels/simd.h"

enum Surface { BILINEAR, RISING, FALLING };  // in the order of surfaces.py

// z = a + b u + c v + d f(u, v)
struct Coefficients {
    Lanes a, b, c, d;
};

// Those of a cell, by its first sample; rows of samples are `width` long.
inline Coefficients coefficients(const float* samples, Flags first, int width) {
    const Lanes a = gather(samples, first), b = gather(samples, first + width) - a, c = gather(samples, first + 1) - a;
    return {a, b, c, gather(samples, first + width + 1) - a - b - c};
}

template <Surface surface> inline Lanes height(const Coefficients& at, Lanes u, Lanes v) {
    if constexpr (surface == BILINEAR) return at.a + at.b * u + (at.c + at.d * u) * v;
    const Lanes bend = surface == RISING ? smaller(u, v) : larger(u + v - 1, splat(0));
    return at.a + at.b * u + at.c * v + at.d * bend;
}

struct Meeting {
    Lanes over;   // [m] height of the ray's entry over the surface
    Lanes ahead;  // [m] along the ray to the surface; less than 0, infinite or NaN where there is no hit
    Lanes above;  // [m] height over the surface where the ray leaves the cell
};

// A plane below the ray, which meets it from `begin` to `end` metres ahead.
struct Plane {
    Lanes over, sinking, begin, end;

    Plane(Lanes over, Lanes sinking) : over(over), sinking(sinking) {
        const Lanes crossing = over / sinking, endless = splat(__builtin_inff());
        begin = pick(over <= 0, splat(0), pick(sinking > 0, crossing, endless));
        end = pick(sinking < 0, crossing, endless);
    }
};

inline Meeting meet_bilinear(const Coefficients& at, Lanes u, Lanes v, Lanes z, const Lanes* step, Lanes leave) {
    const Lanes slope_x = at.b + at.d * v, over = z - at.a - slope_x * u - at.c * v;
    const Lanes sinking = slope_x * step[0] + (at.c + at.d * u) * step[1] - step[2];
    const Lanes bend = at.d * step[0] * step[1];
    const Lanes ahead = 2 * over / (sinking + root(sinking * sinking + 4 * bend * over));
    return {over, ahead, over - leave * (sinking + bend * leave)};
}

// The ground is the upper or the lower one of the planes of both triangles.
template <bool is_falling>
inline Meeting meet_triangles(const Coefficients& at, Lanes u, Lanes v, Lanes z, const Lanes* step, Lanes leave) {
    const Lanes over = z - at.a - at.b * u - at.c * v, sinking = at.b * step[0] + at.c * step[1] - step[2];
    const Plane first(is_falling ? over : over - at.d * v, is_falling ? sinking : sinking + at.d * step[1]);
    const Plane second(over - at.d * (is_falling ? u + v - 1 : u),
                       sinking + at.d * (is_falling ? step[0] + step[1] : step[0]));
    const Flags is_lower = is_falling ? at.d < 0 : at.d > 0;
    const Lanes both = larger(first.begin, second.begin), either = smaller(first.begin, second.begin);
    const Lanes below = pick(both <= smaller(first.end, second.end), both, splat(__builtin_inff()));
    const Lanes one = first.over - leave * first.sinking, other = second.over - leave * second.sinking;
    return {pick(is_lower, larger(first.over, second.over), smaller(first.over, second.over)),
            pick(is_lower, below, either), pick(is_lower, larger(one, other), smaller(one, other))};
}

template <Surface surface>
inline Meeting meet(const Coefficients& at, Lanes u, Lanes v, Lanes z, const Lanes* step, Lanes leave) {
    if constexpr (surface == BILINEAR) return meet_bilinear(at, u, v, z, step, leave);
    return meet_triangles<surface == FALLING>(at, u, v, z, step, leave);
}
