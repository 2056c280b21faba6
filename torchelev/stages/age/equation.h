// Process noise: stage.py.
#pragma once

#include "kernels/scalar.h"

namespace aging {

// Variance [m^2] after a time, sigma_m^2 + sigma_t^2 dt (paper, Sec. II-C), where `added` = sigma_t^2 dt.
template <class V> INLINE V grow(V variance, float added) { return variance + added; }

}  // namespace aging
