// Height drift: stage.py, with the same names.
#pragma once

#include "kernels/scalar.h"

namespace drift {

// Height error [m] of a point against its cell's plane: e = p_z - h (paper, Sec. II-D). `x` and `y` are the centre of
// the cell, `p_x` and `p_y` the point's place [m].
INLINE float height_error(float p_x, float p_y, float p_z, float elevation, float gx, float gy, float x, float y) {
    const float at_origin = elevation - gx * x - gy * y;
    return p_z - (at_origin + gx * p_x + gy * p_y);
}

// Whether a cell is flat and certain enough to measure the drift.
INLINE bool suits(bool known, float traversability, float variance, const CompensateSettings& s) {
    return known && traversability >= s.min_traversability && variance <= s.max_variance;
}

// Whether an error lies within the gate around the mean error.
INLINE bool is_near_mean(float error, float mean, float noise, const CompensateSettings& s) {
    return square(error - mean) <= s.gate_square * (noise + s.relief_square);
}

// The correction [m] that so many points with this mean error make.
INLINE float correction(float mean, int64_t number, const CompensateSettings& s) {
    return number >= s.min_points && absolute(mean) <= s.max_drift ? s.gain * mean : 0;
}

}  // namespace drift
