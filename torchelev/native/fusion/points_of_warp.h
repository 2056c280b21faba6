// The points of a cell on a GPU: one thread's, or shared by some of a warp's threads, which all hold the same results.
#pragma once

#include "point.h"

struct Points {
    const Point *first, *last;
    float number;
    int stride;  // threads that share the points: neighbours in a warp, a power of two of them

    struct Iterator {
        const Point* point;
        int stride;
        const Point& operator*() const { return *point; }
        void operator++() { point += stride; }
        bool operator!=(const Iterator& end) const { return point < end.point; }
    };
    Iterator begin() const { return {first + threadIdx.x % stride, stride}; }
    Iterator end() const { return {last, stride}; }

    // Add up what threads that share the points found.
    template <class... Values> void add_up(Values&... values) const { ((values = sum(values)), ...); }

    float highest(float value) const {
        for (int step = stride / 2; step > 0; step /= 2)
            value = std::max(value, __shfl_xor_sync(team(), value, step));
        return value;
    }

  private:
    // The threads that share the points, as bits.
    unsigned team() const {
        const unsigned all = stride < 32 ? (1u << stride) - 1 : 0xffffffff;
        return all << (threadIdx.x % warpSize / stride * stride);
    }
    template <class Value> Value sum(Value value) const {
        for (int step = stride / 2; step > 0; step /= 2) value += __shfl_xor_sync(team(), value, step);
        return value;
    }
};
