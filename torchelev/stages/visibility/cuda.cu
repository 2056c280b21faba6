// Visibility clean-up and the upper bound on a GPU: stage.py. Launches for one sensor after the other, `u.sensor`: its
// rays see what those of earlier ones have cleared.

#include <cmath>

#include "kernels/cuda/update.h"
#include "stages/visibility/equation.h"
#include "stages/visibility/ground_of_thread.h"

// Integers in the order of floats, none of them NaN; each is the other's.
inline int32_t ordered(int32_t bits) { return bits < 0 ? bits ^ 0x7fffffff : bits; }
inline int32_t ordered(float value) { return ordered(__float_as_int(value)); }
inline float unordered(int32_t value) { return __int_as_float(ordered(value)); }

// Begin without rays. A thread for each entry of the table.
extern "C" __global__ void clear_table(Update u) {
    const int64_t entries = u.sizes.ranges * u.sizes.azimuths;
    const Place at = place(entries);
    if (at.k == 0 && u.sensor == 0) *u.state.statistics.at(at.row, u.sizes).cleared_seen_through = 0;
    if (at.k < entries) u.scratch.slopes[at.row * entries + at.k] = ordered(u.settings.visibility.no_ray);
}

// Write the running minimum of the falls to recently hit ground: `limits_by_tensors`. A thread for each azimuth.
extern "C" __global__ void find_horizon(Update u) {
    const int64_t azimuths = u.sizes.horizon_azimuths;
    const Place at = place(azimuths);
    if (at.k >= azimuths) return;
    const Ground ground(u, at.row);
    float* steepest = u.scratch.at(at.row, u.sizes).steepest + at.k;
    const float angle = visibility::direction(int(at.k), int(azimuths)), x = cosf(angle), y = sinf(angle);
    const float step = 2 * ground.s.resolution;
    float lowest = std::numeric_limits<float>::infinity();
    for (int32_t k = 0; k < int32_t(u.sizes.horizon_ranges); k++) {
        const float rho = (float(k) + 0.5f) * step;
        lowest = smaller(lowest, ground.below_sensor(rho * x, rho * y) / rho);
        steepest[k * azimuths] = lowest;
    }
}

// Find the lowest ground near each place of the borders: `ground_at_borders`. A block for each border of each map.
extern "C" __global__ void find_borders(Update u) {
    const int32_t side = int32_t(blockIdx.x % 4);
    const Ground ground(u, blockIdx.x / 4);
    const Scratch scan = u.scratch.at(blockIdx.x / 4, u.sizes);
    float *minima = scan.border_minima + side * u.sizes.border, *borders = scan.borders + side * u.sizes.border;
    const int32_t length = side < 2 ? ground.columns : ground.rows, near = ground.s.near_cells;
    for (int32_t n = threadIdx.x; n < length; n += blockDim.x) minima[n] = ground.border_minimum(side, n);
    __syncthreads();
    for (int32_t n = threadIdx.x; n < length; n += blockDim.x) {
        float lowest = ground.s.nowhere;
        for (int32_t k = std::max(n - near, 0); k <= std::min(n + near, length - 1); k++)
            lowest = smaller(lowest, minima[k]);
        borders[n] = lowest;
    }
}

// Put the accepted rays into the table: `accepted_rays` and `bins_of`. A thread for each ray.
extern "C" __global__ void put_rays(Update u) {
    const Place at = place(u.sizes.N);
    const Scratch scan = u.scratch.at(at.row, u.sizes);
    const int64_t k = u.sensor * u.sizes.N + at.k;
    if (at.k >= u.sizes.N || !scan.casts[k]) return;
    const Ground ground(u, at.row);
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
        atomicMin(scan.slopes + int32_t(bins.range) * s.azimuths + int32_t(bins.azimuth), ordered(credible.slope));
}

// Turn entries into the lowest of them from each range on: `lowest_slopes`. A thread for each azimuth.
extern "C" __global__ void scan_table(Update u) {
    const int64_t azimuths = u.sizes.azimuths;
    const Place at = place(azimuths);
    if (at.k >= azimuths) return;
    int32_t* slopes = u.scratch.at(at.row, u.sizes).slopes + at.k;
    int32_t lowest = ordered(u.settings.visibility.no_ray);
#pragma unroll 16
    for (int64_t row = u.sizes.ranges - 1; row >= 0; row--)
        slopes[row * azimuths] = lowest = std::min(lowest, slopes[row * azimuths]);
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
    return visibility::passes_below(depth, variance, map.time[k], s) &&
           visibility::is_steep(ray, depth, variance, map.gradient_x[k], map.gradient_y[k], s);
}

// Apply the lowest ray over each cell. A thread for each cell.
extern "C" __global__ void clear_and_bound(Update u) {
    const Place at = place(u.cells());
    const int64_t k = at.k;
    const MapState map = u.state.at(at.row, u.sizes);
    bool gone = false;
    if (k < u.cells()) {
        const Ground ground(u, at.row);
        const VisibilitySettings& s = ground.s;
        const int32_t i = int32_t(k) / ground.columns, j = int32_t(k) % ground.columns;
        const float x = ground.to_center(0, i), y = ground.to_center(1, j);
        const auto ray = find_lowest_ray(u.scratch.at(at.row, u.sizes).slopes, x, y, ground.view.origin[2], s);
        const bool known = map.validity[k];
        gone = known && ray.found && is_gone(ray, map, k, s);
        if (gone) map.validity[k] = false;
        const bool stays = known && !gone, bounded = map.bounded[k];
        if (map.challenger_support[k] && (!stays || visibility::refutes(ray, map.challenger[k], s)))
            map.challenger_support[k] = 0;
        if (!stays && ray.found)
            map.upper_bound[k] = visibility::lower_upper_bound(ray, bounded, map.upper_bound[k]), map.bounded[k] = true;
        else if (stays && bounded)
            map.bounded[k] = false;
    }
    add_of_warp(map.statistics.cleared_seen_through, gone);
}

// Start counting the unknown cells that have an upper bound. A thread for each map.
extern "C" __global__ void start_count(Update u) {
    const int64_t b = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (b < u.sizes.B) *u.state.statistics.at(b, u.sizes).cells_bounded = 0;
}

// Count them. As many threads for each map as there are.
extern "C" __global__ void count_bounded(Update u) {
    const int64_t threads = gridDim.x / u.sizes.B * blockDim.x;
    const Place at = place(threads);
    const MapState map = u.state.at(at.row, u.sizes);
    int32_t number = 0;
    for (int64_t k = at.k; k < u.cells(); k += threads) number += map.bounded[k] && !map.validity[k];
    add_of_warp(map.statistics.cells_bounded, number);
}
