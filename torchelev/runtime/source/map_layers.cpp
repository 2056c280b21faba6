// The layers of a map, as they are read: `layer` of elevation_map.py.
#include <algorithm>
#include <cmath>

#include "runtime/source/map.h"

namespace {

// In the order of `Layer`.
const char* const LAYERS[] = {"elevation", "variance", "validity", "time",    "upper_bound", "traversability",
                              "normal_x",  "normal_y", "normal_z", "ceiling", "clearance"};

// What the position's covariance adds to a height's variance: `pose_variance` of layers.py.
float pose_variance(const float* C, float gx, float gy) {
    const float level = C[0] * (gx * gx) + 2 * C[1] * gx * gy + C[4] * (gy * gy);
    return std::max(level + C[8] - 2 * (C[2] * gx + C[5] * gy), 0.0f);
}

float normal_component(float gx, float gy, int axis) {
    const float component[] = {-gx, -gy, 1};
    return component[axis] / std::sqrt(1 + gx * gx + gy * gy);
}

}  // namespace

std::vector<std::string> layers_of(const Config& cfg) {
    return {std::begin(LAYERS), cfg.has_levels() ? std::end(LAYERS) : LAYERS + CEILING};
}

LayerView torchelev_map::view(const std::string& name) const {
    const char* const* const last = levels ? std::end(LAYERS) : LAYERS + CEILING;
    const auto own = [&](const std::string& layer) {
        return LayerView{*this, Layer(std::find(std::begin(LAYERS), last, layer) - LAYERS), nullptr};
    };
    if (const LayerView found = own(name); LAYERS + found.layer < last) return found;
    REQUIRE(filters.has(name), "layer", "must be one of " + joined(layers_of(cfg)) + filters.listed(),
            "'" + name + "'", "use elevation");
    const std::lock_guard<std::mutex> lock(filtering);
    const Cells& made = filters.read(name, [&](const std::string& layer, Cells& to) {
        for (int64_t k = 0; k < cells(); k++) {
            const CellValue cell = own(layer).at(k);
            to.values[k] = cell.known ? cell.value : 0, to.known[k] = cell.known;
        }
    });
    return {*this, ELEVATION, &made};
}

CellValue LayerView::at(int64_t cell) const {
    return made ? CellValue{made->values[cell], made->known[cell] != 0} : map.read(layer, cell);
}

void torchelev_map::require_grid(int64_t height, int64_t width, double side, const char* reader) const {
    const bool fits = height == sizes.H && width == sizes.W && side == resolution();
    REQUIRE(fits, "map", std::string("must have the grid that the ") + reader + " was created for", "another",
            std::string("create one for this map"));
}

CellValue torchelev_map::read(Layer layer, int64_t k) const {
    const MapState& s = state;
    const float gx = s.gradient_x[k], gy = s.gradient_y[k];
    const bool known = s.validity[k];
    switch (layer) {
        case ELEVATION:
            return {s.elevation[k], known};
        case VARIANCE:
            return {s.variance[k] + pose_variance(s.pose_covariance, gx, gy), known};
        case VALIDITY:
            return {float(known), true};
        case TIME:
            return {s.time[k], known};
        case UPPER_BOUND:
            return {known ? s.elevation[k] : s.upper_bound[k], known || s.bounded[k]};
        case TRAVERSABILITY:
            return {s.traversability[k], known && s.rated[k]};
        case CEILING:
        case CLEARANCE: {
            const Ceiling found = levels->ceiling(s, k);
            if (layer == CEILING) return {found.height, found.known};
            return {found.height - s.elevation[k], found.known && known};
        }
        default:
            return {normal_component(gx, gy, layer - NORMAL_X), known && s.has_normal[k]};
    }
}
