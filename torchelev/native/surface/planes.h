// Planes through the known cells of windows: stages/surface.py.
#pragma once

#include "windows.h"

// Where the known cells of windows are: the covariances of their places [cells^2].
struct Places {
    Lanes weight;  // 1 / number of cells
    Lanes u, v, uu, uv, vv;

    template <int RADIUS> [[gnu::always_inline]] static Places of(const Window<RADIUS>& window, int column) {
        const int r = window.radius();
        const float full = float((2 * r + 1) * (2 * r + 1)), variance = float(r * (r + 1)) / 3;
        Lanes n{};
        window.each([&](int k) { n += window.at(k, Lines::N, column); });
        const Lanes weight = 1 / larger(n, all(1));
        if (!any(n != full)) return {weight, all(0), all(0), all(variance), all(0), all(variance)};
        Lanes n_u{}, n_v{}, n_uu{}, n_uv{}, n_vv{};
        window.each([&](int k) {
            const Lanes known = window.at(k, Lines::N, column), known_v = window.at(k, Lines::V_N, column);
            n_v += known_v, n_uv += float(k) * known_v, n_vv += window.at(k, Lines::VV_N, column);
            n_u += float(k) * known, n_uu += float(k * k) * known;
        });
        const Lanes u = n_u * weight, v = n_v * weight;
        return {weight, u, v, n_uu * weight - u * u, n_uv * weight - u * v, n_vv * weight - v * v};
    }

    // Whether they spread in two directions: `spans_plane`.
    Flags span(float min_spread) const {
        const Lanes a = uu - min_spread, b = vv - min_spread;
        return (a >= 0) & (b >= 0) & (a * b >= uv * uv);
    }
};

// Least-squares planes: `fit_plane`.
struct Planes {
    Flags spans;
    Lanes gradient_u, gradient_v;  // [m/cell]
    Lanes residual;                // [m^2]

    template <int RADIUS>
    [[gnu::always_inline]] static Planes of(const Window<RADIUS>& window, int column, float min_spread) {
        const Places at = Places::of(window, column);
        Lanes s_z{}, s_uz{}, s_vz{}, s_zz{};
        window.each([&](int k) {
            const Lanes height = window.at(k, Lines::Z, column);
            s_z += height, s_uz += float(k) * height;
            s_vz += window.at(k, Lines::V_Z, column), s_zz += window.at(k, Lines::ZZ, column);
        });
        const Lanes z = s_z * at.weight, uz = s_uz * at.weight - at.u * z, vz = s_vz * at.weight - at.v * z;
        const Lanes det = at.uu * at.vv - at.uv * at.uv, trace = at.uu + at.vv;
        const Flags is_regular = det > MIN_DET;  // `solve_gradient`
        const Lanes scale = 1 / pick(is_regular, det, larger(trace, all(MIN_TRACE)));
        const Lanes gradient_u = pick(is_regular, at.vv * uz - at.uv * vz, uz) * scale;
        const Lanes gradient_v = pick(is_regular, at.uu * vz - at.uv * uz, vz) * scale;
        const Lanes zz = s_zz * at.weight - z * z, residual = zz - gradient_u * uz - gradient_v * vz;
        return {at.span(min_spread), gradient_u, gradient_v, larger(residual, all(0))};
    }
};
