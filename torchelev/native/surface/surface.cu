// Normals and the analytic head's rating of maps on a GPU: traversability/planes.py. A block for each tile.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "threads.h"

constexpr int ROWS = 16, COLUMNS = 32;  // of a tile
constexpr float UNKNOWN = std::numeric_limits<float>::infinity();

struct Settings {
    float resolution;     // [m]
    float min_spread[2];  // [cells^2] of the normals' windows and of the head's
    float critical_slope, critical_step, critical_roughness;
    float min_det, min_trace;  // [cells^4], [cells^2]
};

// The results, layers (B, H, W); the last two are null without a head.
struct Layers {
    float *gradient_x, *gradient_y;
    uint8_t* has_normal;
    float* traversability;
    uint8_t* rated;
};

// Sums over the known cells of a row of a window; v counts columns, heights [m] count from the window's middle.
struct RowSums {
    float n = 0, v = 0, vv = 0, z = 0, vz = 0, zz = 0;

    void add(float column, float height) {
        n += 1, v += column, vv += column * column;
        z += height, vz += column * height, zz += height * height;
    }
};

// Sums over the known cells of a window; u counts rows. Its cells' heights [m] count from the middle one's.
struct Sums {
    float n = 0, u = 0, v = 0, uu = 0, uv = 0, vv = 0, z = 0, uz = 0, vz = 0, zz = 0, lowest = 0, highest = 0;

    void add(float row, const RowSums& sums) {
        n += sums.n, u += row * sums.n, v += sums.v;
        uu += row * row * sums.n, uv += row * sums.v, vv += sums.vv;
        z += sums.z, uz += row * sums.z, vz += sums.vz, zz += sums.zz;
    }
};

// Sum over the window around a cell that is known, of heights in rows of `width`. RADIUS: the radius, or 0 if large.
template <int RADIUS> inline Sums sums_around(const float* middle, int32_t width, int32_t radius) {
    const int32_t r = RADIUS ? RADIUS : radius;
    Sums sums;
#pragma unroll
    for (int32_t u = -r; u <= r; u++) {
        RowSums row;
#pragma unroll
        for (int32_t v = -r; v <= r; v++) {
            const float height = middle[u * width + v] - *middle;
            if (!(height < UNKNOWN)) continue;
            row.add(float(v), height);
            sums.lowest = std::min(sums.lowest, height), sums.highest = std::max(sums.highest, height);
        }
        sums.add(float(u), row);
    }
    return sums;
}

inline Sums sums_around(const float* middle, int32_t width, int32_t radius) {
    switch (radius) {
    case 1: return sums_around<1>(middle, width, radius);
    case 2: return sums_around<2>(middle, width, radius);
    case 3: return sums_around<3>(middle, width, radius);
    default: return sums_around<0>(middle, width, radius);
    }
}

// The least-squares plane of a window: `fit_plane`.
struct Plane {
    bool spans;
    float gradient_u, gradient_v;  // [m/cell]
    float residual;                // [m^2]

    Plane(const Sums& s, float min_spread, const Settings& settings) {
        const float w = 1 / s.n, u = s.u * w, v = s.v * w, z = s.z * w;
        const float uu = s.uu * w - u * u, uv = s.uv * w - u * v, vv = s.vv * w - v * v;
        const float uz = s.uz * w - u * z, vz = s.vz * w - v * z, zz = s.zz * w - z * z;
        const float a = uu - min_spread, b = vv - min_spread;  // `spans_plane`
        spans = a >= 0 && b >= 0 && a * b >= uv * uv;
        const float det = uu * vv - uv * uv, trace = uu + vv;
        const bool is_regular = det > settings.min_det;  // `solve_gradient`
        const float scale = 1 / (is_regular ? det : std::max(trace, settings.min_trace));
        gradient_u = (is_regular ? vv * uz - uv * vz : uz) * scale;
        gradient_v = (is_regular ? uu * vz - uv * uz : vz) * scale;
        residual = std::max(zz - gradient_u * uz - gradient_v * vz, 0.0f);
    }
};

// `traversability` in heads.py, given the height range of a window [m].
inline float rating(const Plane& plane, float range, int32_t cells, const Settings& s) {
    const float x = plane.gradient_u / s.resolution, y = plane.gradient_v / s.resolution;
    const float slope = std::atan(std::sqrt(std::max(x * x + y * y, 1e-12f)));
    const float explained = float(2 * cells) * (std::fabs(plane.gradient_u) + std::fabs(plane.gradient_v));
    const float step = std::max(range - explained, 0.0f);
    const float roughness = std::sqrt(std::max(plane.residual, 1e-12f));
    const float worst = std::max(slope / s.critical_slope, step / s.critical_step);
    return std::max(1 - std::max(worst, roughness / s.critical_roughness), 0.0f);
}

// Rate one cell, whose height stands in rows of `width`.
inline void rate(const float* middle, int32_t width, int64_t cell, int32_t radius, int32_t cells, const Settings& s,
                 const Layers& out) {
    float x = 0, y = 0, traversability = 0;
    bool has_normal = false, rated = false;
    if (*middle < UNKNOWN) {
        const Sums around = sums_around(middle, width, radius);
        const Plane plane(around, s.min_spread[0], s);
        has_normal = plane.spans;
        x = has_normal ? plane.gradient_u / s.resolution : 0, y = has_normal ? plane.gradient_v / s.resolution : 0;
        if (cells) {
            const Sums window = sums_around(middle, width, cells);
            const Plane ground(window, s.min_spread[1], s);
            rated = ground.spans;
            traversability = rated ? rating(ground, window.highest - window.lowest, cells, s) : 0;
        }
    }
    out.gradient_x[cell] = x, out.gradient_y[cell] = y, out.has_normal[cell] = has_normal;
    if (cells) out.traversability[cell] = traversability, out.rated[cell] = rated;
}

// Rate maps (B, H, W). The threads of a block share the heights of its tile and a rim of the larger window's radius.
extern "C" __global__ void rate_surface(const float* __restrict__ elevation, const uint8_t* __restrict__ validity,
                                        Layers out, int64_t H, int64_t W, int64_t radius, int64_t cells,
                                        Settings settings) {
    const int32_t rim = int32_t(std::max(radius, cells)), width = COLUMNS + 2 * rim, rows = ROWS + 2 * rim;
    const unsigned bands = (unsigned(H) + ROWS - 1) / ROWS, strips = (unsigned(W) + COLUMNS - 1) / COLUMNS;
    const unsigned tile = unsigned(blockIdx.x) % (bands * strips);
    const int64_t map = unsigned(blockIdx.x) / (bands * strips) * H * W;
    const int32_t first_row = int32_t(tile / strips) * ROWS, first_column = int32_t(tile % strips) * COLUMNS;
    float* heights = reinterpret_cast<float*>(block_memory());
    for (int32_t k = threadIdx.x; k < rows * width; k += blockDim.x) {
        const int32_t i = first_row - rim + k / width, j = first_column - rim + k % width;
        const bool is_inside = i >= 0 && i < H && j >= 0 && j < W;
        const int64_t cell = map + i * W + j;
        heights[k] = is_inside && validity[cell] ? elevation[cell] : UNKNOWN;
    }
    __syncthreads();
    for (int32_t k = threadIdx.x; k < ROWS * COLUMNS; k += blockDim.x) {
        const int32_t i = k / COLUMNS, j = k % COLUMNS;
        if (first_row + i >= H || first_column + j >= W) continue;
        const int64_t cell = map + (first_row + i) * W + first_column + j;
        rate(heights + (i + rim) * width + j + rim, width, cell, int32_t(radius), int32_t(cells), settings, out);
    }
}
