// An image of the map around one robot.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "observations/kernel/image_of_robot.h"
#include "runtime/source/map.h"

struct torchelev_image {
    int64_t shape[3];  // C, H, W

    torchelev_image(const torchelev_map& map, const std::string& settings);

    void read(const torchelev_map& map, const double* T_map_base, float* values);

  private:
    images::Images settings{};
    std::vector<images::Source> sources;
    std::vector<Layer> layers;   // of each source
    std::vector<float> pattern;  // (P, 2) [m]
    std::vector<float> values;   // of the layers that are computed, one after the other
    std::vector<uint8_t> known;
    float max_clearance = 0;  // [m]
    std::unique_ptr<images::Pixels> pixels;

    void add_sources(const torchelev_map& map, const std::vector<std::string>& channels);
    void look_at(const torchelev_map& map, size_t k);
};
