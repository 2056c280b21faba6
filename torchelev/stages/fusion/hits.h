// The points of a scan that lie in the window, sorted by their cell.
#pragma once

#include "kernels/update.h"
#include "stages/fusion/equation.h"

namespace fusion {

struct alignas(16) Hit {
    int32_t slot, index;  // of the cell and of the point
    float z, noise;       // [m], [m^2]
};

struct Ray {
    float x, y;   // [m] from the sensor to the point
    bool passed;  // over the cell's centre before it hit
};

// Sorted hits, and what else the update needs of them.
struct Scan {
    const Hit* hits;
    const Measurement& m;
    const FusionSettings& s;
    float of_map;  // [m^2] variance that all heights of the map share

    bool has_shared() const { return m.has_covariance; }

    float shared(int64_t k) const {
        return m.has_covariance ? relative_variance(m.noise[k], m.of_pose[k], of_map) : 0.0f;
    }
    Ray ray(int64_t k) const {
        const float* origin = &m.origin[3 * (k / (m.number / m.sensors))];
        const float x = m.x[k] - origin[0], y = m.y[k] - origin[1];
        return {x, y, passed_center(m.x[k], m.y[k], x, y, s.resolution)};
    }
};

}  // namespace fusion
