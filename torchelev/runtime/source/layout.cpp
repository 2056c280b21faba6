// Where the points of scans and images lie in a map's window: patterns.py.

#include "runtime/source/layout.h"

#include <algorithm>

#include "observations/kernel/scan.h"

Span::Span(const std::vector<double>& xy, int32_t alignment, double reach) {
    double radius = 0, far_x = 0, far_y = 0;
    for (size_t k = 0; k < xy.size(); k += 2) {
        radius = std::max(radius, std::hypot(xy[k], xy[k + 1]));
        far_x = std::max(far_x, std::fabs(xy[k])), far_y = std::max(far_y, std::fabs(xy[k + 1]));
    }
    const bool turns = alignment != scans::WORLD;
    x = reach + (turns ? radius : far_x), y = reach + (turns ? radius : far_y);
}

void Span::require_inside(const Config& cfg) const {
    const double size = cfg["grid.resolution"], length_x = cfg["grid.length_x"], length_y = cfg["grid.length_y"];
    const double wanted_x = 2 * (x + size), wanted_y = 2 * (y + size);
    REQUIRE(
        wanted_x <= length_x + 1e-9 && wanted_y <= length_y + 1e-9, "pattern",
        "must lie in the map at any heading, which takes " + general(wanted_x, 3) + " x " + general(wanted_y, 3) + " m",
        "a window of " + general(length_x) + " x " + general(length_y) + " m",
        "enlarge length_x and length_y of GridConfig, or shrink the pattern");
}
