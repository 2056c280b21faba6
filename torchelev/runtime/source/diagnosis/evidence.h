// What a diagnosis rests on: diagnosis/evidence.py, with the same names.
#pragma once

#include <array>
#include <vector>

#include "runtime/source/map.h"

using Place = std::array<double, 3>;  // [m]

double median(std::vector<double> values);

// A cloud whose points are near each other and far from the sensor.
struct FarCloud {
    bool exists, is_at_sensor;
    double distance, radius;  // [m]
};

struct Evidence {
    const torchelev_map& map;
    std::vector<const PastUpdate*> updates;
    std::vector<std::vector<uint8_t>> used;  // points of each update that passed the sensor's gates
    int64_t rejected[4] = {};  // points of all updates, by the gates in their order
    int64_t num_points = 0, num_used = 0;
    std::vector<double> distances;  // [m] of the finite points from their sensors
    FarCloud far_cloud;
    bool is_in_millimetres;
    int64_t num_known = 0, num_near = 0;
    double oldest = 0;              // [s]
    Place center;                   // of the window; z is 0
    std::vector<Place> positions;   // of the base, or of the first sensor without one
    double travel;                  // [m]

    explicit Evidence(torchelev_map& map);
    // The points of an update that passed the gates, in the map frame.
    std::vector<Place> used_points(size_t k) const;

  private:
    void measure_again(torchelev_map& map);
    void find_distances();
    void look_at_map();
    bool is_beyond_range() const;  // whether most points are rejected for their distance
    FarCloud find_far_cloud() const;
};
