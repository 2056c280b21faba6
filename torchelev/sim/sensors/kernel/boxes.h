// Rays against boxes: `_distance_to_boxes` in casting.py.
#pragma once

#include "kernels/simd.h"

struct Box {
    float rotation[9];  // its axes, in the frame of the rays
    float start[3];     // [m] origin of the rays, in its frame
    float half[3];      // [m] half its sides, NaN: there is no box
};

// Return whether a box is there, and no farther than `max_range` [m] from the origin of the rays.
inline bool can_reach(const Box& box, float max_range) {
    float square = 0;
    for (int axis = 0; axis < 3; axis++) {
        const float outside = __builtin_fabsf(box.start[axis]) - box.half[axis];
        if (outside != outside) return false;
        square += outside > 0 ? outside * outside : 0;
    }
    return square <= 1.001f * max_range * max_range;  // more than float32 rounds by
}

// Return the distance [m] at which rays enter the first box, infinite where they miss all.
inline Lanes distance_to_boxes(const Box* boxes, int count, const Lanes* direction) {
    Lanes nearest = splat(__builtin_inff());
    for (const Box* box = boxes; box < boxes + count; box++) {
        Lanes enter = splat(0), leave = splat(__builtin_inff());
        Flags misses = {};
        for (int axis = 0; axis < 3; axis++) {
            const float* r = box->rotation + 3 * axis;
            const Lanes inverse = 1 / (r[0] * direction[0] + r[1] * direction[1] + r[2] * direction[2]);
            const Lanes a = inverse * (-box->start[axis] - box->half[axis]);
            const Lanes b = inverse * (box->half[axis] - box->start[axis]);
            misses |= (a != a) | (b != b);
            enter = larger(enter, smaller(a, b)), leave = smaller(leave, larger(a, b));
        }
        nearest = pick(~misses & (enter <= leave), smaller(nearest, enter), nearest);
    }
    return nearest;
}
