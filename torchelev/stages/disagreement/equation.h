// By how much sensors, or successive scans, disagree in height: stage.py, with the same names.
#pragma once

#include "kernels/scalar.h"

namespace disagreement {

// Standard deviation [m] of the height error of each scan, by the last correction, the deviation so far, and this
// correction and its variance: d^2 <- max(0, d^2 + w (-c_k-1 c_k - d^2)).
INLINE float compare_scans(float last, float before, float correction, float error_variance,
                           const DisagreementSettings& s) {
    const float d2 = square(before);
    const bool counts = square(correction) > s.significant_square * error_variance;
    const float product = counts ? last * correction : 0.0f, mean = larger(d2 - s.newest * (product + d2), 0.0f);
    return root(last != 0 && correction != 0 ? mean : d2);
}

// Variance [m^2] of a cell relative to the others: `without_disagreement`, with the squared disagreement, 0 if unknown.
template <class V> INLINE V without(V variance, V d2, const DisagreementSettings& s) {
    return larger(variance - d2, smaller(variance, splat<V>(s.least)));
}

}  // namespace disagreement
