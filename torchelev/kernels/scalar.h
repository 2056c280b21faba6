// The functions of simd.h for single numbers, so that an equation written once runs on vectors and on a GPU's threads.
#pragma once

#include <cmath>
#include <cstdint>

#ifdef __CUDACC__
#define INLINE inline __device__
#else
#define INLINE inline
#endif

INLINE float pick(bool flag, float yes, float no) { return flag ? yes : no; }
INLINE float smaller(float a, float b) { return a < b ? a : b; }
INLINE float larger(float a, float b) { return a > b ? a : b; }
INLINE float clamp(float a, float low, float high) { return smaller(larger(a, low), high); }
INLINE float absolute(float a) { return std::fabs(a); }
INLINE float root(float a) { return std::sqrt(a); }
INLINE float arctan(float a) { return std::atan(a); }
INLINE float floor_of(float a) { return std::floor(a); }
INLINE bool is_negative(float a) { return std::signbit(a); }
INLINE bool any(bool flag) { return flag; }
template <class V> INLINE V splat(float value) { return value - V{}; }
INLINE int32_t integers(float a) { return int32_t(a); }
INLINE int32_t index_or_none(bool exists, int32_t index) { return exists ? index : -1; }
template <class V> INLINE V square(V a) { return a * a; }
