// The points of a cell on a GPU: one thread's, or shared by the threads of a warp, which all hold the same results.
#pragma once

#include "point.h"

struct Points {
    const Point *first, *last;
    float number;
    int stride;  // threads that share the points: 1, or a whole warp

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
            value = std::max(value, __shfl_xor_sync(0xffffffff, value, step));
        return value;
    }

  private:
    template <class Value> Value sum(Value value) const {
        for (int step = stride / 2; step > 0; step /= 2) value += __shfl_xor_sync(0xffffffff, value, step);
        return value;
    }
};
