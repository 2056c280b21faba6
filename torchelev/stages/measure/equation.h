// From a sensor's points to a measurement: stage.py and pose_error.py, with the same names. V is a float or a vector.
#pragma once

#include "kernels/scalar.h"

namespace measurement {

// R p, for rows of R: `rotate`.
template <class V> struct Vector {
    V x, y, z;
};

template <class V> INLINE Vector<V> rotate(const float* R, V x, V y, V z) {
    return {R[0] * x + R[1] * y + R[2] * z, R[3] * x + R[4] * y + R[5] * z, R[6] * x + R[7] * y + R[8] * z};
}

// Variance [m^2] of a height, sigma_p^2 = alpha_d d^2 + noise_floor (paper, Sec. II-C), by the squared distance [m^2].
template <class V> INLINE V noise_of(V distance2, const MeasureSettings& s) {
    return s.noise_factor * distance2 + s.noise_floor;
}

// Whether a point lies in the exclusion area (paper, Fig. 3), by its place from the sensor [m]: `above_ramp`.
template <class V> INLINE auto above_ramp(const Vector<V>& relative, const MeasureSettings& s) {
    const V r = root(larger(relative.x * relative.x + relative.y * relative.y, splat<V>(1e-12f)));
    const V rise = larger(r - s.ramp_distance, splat<V>(0)) * s.ramp_slope + s.ramp_offset;
    return relative.z > smaller(rise, splat<V>(s.ramp_height));
}

// Whether a point lies in the body box, by its place in the base frame [m]: `inside_body`.
template <class V> INLINE auto inside_body(const Vector<V>& p, const MeasureSettings& s) {
    return (p.x >= s.box_lower[0]) & (p.x <= s.box_upper[0]) & (p.y >= s.box_lower[1]) & (p.y <= s.box_upper[1]) &
           (p.z >= s.box_lower[2]) & (p.z <= s.box_upper[2]);
}

// J Sigma J^T of a height [m^2], by the covariance (6, 6) of the pose and the place from the sensor: `project_covariance`.
template <class V> INLINE V project_covariance(const float* C, V r_x, V r_y) {
    const float zz = C[14], zr = C[15], zp = C[16], rr = C[21], rp = C[22], pp = C[28];
    const V variance = zz + 2 * (zr * r_y - zp * r_x) + rr * (r_y * r_y) - 2 * rp * r_x * r_y + pp * (r_x * r_x);
    return larger(variance, splat<V>(0));
}

}  // namespace measurement
