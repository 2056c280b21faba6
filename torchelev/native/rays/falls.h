// The falls from a sensor to the ground, along one azimuth: horizon.py, with the same names.
#pragma once

#include <algorithm>
#include <limits>
#include <memory>
#include <utility>

#include "kernels/simd.h"
#include "kernels/threads.h"

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
    std::unique_ptr<float[]> of_all;  // `below_sensor` of each cell, after `look_at_all`

  public:
    const int64_t number;  // of cells

    Ground(const Settings& settings, const Layers& layers, const float* origin, const float* offset, int64_t height,
           int64_t width)
        : settings(settings), layers(layers), x(origin[0]), y(origin[1]), z(origin[2]),
          first_i(__builtin_nearbyintf(offset[0] / settings.resolution)),
          first_j(__builtin_nearbyintf(offset[1] / settings.resolution)), last_i(float(height - 1)),
          last_j(float(width - 1)), width(int(width)), number(height * width) {}

    // Return the falls -dz/dr to bins k of an azimuth.
    Lanes falls(Lanes k, float cosine, float sine) const {
        const Lanes rho = (k + 0.5f) * settings.step;
        const Lanes i = floor_of((x + rho * cosine) / settings.resolution) + first_i;
        const Lanes j = floor_of((y + rho * sine) / settings.resolution) + first_j;
        const Lanes near_i = clamp(i, 0, last_i), near_j = clamp(j, 0, last_j);
        const Flags inside = (i == near_i) & (j == near_j);
        const Flags slot = integers(near_i) * width + integers(near_j);
        const Lanes below = of_all ? gather(of_all.get(), slot) : below_sensor([&](auto layer) {
            return gather(layer, slot);
        });
        return pick(inside, below, all(settings.beyond)) / rho;
    }

    // Look at all cells now, in their order, so that `falls` reads one number of a cell and not four.
    void look_at_all(int num_threads) {
        if (number < LANES) return;
        of_all.reset(new float[number]);
        const Parts parts{std::max(int64_t(1), number / CELLS_AT_A_TIME), num_threads};
        parts(number, [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t k = begin; k < end; k += LANES) {
                const int64_t first = std::min(k, end - LANES);  // the last ones with some of those before
                store(of_all.get() + first, below_sensor([&](auto layer) { return load_as(layer + first); }));
            }
        });
    }

  private:
    static constexpr int64_t CELLS_AT_A_TIME = 8192;  // that are worth a thread

    // Return how far below the sensor the cells' lowest ground lies [m], NO_FALL where it was not hit recently. `read`
    // returns these cells' values of a layer.
    template <class Read> Lanes below_sensor(const Read& read) const {
        const Flags recent = (read(layers.validity) > 0) & (read(layers.time) <= settings.min_time);
        const Lanes deviation = root(read(layers.variance) + settings.relief);
        const Lanes margin = smaller(settings.gate * deviation, all(NOWHERE));
        return pick(recent, z - (read(layers.elevation) - margin), all(NO_FALL));
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
