// The azimuth of a ray without an arc tangent: `azimuth_fraction` of polar_table.py.
#pragma once

#include "kernels/scalar.h"

namespace visibility {

// `mirrored`
template <class V> INLINE V mirrored(V angle, float full, V side) {
    return absolute(angle + pick(is_negative(side), splat<V>(-full), splat<V>(0)));
}

// `azimuth_fraction`, in turns
template <class V> INLINE V azimuth_fraction(V x, V y) {
    const V ax = absolute(x), ay = absolute(y);
    const V t = smaller(ax, ay) / larger(larger(ax, ay), splat<V>(1e-30f));
    const V eighth = t * (0.125f + 0.0434f * (1 - t));
    return mirrored(mirrored(mirrored(eighth, 0.25f, ax - ay), 0.5f, x), 1.0f, y);
}

}  // namespace visibility
