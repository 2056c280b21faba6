// Visibility clean-up and the upper bound on a GPU: stage.py. Launches for one sensor after the other, the sensor of `Update`: its
// rays see what those of earlier ones have cleared.

#include <cmath>

#include "kernels/cuda/update.h"
#include "stages/visibility/equation.h"
#include "stages/visibility/ground_of_thread.h"
#include "stages/visibility/rays_of_thread.h"

// Write the running minimum of the falls to recently hit ground: `horizon`. A thread for each azimuth.
extern "C" __global__ void find_horizon(Update u) {
    const int64_t azimuths = u.sizes.horizon_azimuths;
    const Place at = place(azimuths);
    if (at.k == 0 && u.sensor == 0) *u.state.statistics.at(at.row, u.sizes).cleared_seen_through = 0;
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

// Where many maps have tables that fit into a block's own memory -----------------------------------------------------

// Put the accepted rays into a table, and apply the lowest ray over each cell. A block for each map.
extern "C" __global__ void apply_rays(Update u) {
    const Ground ground(u, blockIdx.x);
    const VisibilitySettings& s = ground.s;
    const Scratch scan = u.scratch.at(blockIdx.x, u.sizes);
    int32_t* slopes = block_memory();  // (ranges, azimuths), in the order of floats
    for (int32_t k = threadIdx.x; k < s.ranges * s.azimuths; k += blockDim.x) slopes[k] = ordered(s.no_ray);
    __syncthreads();
    for (int64_t n = threadIdx.x; n < u.sizes.N; n += blockDim.x) put_ray(u, ground, scan, n, slopes);
    __syncthreads();
    for (int32_t k = threadIdx.x; k < s.azimuths; k += blockDim.x) scan_azimuth(slopes + k, s);
    __syncthreads();
    int32_t cleared = 0;
    for (int32_t k = threadIdx.x; k < u.cells(); k += blockDim.x) cleared += apply_to_cell(ground, slopes, k);
    add_of_warp(ground.map.statistics.cleared_seen_through, cleared);
}

// Elsewhere: the same, step by step ----------------------------------------------------------------------------------

// Begin without rays. A thread for each entry of the table.
extern "C" __global__ void clear_table(Update u) {
    const int64_t entries = u.sizes.ranges * u.sizes.azimuths;
    const Place at = place(entries);
    if (at.k < entries) u.scratch.slopes[at.row * entries + at.k] = ordered(u.settings.visibility.no_ray);
}

// Put the accepted rays into the table. A thread for each ray.
extern "C" __global__ void put_rays(Update u) {
    const Place at = place(u.sizes.N);
    const Scratch scan = u.scratch.at(at.row, u.sizes);
    if (at.k < u.sizes.N) put_ray(u, Ground(u, at.row), scan, at.k, scan.slopes);
}

// Find the lowest slopes from each range on. A thread for each azimuth.
extern "C" __global__ void scan_table(Update u) {
    const Place at = place(u.sizes.azimuths);
    if (at.k < u.sizes.azimuths) scan_azimuth(u.scratch.at(at.row, u.sizes).slopes + at.k, u.settings.visibility);
}

// Apply the lowest ray over each cell. A thread for each cell.
extern "C" __global__ void clear_and_bound(Update u) {
    const Place at = place(u.cells());
    const Ground ground(u, at.row);
    const int32_t* slopes = u.scratch.at(at.row, u.sizes).slopes;
    const bool cleared = at.k < u.cells() && apply_to_cell(ground, slopes, int32_t(at.k));
    add_of_warp(ground.map.statistics.cleared_seen_through, cleared);
}

// The count of bounds ------------------------------------------------------------------------------------------------

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
