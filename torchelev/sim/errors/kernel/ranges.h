// Errors of a measured range: range_errors.py. Here u is uniform from 0 to 1.
#pragma once

#include <cmath>

inline float at_least(float value, float limit) { return value < limit ? limit : value; }

// The range that differs more from d: that of a neighbour, or the one found so far. A missing return makes no edge.
inline float farther(float d, float across, float neighbour) {
    return std::fabs(neighbour - d) > std::fabs(across - d) ? neighbour : across;
}

inline float add_flying_point(float d, float across, float u, float fraction, float step) {
    const bool is_flying = (u < fraction) & (std::fabs(across - d) > step);
    return is_flying ? d + (across - d) * (u / at_least(fraction, 1e-6f)) : d;
}

inline float add_artefact(float d, float u, float short_fraction, float long_fraction) {
    const float too_short = 0.1f + 0.9f * u / at_least(short_fraction, 1e-6f);
    const float too_long = 1.05f + 0.95f * (u - short_fraction) / at_least(long_fraction, 1e-6f);
    return d * (u < short_fraction ? too_short : u < short_fraction + long_fraction ? too_long : 1.0f);
}

inline float quantise(float value, float step) { return __builtin_rintf(value / at_least(step, 1e-9f)) * step; }

// What a point at x is multiplied by, so that 1 / x is a multiple of a positive step; NaN if it is lost.
inline float quantise_disparity(float x, float step) {
    const float num_steps = __builtin_rintf(1 / (at_least(x, 1e-6f) * at_least(step, 1e-9f)));
    const bool is_seen = (x > 0) & (num_steps > 0);
    return is_seen ? 1 / (num_steps * at_least(step, 1e-9f) * x) : __builtin_nanf("");
}
