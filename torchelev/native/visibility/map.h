// One map, one sensor, and what is known of the ground before rays are cast: accepted_rays.py.
#pragma once

#include <cmath>
#include <vector>

#include "../lanes.h"
#include "../threads.h"
#include "polar.h"

struct Settings {
    int H, W;
    double resolution, min_time, min_incidence, min_support, gate;
    int num_threads;  // for one map
};

struct Layers {
    const float *elevation, *variance, *support, *challenger, *time, *gradient_x, *gradient_y;
    bool* validity;
    uint8_t* challenger_support;
    float* upper_bound;
    bool* bounded;
};

struct Sensor {
    const float* points;    // (N, 3) [m]
    const float* variance;  // (N,) [m^2]
    const bool *used, *casts;
    int N;
    float x, y, z;             // [m] of its origin
    float offset_x, offset_y;  // [m] of the measurement's origin in the window
    float center_x, center_y;  // [cells] of the first cell's centre from the measurement's origin
};

struct Slots {
    Flags slot, inside;
};

struct Map {
    const Settings& cfg;
    const Polar& polar;
    const Layers& layers;
    const Sensor& sensor;
    const int H = cfg.H, W = cfg.W;
    const float resolution = float(cfg.resolution), half = float(0.5 * cfg.resolution);
    std::vector<float> lowest, ground, below, borders;  // [m]
    std::vector<float> falls, table;                    // by range and azimuth

    Slots locate(Lanes x, Lanes y) const {
        const float first_i = std::nearbyint(sensor.offset_x / resolution);
        const float first_j = std::nearbyint(sensor.offset_y / resolution);
        const Lanes i = floor(x / resolution) + first_i, j = floor(y / resolution) + first_j;
        const Lanes near_i = clamp(i, 0, float(H - 1)), near_j = clamp(j, 0, float(W - 1));
        const Flags slot = __builtin_convertvector(near_i, Flags) * W + __builtin_convertvector(near_j, Flags);
        return {slot, (i == near_i) & (j == near_j)};
    }

    float margin(float variance) const {
        return std::min(float(cfg.gate) * std::sqrt(variance + float(0.5 * cfg.resolution * (0.5 * cfg.resolution))),
                        NOWHERE);
    }

    bool is_enough(int i, int j) const {
        const int c = i * W + j;
        return layers.validity[c] && layers.support[c] >= float(cfg.min_support);
    }

    float enough_ground(int i, int j) const {
        if (i < 0 || i >= H || j < 0 || j >= W) return NOWHERE;
        return layers.elevation[i * W + j] + (is_enough(i, j) ? 0 : NOWHERE);
    }

    // What rays must not pass below, of the cells of a row.
    void read_row(int i) {
        for (int j = 0; j < W; j++) {
            const int c = i * W + j;
            const float height = layers.elevation[c];
            float unlike = INFINITY;
            if (layers.validity[c] && !is_enough(i, j))
                for (float other : {enough_ground(i - 1, j), enough_ground(i, j - 1), enough_ground(i, j + 1),
                                    enough_ground(i + 1, j)})
                    unlike = std::min(unlike, std::fabs(other - height));
            const bool is_well = is_enough(i, j) || unlike <= resolution;
            lowest[c] = height - margin(layers.variance[c]);
            ground[c] = height + (is_well ? 0 : NOWHERE);
            const bool is_recent = layers.validity[c] && layers.time[c] <= float(cfg.min_time);
            below[c] = is_recent ? sensor.z - lowest[c] : NO_FALL;
        }
    }

    int border_length() const { return std::max(H, W); }

    // The lowest ground NEAR each place of the borders of low x, high x, low y and high y.
    void read_borders() {
        const int cells = std::max(1, int(NEAR / cfg.resolution)), L = border_length();
        std::vector<float> minima(L + 2 * cells);
        for (int side = 0; side < 4; side++) {
            std::fill(minima.begin(), minima.end(), NOWHERE);
            const bool is_row = side < 2, is_far = side % 2;
            const int depth = is_row ? H : W, length = is_row ? W : H;
            for (int k = 0; k < length; k++) {
                float low = INFINITY;
                for (int d = 0; d < std::min(cells, depth); d++) {
                    const int across = is_far ? depth - 1 - d : d;
                    low = std::min(low, ground[is_row ? across * W + k : k * W + across]);
                }
                minima[cells + k] = low;
            }
            for (int k = 0; k < L; k++)
                borders[side * L + k] = *std::min_element(&minima[k], &minima[k] + 2 * cells + 1);
        }
    }

    // The steepest fall before a ray passes below ground that was just hit, of some azimuths.
    void read_falls(int first, int last) {
        const float step = float(2 * cfg.resolution), none = float(double(NO_FALL) * (2 * cfg.resolution));
        for (int k = 0; k < polar.near_ranges; k++) {
            const float rho = (float(k) + 0.5f) * step;
            for (int a = first; a < last; a += LANES) {
                const int count = std::min(LANES, last - a);
                const Lanes x = sensor.x + rho * load(polar.near_cosine + a, count);
                const Lanes y = sensor.y + rho * load(polar.near_sine + a, count);
                const Slots at = locate(x, y);
                const Lanes fall = pick(at.inside, gather(below.data(), at.slot), all(none)) / rho;
                store(&falls[size_t(k) * polar.near_azimuths + a], fall, count);
            }
        }
        scan(falls.data(), polar.near_ranges, polar.near_azimuths, first, last, false);
    }
};
