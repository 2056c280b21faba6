// Minima of neighbours.
#pragma once

#include <algorithm>
#include <utility>

#include "kernels/simd.h"

namespace visibility {

// Return the numbers from place SHIFT on, of two vectors one after the other.
template <int SHIFT, size_t... I> inline Lanes shifted(Lanes a, Lanes next, std::index_sequence<I...>) {
#ifdef __clang__
    return __builtin_shufflevector(a, next, int(SHIFT + I)...);
#else
    return __builtin_shuffle(a, next, Flags{int(SHIFT + I)...});
#endif
}

template <int SHIFT> inline void widen_once(Lanes& a, Lanes& next) {
    const std::make_index_sequence<LANES> places{};
    a = smaller(a, shifted<SHIFT>(a, next, places));
    next = smaller(next, shifted<SHIFT>(next, next, places));  // what it has at its end, `a` never takes in
}

// Return the minimum of each entry and the 2^LEVEL - 1 that follow it.
template <int LEVEL> inline Lanes widened(Lanes a, Lanes next) {
    if constexpr (LEVEL > 0) widen_once<1>(a, next);
    if constexpr (LEVEL > 1) widen_once<2>(a, next);
    if constexpr (LEVEL > 2 && LANES > 4) widen_once<4>(a, next);
    return a;
}

// Return the least of a vector's numbers.
inline float lowest_lane(Lanes lanes) {
    float values[LANES];
    store(values, lanes);
    for (int half = LANES / 2; half > 0; half /= 2)
        for (int l = 0; l < half; l++) values[l] = std::min(values[l], values[l + half]);
    return values[0];
}

// Make each number the minimum of itself and the `span` - 1 that follow it; `room` is for as many numbers.
inline void sliding_minimum(float* values, int64_t number, int64_t span, float* room) {
    int64_t covered = 1;
    while (covered < span) {
        const int64_t shift = std::min(covered, span - covered);
        std::copy_n(values, number, room);
        for (int64_t k = 0; k + shift < number; k++) values[k] = std::min(room[k], room[k + shift]);
        covered += shift;
    }
}

}  // namespace visibility
