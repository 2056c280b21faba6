// One robot's image of the map at a time: map_image.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "kernels/threads.h"
#include "observations/kernel/scan.h"

namespace images {

using namespace scans;

constexpr int64_t FEW = 4096;  // pixels, which one thread reads before another one wakes up

// `_Source` of image_kernel.py: a layer (B, height, width), another one that counts where it is unknown or null, and
// the channels that it becomes, -1 for none.
struct Source {
    const float* values;
    const uint8_t* known;
    const float* second;
    const uint8_t* second_known;
    int64_t channel, validity_channel, is_height;
};

// `_Images` of image_kernel.py.
struct Images {
    const double* pose;     // (B, 4, 4)
    const int64_t* corner;  // (B, 2)
    const float* pattern;   // (P, 2) [m]
    const Source* sources;
    float* images;  // (B, channels, P)
    double resolution;
    int64_t B, P, channels, num_sources, height, width;
    int32_t mode, alignment, is_single;
    float nominal_height;
};

// The pixels of one robot at a time; of a thread.
struct Pixels {
    const Images& all;
    std::vector<float> u, v;  // [cells]

    explicit Pixels(const Images& all) : all(all), u(all.P + LANES), v(all.P + LANES) {}

    void place(const double* pose, const int64_t* corner) {
        float x[2], y[2], start[2];
        (all.is_single ? find_axes<float> : find_axes<double>)(pose, all.alignment, x, y);
        for (int axis = 0; axis < 2; axis++) start[axis] = to_cells(pose[3 + 4 * axis], corner[axis], all.resolution);
        const float resolution = float(all.resolution);
        for (int64_t k = 0; k < all.P; k++) {
            const float along = all.pattern[2 * k] / resolution, across = all.pattern[2 * k + 1] / resolution;
            const bool is_world = all.alignment == WORLD;
            u[k] = start[0] + (is_world ? along : along * x[0] + across * y[0]);
            v[k] = start[1] + (is_world ? across : along * x[1] + across * y[1]);
        }
    }

    template <class Layer> void show(const Source& source, const Layer& layer, float reference, float* image) const {
        for (int64_t k = 0; k < all.P; k += LANES) {
            const int count = int(std::min<int64_t>(LANES, all.P - k));
            const Read found = read(layer, load(&u[k]), load(&v[k]), all.mode);
            const Lanes height = pick(found.known, found.value - reference, Lanes{});
            if (source.channel >= 0)
                store(image + source.channel * all.P + k, source.is_height ? height : found.value, count);
            if (source.validity_channel >= 0)
                store(image + source.validity_channel * all.P + k, one_if(found.known), count);
        }
    }

    void show(const Source& source, int64_t b, float reference, float* image) const {
        const int64_t first = b * all.height * all.width;
        const auto cells = [&](const float* values, const uint8_t* known) {
            return Cells<uint8_t>{values + first, known + first, float(all.height), float(all.width), int(all.width)};
        };
        const auto layer = cells(source.values, source.known);
        if (source.second)
            show(source, Either{layer, cells(source.second, source.second_known)}, reference, image);
        else
            show(source, layer, reference, image);
    }

    void show(int64_t b) {
        const double* pose = all.pose + 16 * b;
        float* image = all.images + b * all.channels * all.P;
        const float reference = float(pose[11]) - all.nominal_height;
        if (!std::isfinite(reference)) return void(std::fill_n(image, all.channels * all.P, 0.0f));
        place(pose, all.corner + 2 * b);
        for (int64_t k = 0; k < all.num_sources; k++) show(all.sources[k], b, reference, image);
    }
};

}  // namespace images
