// What an update brings: native.py.
#pragma once

#include <cstdint>

#include "channels/kernel/equation.h"
#include "channels/kernel/places.h"

namespace channels {

using places::Frame, places::INFINITE, places::Origin, places::TINY;

// `_Channel` of native.py.
struct Channel {
    float *values, *weight, *age;  // (B, H, W, C), (B, H, W), (B, H, W) or null
    const float* features;         // (B, M, C), null if the update brings none
    int64_t C;
    int32_t kind;
    float rate, half_life, max_age, tolerance;  // half_life: infinite for none
};

// `_Update` of native.py.
struct Update {
    const float* points;          // (B, S, N, 3) [m] sensor frame
    const double* T_map_sensor;   // (B, S, 4, 4)
    const double* T_map_base;     // (B, 4, 4), or null
    const float* variance;        // (B, S, N) [m^2], or null
    const uint8_t* own;           // (B, S, N) points on the robot's links, or null
    const float *dt, *drift;      // (B) [s], (B) [m] or null
    const int64_t* corner_now;    // (B, 2)
    const float* elevation;       // (B, H, W) [m]
    const uint8_t* validity;      // (B, H, W)
    int64_t* corner;              // (B, 2)
    float* height;                // (B, H, W) [m]
    const Channel* channels;      // (K)
    int64_t B, S, N, H, W, K;
    double resolution;
    float noise_factor, noise_floor, min_distance, max_distance;  // of the sensor [m]
    float box[6];                 // [m] lower and upper corner of the robot's box, base frame
    float ramp[4];                // slope, distance [m], offset [m] and height [m] of the exclusion ramp
    int32_t has_box, has_ramp;
};

}  // namespace channels
