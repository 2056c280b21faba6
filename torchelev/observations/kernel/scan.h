// Points of height scans, and layers read there: patterns.py, fill.py and ../layers.py.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#include "kernels/simd.h"

namespace scans {

constexpr float FAR = 1e6f;  // [cells] farther points are clamped
constexpr float UNKNOWN = std::numeric_limits<float>::infinity();
constexpr double MIN_HORIZONTAL = 0.1;

enum Mode : int32_t { BILINEAR, NEAREST, MINIMUM };   // fill.MODES
enum Alignment : int32_t { YAW, BASE, WORLD };        // patterns.ALIGNMENTS

struct Read {
    Lanes value;  // 0 where not known
    Flags known;
};

// A layer, or a part of one that begins `top` rows and `left` columns into it. Cells outside are not known.
template <class Known> struct Cells {
    const float* values;
    const Known* known;  // 0 where not
    float height, width;
    int stride;  // of rows
    float top = 0, left = 0;

    Read at(Lanes i, Lanes j) const {
        i -= top;
        j -= left;
        const Flags inside = (i >= 0) & (i < height) & (j >= 0) & (j < width);
        const Flags place = pick_int(inside, integers(i) * stride + integers(j), Flags{});
        const Flags is_known = (gather(known, place) != 0) & inside;
        return {pick(is_known, gather(values, place), splat(0)), is_known};
    }
};

// A layer, and another one where the first is not known.
struct Either {
    Cells<uint8_t> first, second;

    Read at(Lanes i, Lanes j) const {
        const Read a = first.at(i, j), b = second.at(i, j);
        return {pick(a.known, a.value, b.value), a.known | b.known};
    }
};

inline Flags are_finite(Lanes a) { return absolute(a) < UNKNOWN; }

// Move what is not a number far outside, too: it compares as false.
inline Lanes clamp_points(Lanes u) { return clamp(u, -FAR, FAR); }

template <class Layer> Read read_nearest(const Layer& layer, Lanes u, Lanes v) {
    return layer.at(floor_of(clamp_points(u)), floor_of(clamp_points(v)));
}

// The lowest known one of the cell whose centre precedes the point, and the next ones along x and along y.
template <class Layer> Read read_minimum(const Layer& layer, Lanes u, Lanes v) {
    u -= 0.5f;
    v -= 0.5f;
    const Read corners[] = {read_nearest(layer, u, v), read_nearest(layer, u + 1, v), read_nearest(layer, u, v + 1)};
    Lanes low = splat(UNKNOWN);
    for (const Read& corner : corners) low = pick(corner.known, smaller(corner.value, low), low);
    return {pick(low < UNKNOWN, low, splat(0)), low < UNKNOWN};
}

// The mean of the known ones of four cells by their bilinear weights, known if these sum to at least one half.
template <class Layer> Read read_bilinear(const Layer& layer, Lanes u, Lanes v) {
    u = clamp_points(u), v = clamp_points(v);
    const Lanes i = floor_of(u - 0.5f), j = floor_of(v - 0.5f);
    const Lanes a = u - 0.5f - i, b = v - 0.5f - j;
    const Lanes weights[] = {(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b};
    Lanes total = splat(0), sum = splat(0);
    for (int k = 0; k < 4; k++) {
        const Read cell = layer.at(i + float(k / 2), j + float(k % 2));
        const Lanes weight = pick(cell.known, weights[k], splat(0));
        total += weight;
        sum += weight * cell.value;
    }
    const Flags known = total >= 0.5f;
    return {pick(known, sum / total, splat(0)), known};
}

template <class Layer> Read read(const Layer& layer, Lanes u, Lanes v, int32_t mode) {
    if (mode == MINIMUM) return read_minimum(layer, u, v);
    return mode == NEAREST ? read_nearest(layer, u, v) : read_bilinear(layer, u, v);
}

// The horizontal parts of a pattern's x and y axes. The pose is rounded to Real, in which it was given.
template <class Real> void find_axes(const double* pose, int32_t alignment, float (&x)[2], float (&y)[2]) {
    Real forward[]{Real(pose[0]), Real(pose[4])}, left[]{Real(pose[1]), Real(pose[5])};
    if (alignment == YAW) {
        const auto length = [&] { return std::sqrt(std::fma(forward[1], forward[1], forward[0] * forward[0])); };
        if (!(length() >= Real(MIN_HORIZONTAL))) forward[0] = left[1], forward[1] = -left[0];
        const Real norm = length();
        for (Real& part : forward) part /= norm;
        left[0] = -forward[1], left[1] = forward[0];
    }
    for (int axis = 0; axis < 2; axis++) x[axis] = float(forward[axis]), y[axis] = float(left[axis]);
}

// One coordinate of a turned offset; the sum is rounded once, as by torch's addcmul.
inline float turn(float along, float across, float x, float y) { return __builtin_fmaf(across, y, along * x); }

// A coordinate [m] in cells from the window's corner.
inline float to_cells(double x, int64_t corner, double resolution) { return float(x / resolution - double(corner)); }

}  // namespace scans
