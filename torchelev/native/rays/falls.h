// The falls from a sensor to the ground, along one azimuth: horizon.py, with the same names.
#pragma once

#include <algorithm>
#include <limits>
#include <utility>

#include "../lanes.h"
#include "../threads.h"

// [m], RaycastConfig
struct Settings {
    float resolution, step, relief, beyond, gate, min_time;
};

struct Layers {
    const float *elevation, *variance, *time;
    const uint8_t* validity;
};

// The map of one environment, as its sensor sees it.
class Ground {
    const Settings& settings;
    const Layers layers;
    const float x, y, z;            // [m] the sensor
    const float first_i, first_j;   // cell of the map that the lattice's corner lies in
    const float last_i, last_j;
    const int width;

  public:
    Ground(const Settings& settings, const Layers& layers, const float* origin, const float* offset, int64_t height,
           int64_t width)
        : settings(settings), layers(layers), x(origin[0]), y(origin[1]), z(origin[2]),
          first_i(__builtin_nearbyintf(offset[0] / settings.resolution)),
          first_j(__builtin_nearbyintf(offset[1] / settings.resolution)), last_i(float(height - 1)),
          last_j(float(width - 1)), width(int(width)) {}

    // Return the falls -dz/dr to bins k of an azimuth.
    Lanes falls(Lanes k, float cosine, float sine) const {
        const Lanes rho = (k + 0.5f) * settings.step;
        const Lanes i = floor_of((x + rho * cosine) / settings.resolution) + first_i;
        const Lanes j = floor_of((y + rho * sine) / settings.resolution) + first_j;
        const Lanes near_i = clamp(i, 0, last_i), near_j = clamp(j, 0, last_j);
        const Flags inside = (i == near_i) & (j == near_j);
        return pick(inside, below_sensor(integers(near_i) * width + integers(near_j)), all(settings.beyond)) / rho;
    }

  private:
    // Return how far below the sensor the cells' lowest ground lies [m], NO_FALL where it was not hit recently.
    Lanes below_sensor(Flags slot) const {
        const Flags recent = (gather(layers.validity, slot) > 0) & (gather(layers.time, slot) <= settings.min_time);
        const Lanes deviation = root(gather(layers.variance, slot) + settings.relief);
        const Lanes margin = smaller(settings.gate * deviation, all(NOWHERE));
        return pick(recent, z - (gather(layers.elevation, slot) - margin), all(NO_FALL));
    }
};

struct Azimuth {
    const Ground& ground;
    float cosine, sine;
};

constexpr float NONE = std::numeric_limits<float>::infinity();

// Return the numbers SHIFT places later.
template <int SHIFT, int... I> inline Lanes later(Lanes a, std::integer_sequence<int, I...>) {
#ifdef __clang__
    return __builtin_shufflevector(all(NONE), a, (LANES - SHIFT + I)...);
#else
    return __builtin_shuffle(all(NONE), a, Flags{(LANES - SHIFT + I)...});
#endif
}

// Return the minimum of each number and those before it.
template <int SHIFT = 1> inline Lanes running_minimum(Lanes a) {
    if constexpr (SHIFT < LANES)
        return running_minimum<2 * SHIFT>(smaller(a, later<SHIFT>(a, std::make_integer_sequence<int, LANES>())));
    else
        return a;
}

// Write the running minimum of the falls to so many bins; room is for whole vectors.
inline void march(const Azimuth& azimuth, int number, float* steepest) {
    Flags index;
    for (int l = 0; l < LANES; l++) index[l] = l;
    Lanes lowest = all(NONE);
    for (int k = 0; k < number; k += LANES) {
        const Lanes falls = azimuth.ground.falls(numbers(index + k), azimuth.cosine, azimuth.sine);
        lowest = smaller(running_minimum(falls), lowest);
        store(steepest + k, lowest);
        lowest = all(lowest[LANES - 1]);
    }
}
