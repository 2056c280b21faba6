// Filters that smooth layers and fill holes: the functions of torchelev/filters with the same names and settings.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

// The cells of a map's grid.
struct FilterGrid {
    int64_t H, W;
    double resolution;  // [m]

    int64_t cells() const { return H * W; }
};

// A layer: values, 0 where not known, and which are known.
struct Cells {
    std::vector<float> values;
    std::vector<uint8_t> known;
};

namespace filters {

// Each cell's mean of the known ones around it, weighted by `weights[|dx|] * weights[|dy|]`; unknown ones stay so.
void mean(const FilterGrid& grid, const Cells& from, const std::vector<double>& weights, Cells& to);
void median(const FilterGrid& grid, const Cells& from, int64_t radius, Cells& to);

void inpaint_minimum(const FilterGrid& grid, const Cells& from, std::optional<int64_t> iterations, Cells& to);
void inpaint_nearest(const FilterGrid& grid, const Cells& from, Cells& to);
void inpaint_diffusion(const FilterGrid& grid, const Cells& from, double tolerance, int64_t iterations, Cells& to);
void fill_from(const Cells& from, const Cells& other, Cells& to);

}  // namespace filters
