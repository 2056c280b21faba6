// What an update of levels reads and writes: native.py.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/places.h"

namespace levels {

// `_Update` of native.py.
struct Update {
    const float* points;         // (B, S, N, 3) [m] sensor frame
    const double* T_map_sensor;  // (B, S, 4, 4)
    const double* T_map_base;    // (B, 4, 4), or null
    const float* variance;       // (B, S, N) [m^2], or null
    const uint8_t* own;          // (B, S, N) points on the robot's links, or null
    const float* dt;             // (B) [s]
    const int64_t* corner;       // (B, 2) of the maps
    // The maps, recentred.
    float *elevation, *ground_variance;
    uint8_t* validity;
    float* ground_support;
    uint8_t* challenger_support;
    float* ground_time;
    uint8_t* bounded;
    const float* disagreement;  // (B) [m]
    // The levels, in rings: cell k of an axis lies at k modulo the window's size.
    int64_t* before;  // (B, 2) corners of the levels
    float *lower, *upper, *level_variance, *support, *time, *free_top;
    uint8_t* is_open;
    uint8_t* aside;       // (B, S, N)
    int64_t* statistics;  // (B, 5)
    int64_t B, S, N, H, W, L;
    double resolution;
    float noise_factor, noise_floor, min_distance, max_distance, box[6], ramp[4];
    float variance_rate, max_variance, max_support, variance_floor;
    float min_gap, max_step, min_support, min_time, overlap_height, overlap_radius;
    int32_t has_box, has_ramp, by_gap, max_blind, azimuths, elevations, ranges;
};

enum Statistic { OPENED, CLEARED, MERGED, DROPPED, CHOSEN, STATISTICS };

// A scan's points of one map, M = S * N, in map axes.
struct Points {
    std::vector<float> z, noise;          // [m], [m^2]
    std::vector<float> rho, slope;        // [m] horizontal range, and rise of the ray
    std::vector<int32_t> direction, reach;  // entries of the ray in the tables of `Sight`
    std::vector<int32_t> cell;            // of the window, -1 outside or where the point does not count
    std::vector<uint8_t> casts, above;    // its ray counts; it lies above the exclusion ramp

    void resize(int64_t M) {
        for (std::vector<float>* values : {&z, &noise, &rho, &slope}) values->resize(M);
        for (std::vector<int32_t>* values : {&direction, &reach, &cell}) values->resize(M);
        casts.resize(M), above.resize(M);
    }
};

}  // namespace levels
