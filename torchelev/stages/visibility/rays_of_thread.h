// What a GPU's thread does with a ray, an azimuth of the table, or a cell: accepted_rays.py, lowest_rays.py and stage.py.
#pragma once

#include "stages/visibility/ground_of_thread.h"

// Integers in the order of floats, none of them NaN; each is the other's.
inline int32_t ordered(int32_t bits) { return bits < 0 ? bits ^ 0x7fffffff : bits; }
inline int32_t ordered(float value) { return ordered(__float_as_int(value)); }
inline float unordered(int32_t value) { return __int_as_float(ordered(value)); }

// Put a ray of the launch's sensor into the table if it is accepted: `accepted_rays` and `bins_of`.
inline void put_ray(const Update& u, const Ground& ground, const Scratch& scan, int64_t n, int32_t* slopes) {
    const int64_t k = u.sensor * u.sizes.N + n;
    if (!scan.casts[k]) return;
    const float* origin = ground.view.origin;
    const VisibilitySettings& s = ground.s;
    const auto ray = visibility::sensor_ray(scan.x[k] - origin[0], scan.y[k] - origin[1], scan.z[k] - origin[2]);
    const auto bins = visibility::bins_of(ray, root(scan.noise[k] + scan.of_pose[k]), s);
    const auto last = visibility::horizon_bins_of(ray, s);
    const int32_t fall = int32_t(last.range) * int32_t(u.sizes.horizon_azimuths) + int32_t(last.azimuth);
    const float limit = last.range >= 0 ? scan.steepest[fall] : s.no_fall;
    if (!(bins.range >= 0) || !(limit + ray.slope >= 0)) return;
    const auto end = visibility::find_ends(ray, ground.view, s);
    const int32_t border = int32_t(end.side) * int32_t(u.sizes.border) + int32_t(end.place);
    const float floor = ground.floor_at(int32_t(end.i), int32_t(end.j));
    const float near = end.leaves ? scan.borders[border] : s.nowhere;
    const auto credible = visibility::has_credible_end(ray, end, floor, near, !scan.used[k], ground.view, s);
    if (credible.well)
        atomicMin(slopes + int32_t(bins.range) * s.azimuths + int32_t(bins.azimuth), ordered(credible.slope));
}

// Turn an azimuth's entries into the lowest of them from each range on: `lowest_slopes`.
inline void scan_azimuth(int32_t* slopes, const VisibilitySettings& s) {
    int32_t lowest = ordered(s.no_ray);
#pragma unroll 16
    for (int32_t row = s.ranges - 1; row >= 0; row--)
        slopes[row * s.azimuths] = lowest = std::min(lowest, slopes[row * s.azimuths]);
}

// The lowest ray over a cell so far from the sensor: `find_lowest_rays`. Cells look at all azimuths that they cover.
inline visibility::RayOverCell<float> find_lowest_ray(const int32_t* slopes, float x, float y, float z,
                                                      const VisibilitySettings& s) {
    const float rho = visibility::horizontal(x, y), k = std::floor(rho / s.resolution);
    if (!(k < s.ranges)) return {false, x, y, rho, 0, z};
    const float entry = visibility::entry_of(k, s.levels, s);
    const auto window = visibility::window_of(k, visibility::azimuth_fraction(x, y) * s.azimuths, entry, s);
    const int32_t* row = slopes + int32_t(k) * s.azimuths;
    int32_t place = int32_t(window.first), lowest = ordered(s.no_ray);
    for (int32_t left = int32_t(window.further + entry); left > 0; left--) {
        lowest = std::min(lowest, row[place]);
        place = place + 1 < s.azimuths ? place + 1 : 0;
    }
    const bool found = lowest < ordered(s.no_ray);
    const float slope = found ? unordered(lowest) : 0;
    return {found, x, y, rho, slope, z + slope * rho};
}

// Eq. 3 and 4 of a known cell under a ray.
inline bool is_gone(const visibility::RayOverCell<float>& ray, const MapState& map, int64_t k,
                    const VisibilitySettings& s) {
    const float depth = map.elevation[k] - ray.height, variance = map.variance[k];
    return visibility::passes_below(depth, variance) && visibility::is_old(map.time[k], s) &&
           visibility::is_credible(ray, depth, variance, map.gradient_x[k], map.gradient_y[k], s);
}

// Apply the lowest ray over a cell; return whether the cell is cleared: `clear_and_bound`.
inline bool apply_to_cell(const Ground& ground, const int32_t* slopes, int32_t k) {
    const MapState& map = ground.map;
    const VisibilitySettings& s = ground.s;
    const float x = ground.to_center(0, k / ground.columns), y = ground.to_center(1, k % ground.columns);
    const auto ray = find_lowest_ray(slopes, x, y, ground.view.origin[2], s);
    const bool known = map.validity[k], gone = known && ray.found && is_gone(ray, map, k, s), stays = known && !gone;
    const bool bounded = map.bounded[k];
    if (gone) map.validity[k] = false;
    if (map.challenger_support[k] && (!stays || visibility::refutes(ray, map.challenger[k], s)))
        map.challenger_support[k] = 0;
    if (!stays && ray.found)
        map.upper_bound[k] = visibility::lower_upper_bound(ray, bounded, map.upper_bound[k]), map.bounded[k] = true;
    else if (stays && bounded)
        map.bounded[k] = false;
    return gone;
}
