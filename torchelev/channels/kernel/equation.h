// How the values of points become those of a channel: fuse.py and state.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace channels {

constexpr float POINT = 1e-4f;  // [m^2] variance of a height that counts as one point

enum Kind : int32_t { MEAN, EXPONENTIAL, MAXIMUM, COLOR, CLASS, CLASS_AVERAGE, FEATURE };  // KINDS of config.py

inline bool is_weighted(int32_t kind) { return kind == MEAN || kind == COLOR || kind == FEATURE; }

// What a value v with evidence W becomes by `added`, sum w x or the largest x, with `total` = sum w > 0.
inline float combine(int32_t kind, float v, float W, float added, float total, float rate) {
    const float mean = added / total;
    if (is_weighted(kind)) return v + (mean - v) * (total / (W + total));
    if (kind == CLASS) return v + added;
    if (kind == MAXIMUM) return W > 0 ? std::max(v, added) : added;
    return W > 0 ? (1 - rate) * v + rate * mean : mean;
}

}  // namespace channels
