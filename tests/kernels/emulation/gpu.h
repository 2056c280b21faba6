// What CUDA sources use of a GPU, for a C++ compiler: threads take turns on one core, in warps of 32.
//
// build.py removes `__global__` and replaces `__shared__`; threads.cpp holds the threads.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#define __device__
#define __host__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(...)
#define __align__(bytes) alignas(bytes)
#define __constant__ static

struct uint3 {
    unsigned x, y, z;
};
extern uint3 threadIdx, blockIdx, blockDim, gridDim;
constexpr int warpSize = 32;

namespace emulation {

struct Exchanged {
    uint64_t bits;   // that the source lane brought
    unsigned votes;  // the lanes that brought something else than 0
};

void barrier();
int lane();
// Wait for the lanes of a mask; `own_source` says that a lane may read itself, else the source must be in the mask.
Exchanged exchange(const char* operation, unsigned mask, uint64_t bits, int source);
void* shared_memory();

template <class T> T shuffle(const char* operation, unsigned mask, T value, int source) {
    static_assert(std::is_arithmetic_v<T> && (sizeof(T) == 4 || sizeof(T) == 8), "CUDA shuffles 4 or 8 bytes");
    uint64_t bits = 0;
    std::memcpy(&bits, &value, sizeof value);
    bits = exchange(operation, mask, bits, source).bits;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

template <class To, class From> To bits_as(From value) {
    static_assert(sizeof(To) == sizeof(From));
    To bits;
    std::memcpy(&bits, &value, sizeof bits);
    return bits;
}

template <class T, class... Types> constexpr bool is_one_of = (std::is_same_v<T, Types> || ...);
template <class T> constexpr bool can_add = is_one_of<T, int, unsigned, unsigned long long, float, double>;
template <class T> constexpr bool can_order = is_one_of<T, int, unsigned, long long, unsigned long long>;
template <class T> constexpr bool can_swap = can_order<T> || is_one_of<T, float, double>;
template <class T> struct Same {
    using Type = T;
};
template <class T> using As = typename Same<T>::Type;  // so that only the address decides what T is

template <class T> T replace(T* address, T value) { return std::exchange(*address, value); }

// A kernel with its arguments, which all threads of a launch call.
template <class... Parameters, size_t... K>
void call(void (*kernel)(Parameters...), void** arguments, std::index_sequence<K...>) {
    kernel(*static_cast<std::remove_reference_t<Parameters>*>(arguments[K])...);
}
template <auto kernel> struct Kernel;
template <class... Parameters, void (*kernel)(Parameters...)> struct Kernel<kernel> {
    static constexpr int64_t sizes[] = {int64_t(sizeof(Parameters))..., 0};
    static void run(void** arguments) { call(kernel, arguments, std::index_sequence_for<Parameters...>{}); }
};

}  // namespace emulation

inline void __syncthreads() { emulation::barrier(); }
inline void __syncwarp(unsigned mask = 0xffffffff) { emulation::exchange("__syncwarp", mask, 0, emulation::lane()); }
inline void __threadfence() {}
inline void __threadfence_block() {}

template <class T> T __shfl_xor_sync(unsigned mask, T value, int other, int width = warpSize) {
    const int own = emulation::lane(), source = own ^ other;
    return emulation::shuffle("__shfl_xor_sync", mask, value, source / width > own / width ? own : source);
}
template <class T> T __shfl_down_sync(unsigned mask, T value, unsigned step, int width = warpSize) {
    const int own = emulation::lane(), source = own % width + int(step) < width ? own + int(step) : own;
    return emulation::shuffle("__shfl_down_sync", mask, value, source);
}
template <class T> T __shfl_up_sync(unsigned mask, T value, unsigned step, int width = warpSize) {
    const int own = emulation::lane(), source = own % width >= int(step) ? own - int(step) : own;
    return emulation::shuffle("__shfl_up_sync", mask, value, source);
}
template <class T> T __shfl_sync(unsigned mask, T value, int source, int width = warpSize) {
    const int first = emulation::lane() / width * width;
    return emulation::shuffle("__shfl_sync", mask, value, first + (source & (width - 1)));
}
inline unsigned __ballot_sync(unsigned mask, int predicate) {
    return emulation::exchange("__ballot_sync", mask, predicate != 0, emulation::lane()).votes;
}
inline int __any_sync(unsigned mask, int predicate) {
    return emulation::exchange("__any_sync", mask, predicate != 0, emulation::lane()).votes != 0;
}
inline int __all_sync(unsigned mask, int predicate) {
    return emulation::exchange("__all_sync", mask, predicate == 0, emulation::lane()).votes == 0;
}

template <class T> T atomicAdd(T* address, emulation::As<T> value) {
    static_assert(emulation::can_add<T>, "CUDA has no atomicAdd of this type");
    return emulation::replace(address, T(*address + value));
}
template <class T> T atomicMin(T* address, emulation::As<T> value) {
    static_assert(emulation::can_order<T>, "CUDA has no atomicMin of this type");
    return emulation::replace(address, value < *address ? value : *address);
}
template <class T> T atomicMax(T* address, emulation::As<T> value) {
    static_assert(emulation::can_order<T>, "CUDA has no atomicMax of this type");
    return emulation::replace(address, *address < value ? value : *address);
}
template <class T> T atomicExch(T* address, emulation::As<T> value) {
    static_assert(emulation::can_swap<T>, "CUDA has no atomicExch of this type");
    return emulation::replace(address, value);
}
template <class T> T atomicCAS(T* address, emulation::As<T> expected, emulation::As<T> value) {
    static_assert(emulation::can_order<T>, "CUDA has no atomicCAS of this type");
    return emulation::replace(address, *address == expected ? value : *address);
}
template <class T> T atomicOr(T* address, emulation::As<T> value) {
    static_assert(emulation::can_order<T>, "CUDA has no atomicOr of this type");
    return emulation::replace(address, T(*address | value));
}
template <class T> T atomicAnd(T* address, emulation::As<T> value) {
    static_assert(emulation::can_order<T>, "CUDA has no atomicAnd of this type");
    return emulation::replace(address, T(*address & value));
}

inline int __float_as_int(float value) { return emulation::bits_as<int>(value); }
inline float __int_as_float(int value) { return emulation::bits_as<float>(value); }
inline unsigned __float_as_uint(float value) { return emulation::bits_as<unsigned>(value); }
inline float __uint_as_float(unsigned value) { return emulation::bits_as<float>(value); }
inline int __popc(unsigned value) { return __builtin_popcount(value); }
inline int __ffs(int value) { return __builtin_ffs(value); }
inline int __clz(int value) { return value ? __builtin_clz(unsigned(value)) : 32; }
inline float rsqrtf(float value) { return 1 / std::sqrt(value); }
template <class T> T __ldg(const T* address) { return *address; }
