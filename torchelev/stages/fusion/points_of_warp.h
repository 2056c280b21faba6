// The points of a cell on a GPU: one thread's, or shared by some of a warp's threads, which all hold the same results.
#pragma once

#include "stages/fusion/equation.h"

namespace fusion {

// A point as sorted: 32 bytes, which a GPU writes whole, as it reads what it writes in part.
struct alignas(16) SortedPoint {
    float z, noise, shared;  // [m], [m^2], [m^2]
    float ray_x, ray_y;      // [m] from the sensor
    int32_t passed, filler[2];
};

struct PointsOfWarp {
    typedef float V;
    const SortedPoint *first, *last;
    float number;
    int stride;  // threads that share the points: neighbours in a warp, a power of two of them
    const FusionSettings& s;

    template <class Use> INLINE void each(const Use& use) const {
        for (const SortedPoint* p = first + threadIdx.x % stride; p < last; p += stride)
            use(make_point(p->z, p->noise, p->shared, true, s));
    }
    // Call `use(point, ray_x, ray_y, passed)`.
    template <class Use> INLINE void each_ray(const Use& use) const {
        for (const SortedPoint* p = first + threadIdx.x % stride; p < last; p += stride)
            use(make_point(p->z, p->noise, p->shared, true, s), p->ray_x, p->ray_y, p->passed != 0);
    }
    // Add up what threads that share the points found.
    template <class... Values> INLINE void add_up(Values&... values) const { ((values = sum(values)), ...); }

    // Whether this thread is the first of those that share the points.
    INLINE bool is_first() const { return threadIdx.x % stride == 0; }

    INLINE float highest(float value) const {
        for (int step = stride / 2; step > 0; step /= 2)
            value = larger(value, __shfl_xor_sync(team(), value, step));
        return value;
    }

  private:
    // The threads that share the points, as bits.
    INLINE unsigned team() const {
        const unsigned all = stride < 32 ? (1u << stride) - 1 : 0xffffffff;
        return all << (threadIdx.x % warpSize / stride * stride);
    }
    template <class Value> INLINE Value sum(Value value) const {
        for (int step = stride / 2; step > 0; step /= 2) value += __shfl_xor_sync(team(), value, step);
        return value;
    }
};

}  // namespace fusion
