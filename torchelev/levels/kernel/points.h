// The points of a scan, as levels need them besides their measurement.
#pragma once

#include <cstdint>
#include <vector>

namespace levels {

// M = S * N points of one map.
struct Points {
    std::vector<float> rho, slope;          // [m] horizontal range, and rise of the ray
    std::vector<int32_t> direction, reach;  // entries of the ray in the tables of `Sight`
    std::vector<int32_t> cell;              // of the window, -1 outside or where the point does not count
    const uint8_t *casts, *used;            // of the measurement: its ray counts; it lies below the exclusion ramp, too

    void resize(int64_t M) {
        for (std::vector<float>* values : {&rho, &slope}) values->resize(M);
        for (std::vector<int32_t>* values : {&direction, &reach, &cell}) values->resize(M);
    }
};

}  // namespace levels
