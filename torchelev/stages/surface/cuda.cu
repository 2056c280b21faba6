// Normals and the analytic head's rating, on a GPU: stage.py. A block for each tile of cells, a thread for each cell.

#include <algorithm>
#include <cmath>

#include "kernels/cuda/update.h"
#include "stages/surface/equation.h"

using surface::Moments;
using surface::Plane;

constexpr int32_t ROWS = 16, COLUMNS = 32;  // of a tile, as in kernel.py
constexpr float INFINITE = std::numeric_limits<float>::infinity();

// Sums over the known cells of a window's row; v counts columns from its middle.
struct RowSums {
    float n = 0, v = 0, vv = 0, z = 0, vz = 0, zz = 0;

    void add(float column, float height) {
        n += 1, v += column, vv += column * column, z += height, vz += column * height, zz += height * height;
    }
};

// Sums over the known cells of a window, and the largest difference [m] to those near enough for a step: `find_steps`.
struct Window {
    Moments<float> sums{};
    float step = 0;

    void add(float u, const RowSums& row) {
        sums.n += row.n, sums.u += u * row.n, sums.uu += u * u * row.n, sums.v += row.v, sums.uv += u * row.v;
        sums.vv += row.vv, sums.z += row.z, sums.uz += u * row.z, sums.vz += row.vz, sums.zz += row.zz;
    }
};

// Radii [cells] of the windows of normals, of the head (0 without it) and of `find_steps`.
struct Reach {
    int32_t radius, cells, steps;
};

// The usual ones, for which compilers unroll loops.
template <int RADIUS, int CELLS> struct FixedReach {
    static constexpr int32_t radius = RADIUS, cells = CELLS, steps = CELLS;
};

// The windows of a known cell.
struct Windows {
    Window normals, head;

    // `height(row, column)` is that of a cell so far from the middle [m], infinite where unknown. It counts from the
    // middle's: squares of absolute heights would cost float32 its millimetres.
    template <class Height, class Reach> Windows(const Height& height, const Reach& reach) {
        const int32_t rim = reach.radius > reach.cells ? reach.radius : reach.cells;
#pragma unroll 5
        for (int32_t row = -rim; row <= rim; row++) {
            const int32_t distance = row < 0 ? -row : row;
            RowSums sums;
#pragma unroll 3
            for (int32_t k = 0; k <= rim; k++) {  // outwards, so that the narrow window is a part of the wide one
                const bool is_near = std::max(k, distance) <= reach.steps;
                add(sums, k, height(row, k), is_near);
                if (k) add(sums, -k, height(row, -k), is_near);
                if (k == reach.radius && distance <= reach.radius) normals.add(float(row), sums);
                if (k == reach.cells && distance <= reach.cells) head.add(float(row), sums);
            }
        }
    }

  private:
    void add(RowSums& sums, int32_t column, float height, bool is_near) {
        if (!(height < INFINITE)) return;
        sums.add(float(column), height);
        if (is_near) head.step = larger(head.step, absolute(height));
    }
};

inline void rate(const MapState& map, int32_t cell, const Windows& windows, const SurfaceSettings& s) {
    const Plane<float> plane = surface::fit_plane(windows.normals.sums, s.min_spread[0], s);
    map.gradient_x[cell] = plane.spans ? plane.gradient_u * s.per_cell : 0.0f;
    map.gradient_y[cell] = plane.spans ? plane.gradient_v * s.per_cell : 0.0f;
    map.has_normal[cell] = plane.spans;
    if (!s.cells) return;
    const Plane<float> ground = surface::fit_plane(windows.head.sums, s.min_spread[1], s);
    map.traversability[cell] = ground.spans ? surface::traversability(ground, windows.head.step, s) : 0.0f;
    map.rated[cell] = ground.spans;
}

template <class Height>
inline void rate_known(const MapState& map, int32_t cell, const Height& height, const SurfaceSettings& s) {
    const bool is_usual = s.radius == 1 && s.steps == s.cells;
    if (is_usual && s.cells == 0) return rate(map, cell, Windows(height, FixedReach<1, 0>()), s);
    if (is_usual && s.cells == 1) return rate(map, cell, Windows(height, FixedReach<1, 1>()), s);
    if (is_usual && s.cells == 2) return rate(map, cell, Windows(height, FixedReach<1, 2>()), s);
    rate(map, cell, Windows(height, Reach{s.radius, s.cells, s.steps}), s);
}

// Clear a cell that is not known. Where it has neither normal nor rating its layers hold zeros: to read costs less.
inline void clear(const MapState& map, int32_t cell, const SurfaceSettings& s) {
    if (!map.has_normal[cell] && !map.rated[cell]) return;
    map.gradient_x[cell] = map.gradient_y[cell] = 0, map.has_normal[cell] = 0;
    if (s.cells) map.traversability[cell] = 0, map.rated[cell] = 0;
}

// Some cells of a map.
struct Tile {
    const MapState map;
    const int32_t H, W, first_row, first_column;

    // Height of a cell of the map, counted from the tile's first; infinite where unknown.
    float height(int32_t row, int32_t column) const {
        const int32_t i = first_row + row, j = first_column + column;
        const bool is_known = i >= 0 && i < H && j >= 0 && j < W && map.validity[i * W + j];
        return is_known ? map.elevation[i * W + j] : INFINITE;
    }

    // Copy the heights of the tile and of a rim around it to memory that the threads share.
    void copy(float* heights, int32_t rim) const {
        const int32_t rows = ROWS + 2 * rim, columns = COLUMNS + 2 * rim;
        for (int32_t k = threadIdx.x; k < rows * columns; k += blockDim.x)
            heights[k] = height(k / columns - rim, k % columns - rim);
        __syncthreads();
    }
};

inline Tile tile_of_block(const Update& u) {
    const int32_t H = int32_t(u.sizes.H), W = int32_t(u.sizes.W);
    const unsigned strips = unsigned(W + COLUMNS - 1) / COLUMNS, tiles = unsigned(H + ROWS - 1) / ROWS * strips;
    const unsigned number = unsigned(blockIdx.x) % tiles;
    return {u.state.at(unsigned(blockIdx.x) / tiles, u.sizes), H, W, int32_t(number / strips) * ROWS,
            int32_t(number % strips) * COLUMNS};
}

// Compute normals and, with the analytic head, ratings of a map's cells.
extern "C" __global__ __launch_bounds__(512, 2) void rate_surface(Update u) {
    const SurfaceSettings& s = u.settings.surface;
    const Tile tile = tile_of_block(u);
    const int32_t rim = std::max(s.radius, s.cells), columns = COLUMNS + 2 * rim;
    float* heights = reinterpret_cast<float*>(block_memory());
    if (s.tile_memory) tile.copy(heights, rim);
    const int32_t row = int32_t(threadIdx.x) / COLUMNS, column = int32_t(threadIdx.x) % COLUMNS;
    const int32_t i = tile.first_row + row, j = tile.first_column + column, cell = i * tile.W + j;
    if (i >= tile.H || j >= tile.W) return;
    if (!tile.map.validity[cell]) {
        clear(tile.map, cell, s);
    } else if (s.tile_memory) {
        const float *middle = heights + (row + rim) * columns + column + rim, own = *middle;
        rate_known(tile.map, cell, [&](int32_t u, int32_t v) { return middle[u * columns + v] - own; }, s);
    } else {  // windows too wide for what threads may share
        const float own = tile.map.elevation[cell];
        const auto height = [&](int32_t u, int32_t v) { return tile.height(row + u, column + v) - own; };
        rate(tile.map, cell, Windows(height, Reach{s.radius, s.cells, s.steps}), s);
    }
}
