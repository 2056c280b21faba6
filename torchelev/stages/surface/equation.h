// Local planes and the analytic rating: plane_fit.py and traversability/heads.py, with the same names.
#pragma once

#include "kernels/scalar.h"

namespace surface {

// Sums over the known cells of a window whose middle is known: u counts rows and v columns from it, z is a height [m].
template <class V> struct Moments {
    V n, u, v, uu, uv, vv, z, uz, vz, zz;
};

// `Plane`, its gradient still in [m/cell].
template <class V> struct Plane {
    decltype(V{} < V{}) spans;
    V gradient_u, gradient_v, residual;
};

// Whether known cells spread in two directions, by the covariance of their places [cells^2].
template <class V> INLINE decltype(V{} < V{}) spans_plane(V uu, V uv, V vv, float min_spread) {
    const V a = uu - min_spread, b = vv - min_spread;
    return (a >= 0) & (b >= 0) & (a * b >= uv * uv);
}

// Solve [uu uv; uv vv] gradient = (uz, vz), along the line where the cells lie on one.
template <class V> INLINE void solve_gradient(V uu, V uv, V vv, V uz, V vz, const SurfaceSettings& s, Plane<V>& plane) {
    const V det = uu * vv - uv * uv, trace = uu + vv;
    const auto is_regular = det > s.min_det;
    const V scale = 1 / pick(is_regular, det, larger(trace, splat<V>(s.min_trace)));
    plane.gradient_u = pick(is_regular, vv * uz - uv * vz, uz) * scale;
    plane.gradient_v = pick(is_regular, uu * vz - uv * uz, vz) * scale;
}

// Fit z = c + gradient_u u + gradient_v v by least squares.
template <class V> INLINE Plane<V> fit_plane(const Moments<V>& m, float min_spread, const SurfaceSettings& s) {
    const V w = 1 / m.n, u = m.u * w, v = m.v * w, z = m.z * w;
    const V uu = m.uu * w - u * u, uv = m.uv * w - u * v, vv = m.vv * w - v * v;
    const V uz = m.uz * w - u * z, vz = m.vz * w - v * z, zz = m.zz * w - z * z;
    Plane<V> plane{spans_plane(uu, uv, vv, min_spread), {}, {}, {}};
    solve_gradient(uu, uv, vv, uz, vz, s, plane);
    plane.residual = larger(zz - plane.gradient_u * uz - plane.gradient_v * vz, splat<V>(0));
    return plane;
}

// Rating by the worst of slope, step [m] and roughness.
template <class V> INLINE V traversability(const Plane<V>& plane, V step, const SurfaceSettings& s) {
    const V tiny = splat<V>(1e-12f), x = plane.gradient_u * s.per_cell, y = plane.gradient_v * s.per_cell;
    const V slope = arctan(root(larger(x * x + y * y, tiny)));
    const V roughness = root(larger(plane.residual, tiny));
    const V worst = larger(slope * s.per_critical[0], step * s.per_critical[1]);
    return larger(1 - larger(worst, roughness * s.per_critical[2]), splat<V>(0));
}

}  // namespace surface
