// What rays say of cells: the equations of this folder's Python files. V is a float or a vector; `VisibilitySettings` are
// what `settings` of kernel.py returns.
#pragma once

#include "kernels/scalar.h"
#include "stages/visibility/polar_table.h"

namespace visibility {

// A ray by the place of its hit as seen from the sensor [m]: `sensor_rays`.
template <class V> struct Ray {
    V x, y, r, slope, azimuth;
};

template <class V> INLINE Ray<V> sensor_ray(V x, V y, V z) {
    const V r = horizontal(x, y);
    return {x, y, r, z / r, azimuth_fraction(x, y)};
}

// The last range bin that a ray reaches at least a cell before its end, negative if none, and its azimuth: `bins_of`.
template <class V> struct RayBins {
    V range, azimuth;
};

template <class V> INLINE RayBins<V> bins_of(const Ray<V>& ray, V noise, const VisibilitySettings& s) {
    const V last = smaller(floor_of((ray.r - noise) / s.resolution), splat<V>(float(s.ranges + 1))) - 2;
    const float azimuths = float(s.azimuths);
    return {last, smaller(floor_of(ray.azimuth * azimuths), splat<V>(azimuths - 1))};
}

// The angle of an azimuth of so many [rad]: `directions`.
INLINE float direction(int azimuth, int number) {
    return (float(azimuth) + 0.5f) * float(2 * 3.14159265358979323846 / number);
}

// The last bin of the horizon that limits a ray, negative if none, and its azimuth; bins are two cells long: `horizon`.
template <class V> INLINE RayBins<V> horizon_bins_of(const Ray<V>& ray, const VisibilitySettings& s) {
    const float azimuths = float(s.azimuths / 2);
    const V k = floor_of(ray.r / (2 * s.resolution)) - 1, a = floor_of(ray.azimuth * azimuths);
    return {clamp(k, -1, float(s.horizon_ranges - 1)), clamp(a, 0, azimuths - 1)};
}

// How far below an elevation a ray must pass to contradict it [m]: `height_margin`.
template <class V> INLINE V height_margin(V variance, const VisibilitySettings& s) {
    return smaller(s.gate * root(variance + s.relief), splat<V>(s.nowhere));
}

// Where a sensor stands, in the map's axes and in the window.
struct View {
    float origin[3];  // [m]
    float start[2];   // [m] from the window's corner
    float first[2];   // [cells] of the measurement's horizontal origin in the window
    float size[2];    // [cells] of the window
};

// The cell's row or column of a place [m] from the measurement's origin; outside the window, too.
template <class V> INLINE V cell_of(V place, int axis, const View& view, const VisibilitySettings& s) {
    return floor_of(place / s.resolution) + view.first[axis];
}

// Where a ray ends, or where it is half a cell short of leaving the window: `find_ends`.
template <class V> struct RayEnds {
    V i, j;            // [cells] in the window
    Flag<V> inside;    // false if the sensor is outside, too
    V reach;           // [m] horizontal distance
    Flag<V> leaves;    // the ray ends outside the window
    V side, place;     // the border that it leaves through, and the cell along it
};

// By which part of a ray's length it comes half a cell short of the border ahead.
template <class V> INLINE V share_of(V length, int axis, const View& view, const VisibilitySettings& s) {
    const Flag<V> ahead = length > 0;
    const float inner = 0.5f * s.resolution, size = view.size[axis] * s.resolution;
    const V room = pick(ahead, splat<V>(size - inner - view.start[axis]), splat<V>(inner - view.start[axis]));
    return room / pick(ahead, larger(length, splat<V>(1e-9f)), smaller(length, splat<V>(-1e-9f)));  // never by zero
}

template <class V> INLINE RayEnds<V> find_ends(const Ray<V>& ray, const View& view, const VisibilitySettings& s) {
    const V share_x = share_of(ray.x, 0, view, s), share_y = share_of(ray.y, 1, view, s);
    const V end_x = view.start[0] + ray.x, end_y = view.start[1] + ray.y;
    const Flag<V> leaves = (end_x < 0) | (end_x >= view.size[0] * s.resolution) | (end_y < 0) |
                           (end_y >= view.size[1] * s.resolution);
    const V share = pick(leaves, clamp(smaller(share_x, share_y), 0, 1), splat<V>(1));
    const V i = cell_of(view.origin[0] + share * ray.x, 0, view, s);
    const V j = cell_of(view.origin[1] + share * ray.y, 1, view, s);
    const V near_i = clamp(i, 0, view.size[0] - 1), near_j = clamp(j, 0, view.size[1] - 1);
    const Flag<V> through_x = share_x <= share_y;
    const V side = pick(through_x, pick(ray.x > 0, splat<V>(1), splat<V>(0)), pick(ray.y > 0, splat<V>(3), splat<V>(2)));
    const Flag<V> inside = (i == near_i) & (j == near_j);
    return {near_i, near_j, inside, share * ray.r, leaves, side, pick(through_x, near_j, near_i)};
}

// The elevation of cells that enough points support, NOWHERE higher elsewhere: in `well_supported`.
template <class V> INLINE V sure_height(V elevation, Flag<V> known, V support, const VisibilitySettings& s) {
    return pick(known & (support >= s.min_support), elevation, elevation + s.nowhere);
}

// Which known cells are accepted: enough points agree, or on a neighbouring cell of like height. Of the cell and its
// neighbours the sure heights are given: `well_supported`.
template <class V>
INLINE Flag<V> well_supported(V elevation, Flag<V> known, V own, V above, V below, V left, V right,
                              const VisibilitySettings& s) {
    const V across = smaller(absolute(above - elevation), absolute(below - elevation));
    const V along = smaller(absolute(left - elevation), absolute(right - elevation));
    return known & ((own == elevation) | (smaller(across, along) <= s.resolution));
}

// Whether a ray ends credibly (`has_credible_end`), given the lowest ground at its end, infinite where that is not well
// supported, and the lowest ground near the border that it leaves through; and its slope.
template <class V> struct CredibleEnd {
    Flag<V> well;
    V slope;
};

template <class V>
INLINE CredibleEnd<V> has_credible_end(const Ray<V>& ray, const RayEnds<V>& end, V floor, V near, Flag<V> overhang,
                                       const View& view, const VisibilitySettings& s) {
    const float z = view.origin[2];
    const V height = z + end.reach * ray.slope, deepest = z + ray.r * smaller(ray.slope, splat<V>(0));
    const Flag<V> over = height >= floor;
    const Flag<V> low = end.leaves & (height < floor) & (deepest >= near - s.clearance);
    const V raised = larger(ray.slope, (near + s.clearance - z) / larger(end.reach, splat<V>(1e-6f)));
    const Flag<V> well = (end.inside & (over | low)) | overhang;
    return {well, pick(low & !overhang, raised, ray.slope)};
}

// How far below the sensor a cell's lowest ground lies [m], NO_FALL where it was not hit recently: `horizon`.
template <class V> INLINE V below_sensor(V lowest, Flag<V> known, V time, float z, const VisibilitySettings& s) {
    return pick(known & (time <= s.min_time), z - lowest, splat<V>(s.no_fall));
}

// The lowest ray over a cell so far from the sensor: `RayOverCell`.
template <class V> struct RayOverCell {
    Flag<V> found;
    V x, y, rho;           // [m] from the sensor to the cell's centre
    V slope, height;       // height [m] over the cell's centre
};

// |r . n|: `find_lowest_rays`.
template <class V> INLINE V incidence(const RayOverCell<V>& ray, V gx, V gy) {
    const V along = absolute(ray.slope - (gx * ray.x + gy * ray.y) / ray.rho);
    return along / root((1 + ray.slope * ray.slope) * (1 + gx * gx + gy * gy));
}

// `passes_far_below`
template <class V>
INLINE Flag<V> passes_far_below(V depth, V variance, V gx, V gy, const VisibilitySettings& s) {
    return depth > height_margin(variance, s) + root(gx * gx + gy * gy) * (0.5f * s.resolution);
}

// Eq. 3, by how far below the elevation the ray passes [m].
template <class V> INLINE Flag<V> passes_below(V depth, V variance) { return depth > root(variance); }

// Whether the cell was not hit for `min_time`.
template <class V> INLINE Flag<V> is_old(V time, const VisibilitySettings& s) { return time > s.min_time; }

// Eq. 4, of cells that eq. 3 holds for: the ray is not a grazing one, or passes far below: `clear_and_bound`.
template <class V>
INLINE Flag<V> is_credible(const RayOverCell<V>& ray, V depth, V variance, V gx, V gy,
                                     const VisibilitySettings& s) {
    return (incidence(ray, gx, gy) > s.min_incidence) | passes_far_below(depth, variance, gx, gy, s);
}

// Whether the ray passes below a challenger: `refute_challengers`.
template <class V> INLINE Flag<V> refutes(const RayOverCell<V>& ray, V challenger, const VisibilitySettings& s) {
    return ray.found & (ray.height < challenger + 0.70710678f * (absolute(ray.slope) * s.resolution));
}

// The upper bound of an unknown cell under a ray: `lower_upper_bound`.
template <class V> INLINE V lower_upper_bound(const RayOverCell<V>& ray, Flag<V> bounded, V upper_bound) {
    return pick(bounded, smaller(upper_bound, ray.height), ray.height);
}

}  // namespace visibility
