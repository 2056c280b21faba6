// Height drift: stage.py, with the same names.
#pragma once

#include "kernels/scalar.h"

namespace drift {

// Height error [m] of a point against its cell's plane: e = p_z - h (paper, Sec. II-D), by the point's place [m].
template <class V>
INLINE V height_error(V p_x, V p_y, V p_z, V elevation, V gx, V gy, const CompensateSettings& s) {
    const V x = (floor_of(p_x / s.resolution) + 0.5f) * s.resolution;  // the centre of the cell
    const V y = (floor_of(p_y / s.resolution) + 0.5f) * s.resolution;
    const V at_origin = elevation - gx * x - gy * y;
    return p_z - (at_origin + gx * p_x + gy * p_y);
}

// Whether a known cell is flat and certain enough to measure the drift.
template <class V> INLINE auto suits(V traversability, V variance, const CompensateSettings& s) {
    return (traversability >= s.min_traversability) & (variance <= s.max_variance);
}

// Whether an error lies within the gate around the mean error.
template <class V> INLINE auto is_near_mean(V error, V mean, V noise, const CompensateSettings& s) {
    return square(error - mean) <= s.gate_square * (noise + s.relief_square);
}

// Whether the mean error of so many points is corrected; `moves` is null where the caller says nothing of it.
INLINE bool applies(float mean, int64_t number, const uint8_t* moves, const CompensateSettings& s) {
    return number >= s.min_points && absolute(mean) <= s.max_drift && (!moves || *moves);
}

}  // namespace drift
