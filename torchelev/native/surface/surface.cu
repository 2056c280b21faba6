// Normals and the analytic head's rating of maps on a GPU: traversability/planes.py. A block for each tile.

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <limits>

#include "threads.h"

constexpr int ROWS = 16, COLUMNS = 32;  // of a tile
constexpr int WARPS = 32;               // of a block, at most: `SUM_MEMORY` in kernels.py
constexpr float INFINITE = std::numeric_limits<float>::infinity();

struct Settings {
    float per_cell;       // [1/m] a gradient along x is that along rows, times this
    float min_spread[2];  // [cells^2] of the normals' windows and of the head's
    float per_slope, per_step, per_roughness;  // 1 / critical values
    float min_det, min_trace;                  // [cells^4], [cells^2]
};

// The results, layers (B, H, W); the last two are null without a head.
struct Layers {
    float *gradient_x, *gradient_y;
    uint8_t* has_normal;
    float* traversability;
    uint8_t* rated;
};

// What threads share: the heights of a tile and its rim [m], infinite where unknown; and sums along their rows.
struct Tile {
    enum Sum { N, V, VV, Z, VZ, ZZ, HIGHEST, LOWEST };  // v counts columns; the last two of the head's windows alone
    static constexpr int NORMALS = 6, HEAD = 8;         // sums of their windows
    int32_t rim, width, rows;
    float *warps, *heights, *normals, *head;

    Tile(int32_t rim, float* memory) : rim(rim), width(COLUMNS + 2 * rim), rows(ROWS + 2 * rim) {
        warps = memory, heights = warps + WARPS;
        normals = heights + width * rows, head = normals + NORMALS * rows * COLUMNS;
    }
    float& at(float* sums, int sum, int32_t place) const { return sums[sum * rows * COLUMNS + place]; }
};

// Sum along a row around each cell of a tile and of the rows above and below; heights count from `datum`. The highest
// and the lowest height are those within `steps` cells.
template <int SUMS> inline void sum_along_rows(const Tile& tile, float* sums, int32_t radius, int32_t steps, float datum) {
    for (int32_t place = threadIdx.x; place < tile.rows * COLUMNS; place += blockDim.x) {
        const float* middle = tile.heights + place / COLUMNS * tile.width + place % COLUMNS + tile.rim;
        float n = 0, v_n = 0, vv_n = 0, z = 0, vz = 0, zz = 0, highest = -INFINITE, lowest = INFINITE;
#pragma unroll 5
        for (int32_t v = -radius; v <= radius; v++) {
            const float height = middle[v] - datum, column = float(v);
            if (!(height < INFINITE)) continue;
            n += 1, v_n += column, vv_n += column * column;
            z += height, vz += column * height, zz += height * height;
            if (SUMS == Tile::HEAD && std::abs(v) <= steps)
                highest = fmaxf(highest, height), lowest = fminf(lowest, height);
        }
        tile.at(sums, Tile::N, place) = n, tile.at(sums, Tile::V, place) = v_n, tile.at(sums, Tile::VV, place) = vv_n;
        tile.at(sums, Tile::Z, place) = z, tile.at(sums, Tile::VZ, place) = vz, tile.at(sums, Tile::ZZ, place) = zz;
        if (SUMS == Tile::HEAD)
            tile.at(sums, Tile::HIGHEST, place) = highest, tile.at(sums, Tile::LOWEST, place) = lowest;
    }
}

// Sums over the known cells of a window; u counts rows.
struct Window {
    float n = 0, u = 0, v = 0, uu = 0, uv = 0, vv = 0, z = 0, uz = 0, vz = 0, zz = 0;
    float highest = -INFINITE, lowest = INFINITE;

    template <int SUMS>
    static Window of(const Tile& tile, float* sums, int32_t place, int32_t radius, int32_t steps = 0) {
        Window w;
#pragma unroll 5
        for (int32_t k = -radius; k <= radius; k++) {
            const int32_t at = place + (tile.rim + k) * COLUMNS;
            const float row = float(k), n = tile.at(sums, Tile::N, at), v = tile.at(sums, Tile::V, at);
            const float z = tile.at(sums, Tile::Z, at);
            w.n += n, w.u += row * n, w.uu += row * row * n, w.v += v, w.uv += row * v, w.z += z, w.uz += row * z;
            w.vv += tile.at(sums, Tile::VV, at), w.vz += tile.at(sums, Tile::VZ, at);
            w.zz += tile.at(sums, Tile::ZZ, at);
            if (SUMS < Tile::HEAD || std::abs(k) > steps) continue;
            w.highest = fmaxf(w.highest, tile.at(sums, Tile::HIGHEST, at));
            w.lowest = fminf(w.lowest, tile.at(sums, Tile::LOWEST, at));
        }
        return w;
    }
};

// The least-squares plane of a window: `fit_plane`.
struct Plane {
    bool spans;
    float gradient_u, gradient_v;  // [m/cell]
    float residual;                // [m^2]

    Plane(const Window& s, float min_spread, const Settings& settings) {
        const float w = 1 / s.n, u = s.u * w, v = s.v * w, z = s.z * w;
        const float uu = s.uu * w - u * u, uv = s.uv * w - u * v, vv = s.vv * w - v * v;
        const float uz = s.uz * w - u * z, vz = s.vz * w - v * z, zz = s.zz * w - z * z;
        const float a = uu - min_spread, b = vv - min_spread;  // `spans_plane`
        spans = a >= 0 && b >= 0 && a * b >= uv * uv;
        const float det = uu * vv - uv * uv, trace = uu + vv;
        const bool is_regular = det > settings.min_det;  // `solve_gradient`
        const float scale = 1 / (is_regular ? det : fmaxf(trace, settings.min_trace));
        gradient_u = (is_regular ? vv * uz - uv * vz : uz) * scale;
        gradient_v = (is_regular ? uu * vz - uv * uz : vz) * scale;
        residual = fmaxf(zz - gradient_u * uz - gradient_v * vz, 0.0f);
    }
};

// `traversability` in heads.py, given the step [m].
inline float rating(const Plane& plane, float step, const Settings& s) {
    const float x = plane.gradient_u * s.per_cell, y = plane.gradient_v * s.per_cell;
    const float slope = std::atan(std::sqrt(fmaxf(x * x + y * y, 1e-12f)));
    const float roughness = std::sqrt(fmaxf(plane.residual, 1e-12f));
    const float worst = fmaxf(slope * s.per_slope, step * s.per_step);
    return fmaxf(1 - fmaxf(worst, roughness * s.per_roughness), 0.0f);
}

// Rate a cell of the map, at a place of its tile, of a height [m] from the datum.
inline void rate(const Tile& tile, int32_t place, bool is_known, float height, int64_t cell, int32_t radius,
                 int32_t cells, int32_t steps, const Settings& s, const Layers& out) {
    float x = 0, y = 0, traversability = 0;
    bool has_normal = false, rated = false;
    if (is_known) {
        const Plane plane(Window::of<Tile::NORMALS>(tile, tile.normals, place, radius), s.min_spread[0], s);
        has_normal = plane.spans;
        if (has_normal) x = plane.gradient_u * s.per_cell, y = plane.gradient_v * s.per_cell;
    }
    if (is_known && cells) {
        const Window window = Window::of<Tile::HEAD>(tile, tile.head, place, cells, steps);
        const Plane plane(window, s.min_spread[1], s);
        rated = plane.spans;
        if (rated) traversability = rating(plane, fmaxf(window.highest - height, height - window.lowest), s);
    }
    out.gradient_x[cell] = x, out.gradient_y[cell] = y, out.has_normal[cell] = has_normal;
    if (cells) out.traversability[cell] = traversability, out.rated[cell] = rated;
}

// Rate maps (B, H, W). Heights count from the mean of a tile: squares of absolute ones would cost float32 its
// millimetres.
extern "C" __global__ __launch_bounds__(512, 3) void rate_surface(const float* __restrict__ elevation,
                                                                  const uint8_t* __restrict__ validity, Layers out,
                                                                  int64_t H, int64_t W, int64_t radius, int64_t cells,
                                                                  int64_t steps, Settings settings) {
    const int32_t r = int32_t(radius), c = int32_t(cells), rows = int32_t(H), columns = int32_t(W);
    const Tile tile(r < c ? c : r, reinterpret_cast<float*>(block_memory()));
    const unsigned bands = (unsigned(rows) + ROWS - 1) / ROWS, strips = (unsigned(columns) + COLUMNS - 1) / COLUMNS;
    const unsigned number = unsigned(blockIdx.x) % (bands * strips);
    const int64_t map = unsigned(blockIdx.x) / (bands * strips) * H * W;
    const int32_t first_row = int32_t(number / strips) * ROWS, first_column = int32_t(number % strips) * COLUMNS;
    float sum = 0, known = 0;
    for (int32_t k = threadIdx.x; k < tile.rows * tile.width; k += blockDim.x) {
        const int32_t i = first_row - tile.rim + k / tile.width, j = first_column - tile.rim + k % tile.width;
        const bool is_inside = i >= 0 && i < rows && j >= 0 && j < columns;
        const bool is_known = is_inside && validity[map + i * columns + j];
        const float height = is_known ? elevation[map + i * columns + j] : INFINITE;
        tile.heights[k] = height;
        if (is_known) sum += height, known += 1;
    }
    sum = sum_of_block(sum, tile.warps), known = sum_of_block(known, tile.warps);
    const float datum = sum / fmaxf(known, 1);
    sum_along_rows<Tile::NORMALS>(tile, tile.normals, r, 0, datum);
    if (cells) sum_along_rows<Tile::HEAD>(tile, tile.head, c, int32_t(steps), datum);
    __syncthreads();
    for (int32_t k = threadIdx.x; k < ROWS * COLUMNS; k += blockDim.x) {
        const int32_t i = k / COLUMNS, j = k % COLUMNS;
        if (first_row + i >= rows || first_column + j >= columns) continue;
        const float height = tile.heights[(i + tile.rim) * tile.width + j + tile.rim];
        const int64_t cell = map + (first_row + i) * columns + first_column + j;
        rate(tile, k, height < INFINITE, height - datum, cell, r, c, int32_t(steps), settings, out);
    }
}
