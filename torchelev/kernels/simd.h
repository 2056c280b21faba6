// Portable SIMD vectors: LANES numbers at a time, and functions of them that compilers do not vectorise alike.
#pragma once

#include <cstdint>
#include <cstring>
#include <initializer_list>
#include <type_traits>

#include "kernels/scalar.h"

#if defined(__AVX512F__)
constexpr int LANES = 16;
#elif defined(__AVX__)
constexpr int LANES = 8;  // of longer vectors compilers choose and compare one number after the other
#else
constexpr int LANES = 4;
#endif
typedef float Lanes __attribute__((vector_size(4 * LANES)));
typedef int32_t Flags __attribute__((vector_size(4 * LANES)));  // of comparisons: -1 true, 0 false
typedef uint8_t Bytes __attribute__((vector_size(LANES)));

inline Lanes splat(float value) { return value - Lanes{}; }  // what + computes for zeros would cost an addition
inline Lanes pick(Flags flags, Lanes yes, Lanes no) { return flags ? yes : no; }
inline Lanes zero_unless(Flags flags, Lanes a) { return (Lanes)((Flags)a & flags); }
inline Flags pick_int(Flags flags, Flags yes, Flags no) { return flags ? yes : no; }
inline Flags pick_int(Flags flags, int yes, Flags no) { return pick_int(flags, Flags{} + yes, no); }
inline Lanes one_if(Flags flags) { return pick(flags, splat(1), splat(0)); }
inline Lanes smaller(Lanes a, Lanes b) { return pick(a < b, a, b); }
inline Lanes larger(Lanes a, Lanes b) { return pick(a > b, a, b); }
inline Lanes clamp(Lanes a, float low, float high) { return smaller(larger(a, splat(low)), splat(high)); }
inline Lanes absolute(Lanes a) { return (Lanes)((Flags)a & 0x7fffffff); }
inline Flags is_negative(Lanes a) { return (Flags)a < 0; }  // -0.0 is

// A function of each number: a loop over memory, which compilers vectorise, where one over lanes stays a loop.
template <class Function> inline Lanes of_each(Lanes a, Function function) {
    float values[LANES];
    std::memcpy(values, &a, sizeof a);
    for (int l = 0; l < LANES; l++) values[l] = function(values[l]);
    std::memcpy(&a, values, sizeof a);
    return a;
}

inline Lanes root(Lanes a) {
    return of_each(a, [](float value) { return __builtin_sqrtf(value); });
}

inline Lanes floor_of(Lanes a) {
    return of_each(a, [](float value) { return __builtin_floorf(value); });
}
inline Flags integers(Lanes a) { return __builtin_convertvector(a, Flags); }
inline Flags index_or_none(Flags exist, Flags index) { return (index & exist) | ~exist; }
inline Lanes numbers(Flags a) { return __builtin_convertvector(a, Lanes); }

// Return how many flags are set.
inline int count_set(Flags flags) {
    int32_t values[LANES], total = 0;
    std::memcpy(values, &flags, sizeof flags);
    for (int l = 0; l < LANES; l++) total -= values[l];
    return total;
}

inline bool any(Flags flags) {
    uint64_t words[LANES / 2], set = 0;
    std::memcpy(words, &flags, sizeof flags);
    for (uint64_t word : words) set |= word;
    return set;
}

// Return the lowest byte of each number.
inline Bytes bytes_of(Flags numbers) {
#if defined(__AVX2__) && !defined(__AVX512F__) && !defined(__clang__)  // GCC would move one number after the other
    typedef uint8_t Parts __attribute__((vector_size(sizeof(Flags))));
    const Parts lowest_first{0,  4,  8,  12, 0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,
                             16, 20, 24, 28, 16, 16, 16, 16, 16, 16, 16, 16, 16, 16, 16, 16};
    const Flags packed = (Flags)__builtin_shuffle((Parts)numbers, lowest_first);
    const int32_t halves[2]{packed[0], packed[4]};
    Bytes bytes;
    std::memcpy(&bytes, halves, sizeof bytes);
    return bytes;
#else
    return __builtin_convertvector(numbers, Bytes);
#endif
}

// Return the number of each byte.
inline Flags numbers_of(Bytes bytes) {
#if defined(__AVX512F__) && !defined(__clang__)  // GCC would move one byte after the other
    typedef char Parts __attribute__((vector_size(16)));
    return (Flags)__builtin_ia32_pmovzxbd512_mask((Parts)bytes, Flags{}, 0xffff);
#elif defined(__AVX2__) && !defined(__clang__)
    typedef char Parts __attribute__((vector_size(16)));
    typedef int64_t Words __attribute__((vector_size(16)));
    return (Flags)__builtin_ia32_pmovzxbd256((Parts)Words{(int64_t)bytes, 0});
#else
    return __builtin_convertvector(bytes, Flags);
#endif
}

// Numbers of bytes, and bytes of numbers. A count that is known to the compiler takes one step.
template <class Count> inline Flags load_bytes(const uint8_t* values, Count count) {
    Bytes bytes{};
    std::memcpy(&bytes, values, count);
    return numbers_of(bytes);
}

template <class Count> inline void store_bytes(uint8_t* values, Flags numbers, Count count) {
    const Bytes bytes = bytes_of(numbers);
    std::memcpy(values, &bytes, count);
}

inline Lanes load(const float* values, int count = LANES) {
    Lanes lanes{};
    std::memcpy(&lanes, values, sizeof(float) * count);
    return lanes;
}

inline void store(float* values, Lanes lanes, int count = LANES) { std::memcpy(values, &lanes, sizeof(float) * count); }

template <class Result, class Value> inline Result gather_as(const Value* values, Flags index) {
    int32_t places[LANES];
    std::remove_reference_t<decltype(Result{}[0])> found[LANES];
    std::memcpy(places, &index, sizeof index);
    for (int l = 0; l < LANES; l++) found[l] = values[places[l]];
    Result lanes;
    std::memcpy(&lanes, found, sizeof lanes);
    return lanes;
}

inline Lanes gather(const float* values, Flags index) { return gather_as<Lanes>(values, index); }
inline Flags gather(const int32_t* values, Flags index) { return gather_as<Flags>(values, index); }
inline Flags gather(const uint8_t* values, Flags index) { return gather_as<Flags>(values, index); }

// Return what a table of eight numbers holds at places in it.
inline Flags look_up(const int32_t* table, Flags index) {
#if defined(__AVX2__) && !defined(__clang__)
    Flags values{};
    std::memcpy(&values, table, 8 * sizeof *table);
    return __builtin_shuffle(values, index);
#else
    return gather(table, index);
#endif
}

// Call `work(k, count)` for the vectors of first to last; a count that is known to the compiler for all but the last.
template <class Work> inline void for_vectors(int64_t first, int64_t last, const Work& work) {
    for (; first + LANES <= last; first += LANES) work(first, std::integral_constant<int, LANES>());
    if (first < last) work(first, int(last - first));
}

// A sum in eight parts, so that its rounding does not depend on LANES.
class PartialSums {
    static constexpr int NUMBER = 8, WIDTH = LANES < NUMBER ? LANES : NUMBER;
    typedef float Part __attribute__((vector_size(4 * WIDTH)));
    Part parts[NUMBER / WIDTH]{};

  public:
    // Add the numbers from the `number`-th on of a sequence, in their order. Sequences begin with number 0, which need not
    // be the first that is added: all sums of it then have its parts.
    void add(int64_t number, Lanes values) {
        Part pieces[LANES / WIDTH];
        std::memcpy(pieces, &values, sizeof values);
        for (const Part& piece : pieces) parts[number / WIDTH % (NUMBER / WIDTH)] += piece, number += WIDTH;
    }

    template <class T> T total() const {
        float values[NUMBER];
        std::memcpy(values, parts, sizeof parts);
        T total = 0;
        for (float value : values) total += value;
        return total;
    }
};

// Return whether any of some masks' bytes is set.
inline bool any_set(const uint8_t* bytes, int64_t count) {
    uint8_t some = 0;
    for (int64_t k = 0; k < count; k++) some |= bytes[k];
    return some;
}

inline Lanes arctan_of_small(Lanes x) {
    const Lanes z = x * x;
    Lanes p = splat(8.05374449538e-2f);
    for (float c : {-1.38776856032e-1f, 1.99777106478e-1f, -3.33329491539e-1f}) p = p * z + c;
    return p * z * x + x;
}

// Arc tangent of numbers that are not negative, by the polynomial of Cephes' atanf: 1 unit in the last place.
inline Lanes arctan(Lanes x) {
    const Flags is_large = x > 2.414213562f, is_middle = x > 0.4142135624f;
    if (!any(is_middle)) return arctan_of_small(x);
    const Lanes above = pick(is_large, splat(-1), pick(is_middle, x - 1, x));
    const Lanes below = pick(is_large, x, pick(is_middle, x + 1, splat(1)));
    const Lanes start = pick(is_large, splat(1.5707963268f), pick(is_middle, splat(0.7853981634f), splat(0)));
    return start + arctan_of_small(above / below);
}
