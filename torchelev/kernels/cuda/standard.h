// What GPU kernels use of the C++ standard library, which NVRTC lacks.
#pragma once

typedef unsigned char uint8_t;
typedef int int32_t;
typedef long long int64_t;

namespace std {

template <class T> constexpr T max(T a, T b) { return a < b ? b : a; }
template <class T> constexpr T min(T a, T b) { return b < a ? b : a; }
template <class T> constexpr T clamp(T value, T low, T high) { return max(low, min(value, high)); }

using ::atan;
using ::fabs;
using ::floor;
using ::signbit;
using ::sqrt;

template <class T> struct numeric_limits;
template <> struct numeric_limits<float> {
    static constexpr float min() { return 1.17549435e-38f; }
    static constexpr float infinity() { return __builtin_bit_cast(float, 0x7f800000); }
};

}  // namespace std
