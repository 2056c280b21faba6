// Places around a sensor by range and azimuth: the functions of polar_table.py, with the same names; see equation.h.
#pragma once

#include "kernels/scalar.h"
#include "stages/visibility/azimuth.h"

namespace visibility {

// What comparisons of V return: bool, or flags of a vector.
template <class V> using Flag = decltype(V{} < V{});

// Horizontal distance [m].
template <class V> INLINE V horizontal(V x, V y) { return root(larger(x * x + y * y, splat<V>(1e-12f))); }

// Of how many azimuth bins an entry at range k is the minimum: `PolarGrid.covered`. The first `levels` alone may count.
template <class V> INLINE V entry_of(V k, int levels, const VisibilitySettings& s) {
    V entry = splat<V>(1);
    for (int w = 0; w < levels; w++) entry += pick(k < float(s.widen[w]), splat<V>(float(int64_t(1) << w)), splat<V>(0));
    return entry;
}

// The azimuth bins that a cell covers: `first` + 0 to `further` + entry - 1, around the table.
template <class V> struct Window {
    V first, further;
};

// `lowest_slope`, of a cell at range k, where an entry is the minimum of so many azimuth bins; `azimuth` counts bins.
template <class V> INLINE Window<V> window_of(V k, V azimuth, V entry, const VisibilitySettings& s) {
    const V half = 0.5f * (s.bins * (1 / larger(k, splat<V>(0.5f))));
    const float azimuths = float(s.azimuths);
    const V a = floor_of(azimuth - half);
    const V further = larger(floor_of(azimuth + half) - a + 1 - entry, splat<V>(0));
    return {smaller(pick(a < 0, a + azimuths, a), splat<V>(azimuths - 1)), further};
}

}  // namespace visibility
