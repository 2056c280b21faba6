// The points of one cell, one after the other.
#pragma once

#include "stages/fusion/hits.h"

namespace fusion {

struct PointsOfThread {
    typedef float V;
    const Scan& scan;
    int64_t first, last;  // places among the sorted hits
    float number;

    template <class Use> void each(const Use& use) const {
        for (int64_t k = first; k < last; k++) use(point(scan.hits[k]));
    }
    // Call `use(point, ray_x, ray_y, passed)`.
    template <class Use> void each_ray(const Use& use) const {
        for (int64_t k = first; k < last; k++) {
            const Hit& hit = scan.hits[k];
            const Ray ray = scan.ray(hit.index);
            use(point(hit), ray.x, ray.y, ray.passed);
        }
    }
    template <class... Values> void add_up(Values&...) const {}  // there are no other threads
    float highest(float value) const { return value; }

  private:
    Point<float> point(const Hit& hit) const {
        return make_point(hit.z, hit.noise, scan.shared(hit.index), true, scan.s);
    }
};

}  // namespace fusion
