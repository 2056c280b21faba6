// The points of a cell, one after the other.
#pragma once

#include "point.h"

struct Points {
    const Point *first, *last;
    float number;

    const Point* begin() const { return first; }
    const Point* end() const { return last; }

    // Add up what threads that share the points found: here there is one.
    template <class... Values> void add_up(Values&...) const {}
    float highest(float value) const { return value; }
};
