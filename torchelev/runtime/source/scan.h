// A height scan of one robot.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "observations/kernel/scan_of_robot.h"
#include "runtime/source/map.h"

struct torchelev_scan {
    torchelev_scan(const torchelev_map& map, const std::string& layout);

    int64_t feet() const { return num_feet; }
    int64_t size() const { return scan.origins * scan.points; }
    void read(const torchelev_map& map, const double* T_map_base, const double* feet, float* values, uint8_t* known);

  private:
    scans::Scan scan{};
    int64_t num_feet = 0;
    std::vector<float> pattern;  // (P, 2) [m]
    std::vector<uint8_t> own_known;
    std::unique_ptr<scans::Robot> robot;

    void use_preset(const Preset& preset, std::vector<double>& xy);
    double read_layout(const std::string& text, std::vector<double>& xy);
    void place_in(const torchelev_map& map, const std::vector<double>& xy, double reach);
    void read_blank(const torchelev_map& map);
};
