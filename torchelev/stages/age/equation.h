// Process noise: stage.py.
#pragma once

#include "kernels/scalar.h"

namespace aging {

// Variance [m^2] of a known cell after a time, sigma_m^2 + sigma_t^2 dt (paper, Sec. II-C), where `added` = sigma_t^2 dt.
template <class V> INLINE V grow(V variance, float added, float max_variance) {
    return smaller(variance + added, splat<V>(max_variance));
}

}  // namespace aging
