// Which pixel of a camera shows the ground of a cell, and whether the map hides it: camera.py.
#pragma once

#include <cmath>
#include <cstdint>

namespace channels {

constexpr float NEAREST = 0.05f;  // [m] along the axis

// One camera: its place seen from the centre of the window's first cell [m], rotation, K and lens.
struct Camera {
    float R[9];            // T_map_camera, optical axes, row by row
    float x, y, z;         // [m] from the camera to that centre; z: of the camera, map frame
    float fx, skew, cx, fy, cy;
    float lens[8];         // k1, k2, p1, p2, k3, k4, k5, k6; of a pinhole 0
    float largest_radius;  // that the lens shows; infinite for a pinhole

    // Find the pixel of a point that is (dx, dy, dz) [m] from the camera, map axes; return whether there is one.
    bool project(float dx, float dy, float dz, float& u, float& v) const {
        const float X = R[0] * dx + R[3] * dy + R[6] * dz, Y = R[1] * dx + R[4] * dy + R[7] * dz;
        const float Z = R[2] * dx + R[5] * dy + R[8] * dz;
        if (!(Z > NEAREST)) return false;
        float a = X / Z, b = Y / Z;
        const float r2 = a * a + b * b;
        if (largest_radius < INFINITY) {
            if (!(std::sqrt(r2) < largest_radius)) return false;
            const float* k = lens;
            const float f = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])));
            const float p1 = k[2], p2 = k[3], A = a, B = b;
            a = A * f + 2 * p1 * A * B + p2 * (r2 + 2 * A * A);
            b = B * f + p1 * (r2 + 2 * B * B) + 2 * p2 * A * B;
        }
        u = fx * a + skew * b + cx, v = fy * b + cy;
        return true;
    }
};

// The ground of one map of H x W cells; -inf where it is not known.
struct Ground {
    const float* high;  // [m]
    int64_t H, W;

    // Return whether the line from (i, j, z), in cells and [m], to (di, dj, dz) from there passes more than `margin`
    // below the ground between its ends, looked at once for each cell along its longer side.
    bool hides(float i, float j, float z, float di, float dj, float dz, float margin) const {
        const float steps = std::fmax(std::fmax(std::ceil(std::fabs(di)), std::ceil(std::fabs(dj))), 1.0f);
        const int64_t most = H > W ? H : W;  // what lies farther back is out of the window
        for (int64_t back = 1; back < most && float(back) < steps; back++) {
            const float share = (steps - float(back)) / steps;
            const float a = std::floor(i + share * di), b = std::floor(j + share * dj);
            if (!(a >= 0 && a < float(H) && b >= 0 && b < float(W))) continue;
            if (high[int64_t(a) * W + int64_t(b)] > z + share * dz + margin) return true;
        }
        return false;
    }
};

}  // namespace channels
