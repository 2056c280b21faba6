// What the rays of a scan passed through: rays.py, with the same names.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "generated.h"
#include "levels/kernel/points.h"
#include "levels/kernel/surfaces.h"
#include "stages/visibility/azimuth.h"

namespace levels {

constexpr float INFINITE = std::numeric_limits<float>::infinity();
constexpr float MARGIN = 1.5f, NEAREST = 3.0f;
constexpr int MAX_WINDOW = 8;
constexpr float HEIGHTS[] = {0.3f, 0.5f, 0.7f};

inline float horizontal(float x, float y) { return std::sqrt(x * x + y * y); }

struct SightGrid {
    int32_t azimuths, elevations, ranges;
    float resolution, window;  // window: of a cell at 1 m [bins]

    explicit SightGrid(const LevelsSettings& s)
        : azimuths(s.azimuths), elevations(s.elevations), ranges(s.ranges), resolution(float(s.resolution)),
          window(float(0.75 * s.resolution * s.azimuths / (2 * 3.14159265358979323846))) {}

    int32_t azimuth_bin(float x, float y) const {
        const int32_t bin = int32_t(visibility::azimuth_fraction(x, y) * float(azimuths));
        return std::min(bin, azimuths - 1);
    }
    int32_t range_bin(float rho) const { return int32_t(std::min(rho / resolution, float(ranges - 2))); }
    // The row of the rays that end more than a cell behind a place.
    int32_t row_behind(float d) const { return int32_t(std::min(d / resolution + MARGIN, float(ranges - 1))); }
    int32_t elevation_bin(float rho, float dz) const {
        const float fraction = 0.5f + 0.5f * (dz / std::max(rho + std::fabs(dz), 1e-12f));
        return std::min(int32_t(fraction * float(elevations)), elevations - 1);
    }
    float height_of(int32_t elevation, float d) const {
        const double t = 2 * double(elevation) / elevations - 1;
        return elevation > 0 ? float(t / (1 - std::fabs(t))) * d : -INFINITE;
    }
};

struct Slopes {
    float highest, fall;  // greatest, and greatest downwards: of both the larger, so that they pass as one row
};

constexpr float RISE = 0.5f;

// What the rays of one sensor saw.
struct Sight {
    float origin[3];
    std::vector<float> nearest;  // by direction
    std::vector<Slopes> slopes;  // by range and azimuth

    void look_for_nearest(const Points& p, int64_t begin, int64_t end, const SightGrid& size) {
        nearest.assign(size_t(size.elevations) * size.azimuths, INFINITE);
        for (int64_t m = begin; m < end; m++) {
            float& known = nearest[p.direction[m]];
            known = std::min(known, p.casts[m] ? p.rho[m] : INFINITE);
        }
    }

    void look_for_slopes(const Points& p, int64_t begin, int64_t end, const SightGrid& size) {
        const int64_t A = size.azimuths;
        slopes.assign(int64_t(size.ranges) * A, {-INFINITE, -INFINITE});
        for (int64_t m = begin; m < end; m++) {
            if (!p.casts[m] || !(p.rho[m] > 0)) continue;
            Slopes& known = slopes[p.reach[m]];
            known.highest = std::max(known.highest, p.slope[m]), known.fall = std::max(known.fall, -p.slope[m]);
        }
        for (int64_t row = size.ranges - 3; row >= 0; row--) {  // the last row stays blank
            float* __restrict to = &slopes[row * A].highest;
            const float* far = &slopes[(row + 1) * A].highest;
            for (int64_t k = 0; k < 2 * A; k++) to[k] = std::max(to[k], far[k]);
        }
    }

    // Return the nearest return in the directions that cover a place [m], and set the distance of its cell [m].
    float nearest_around(float x, float y, float z, const SightGrid& size, float& d) const {
        const float dx = x - origin[0], dy = y - origin[1];
        d = horizontal(dx, dy);
        const int32_t A = size.azimuths, azimuth = size.azimuth_bin(dx, dy);
        const float* row = nearest.data() + size.elevation_bin(d, z - origin[2]) * A;
        const int half = std::min(int(std::ceil(size.window / std::max(d, size.resolution))), MAX_WINDOW);
        float found = INFINITE;
        for (int32_t k = azimuth - half; k <= azimuth + half; k++) found = std::min(found, row[k < 0 ? k + A : k >= A ? k - A : k]);
        return found;
    }

    bool is_free(float x, float y, float z, const SightGrid& size) const {
        float d;
        const float found = nearest_around(x, y, z, size, d);
        return found < INFINITE && found >= d + MARGIN * size.resolution && d >= NEAREST * size.resolution;
    }

    // Return up to which height the space above a floor is free: `raise_free_top`.
    float raise_free_top(float top, float floor, float x, float y, float min_gap, const SightGrid& size) const {
        const float dx = x - origin[0], dy = y - origin[1], d = horizontal(dx, dy);
        const int32_t azimuth = size.azimuth_bin(dx, dy);
        const float highest = origin[2] + slopes[int64_t(size.row_behind(d)) * size.azimuths + azimuth].highest * d;
        if (!(highest > std::max(top, floor) + RISE * size.resolution)) return top;
        const float begin = std::max(top, floor + 0.5f * min_gap), behind = d + MARGIN * size.resolution;
        const int32_t last = size.elevation_bin(d, std::max(begin, highest) - origin[2]);
        for (int32_t e = size.elevation_bin(d, begin - origin[2]); e <= last; e++)
            if (nearest[int64_t(e) * size.azimuths + azimuth] < behind)
                return std::max(top, std::min(highest, origin[2] + size.height_of(e, d)));
        return std::max(top, highest);
    }

    // Whether rays passed through a surface of a cell: `_seen_through`.
    bool passes(float x, float y, float low, float high, float variance, const SightGrid& size) const {
        const float middle = 0.5f * (low + high);
        float d;
        const float found = nearest_around(x, y, middle, size, d);
        const float slope = std::fabs(middle - origin[2]) / std::max(d, size.resolution);
        const float noise = GATE * std::sqrt(variance) + (2 * d / float(size.elevations)) * ((1 + slope) * (1 + slope));
        const bool is_thick = high - low >= 2 * noise, is_steep = 2 * MARGIN * size.resolution * slope >= noise;
        const float behind = found - d;
        const bool crosses = is_thick || (is_steep && behind * slope >= noise);
        return behind >= MARGIN * size.resolution && crosses && found < INFINITE && d >= NEAREST * size.resolution;
    }
};

// What the rays of all sensors saw.
struct Sights {
    SightGrid size;
    std::vector<Sight>& kept;  // between updates, also of further sensors
    size_t number;
    float min_gap;

    Sight* begin() const { return kept.data(); }
    Sight* end() const { return kept.data() + number; }

    // Whether a place below a surface at height `top` over a cell is free.
    bool are_free_below(float x, float y, float top) const {
        for (const Sight& sight : *this)
            for (const float part : HEIGHTS)
                if (sight.is_free(x, y, top - part * min_gap, size)) return true;
        return false;
    }

    // Find the heights of the highest and the lowest ray over the cells of a row [m].
    void heights(float x, const float* y, int64_t W, float* highest, float* lowest) const {
        constexpr int64_t BLOCK = 64;
        std::fill_n(highest, W, -INFINITE), std::fill_n(lowest, W, INFINITE);
        for (const Sight& sight : *this) {
            const float dx = x - sight.origin[0];
            for (int64_t first = 0; first < W; first += BLOCK) {
                float d[BLOCK];
                int32_t place[BLOCK];
                const int64_t number = std::min(BLOCK, W - first);
                for (int64_t n = 0; n < number; n++) {
                    const float dy = y[first + n] - sight.origin[1];
                    d[n] = horizontal(dx, dy);
                    place[n] = size.row_behind(d[n]) * size.azimuths + size.azimuth_bin(dx, dy);
                }
                for (int64_t n = 0; n < number; n++) {
                    const float up = sight.origin[2] + sight.slopes[place[n]].highest * d[n];
                    const float down = sight.origin[2] - sight.slopes[place[n]].fall * d[n];
                    highest[first + n] = std::max(highest[first + n], up);
                    lowest[first + n] = std::min(lowest[first + n], down);
                }
            }
        }
    }
};

}  // namespace levels
