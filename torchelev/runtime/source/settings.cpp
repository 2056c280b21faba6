// What the equations need of a config: `settings` of each stage's kernel.py. Constants are those of the default config.

#include <algorithm>
#include <cmath>

#include "runtime/source/config.h"
#include "tables.h"

namespace {

const double PI = std::acos(-1.0);

double square(double value) { return value * value; }

int cells_within(const Config& cfg, double length) {
    return int(std::max(1.0, std::nearbyint(length / cfg["grid.resolution"])));
}

void set_measure(const Config& cfg, MeasureSettings& s) {
    s.resolution = cfg["grid.resolution"];
    s.noise_factor = float(cfg["sensor.noise_factor"]), s.noise_floor = float(cfg["sensor.noise_floor"]);
    s.min_square = float(square(cfg["sensor.min_distance"])), s.max_square = float(square(cfg["sensor.max_distance"]));
    s.max_distance = float(cfg["sensor.max_distance"]);
    s.has_ramp = cfg.has("sensor.exclusion");
    s.ramp_slope = float(cfg["sensor.exclusion.slope"]), s.ramp_distance = float(cfg["sensor.exclusion.distance"]);
    s.ramp_offset = float(cfg["sensor.exclusion.offset"]), s.ramp_height = float(cfg["sensor.exclusion.height"]);
    s.has_box = cfg.has("sensor.body");
    for (int axis = 0; axis < 3; axis++) {
        s.box_lower[axis] = float(cfg.place("sensor.body.lower")[axis]);
        s.box_upper[axis] = float(cfg.place("sensor.body.upper")[axis]);
    }
}

void set_compensate(const Config& cfg, CompensateSettings& s) {
    s.has_drift = cfg.has("drift"), s.resolution = float(cfg["grid.resolution"]);
    s.min_traversability = float(cfg.drift_gate());
    s.max_variance = float(cfg["drift.max_variance"]), s.max_error = float(cfg["drift.max_error"]);
    s.gate_square = float(square(cfg["drift.gate"])), s.relief_square = float(square(cfg["drift.relief"]));
    s.min_points = int(cfg["drift.min_points"]);
    s.max_drift = float(cfg["drift.max_drift"]), s.gain = float(cfg["drift.gain"]);
}

void set_edges(const Config& cfg, FusionSettings& s) {
    s.has_edges = cfg.has("fusion.edges");
    s.min_points = int(cfg["fusion.edges.min_points"]), s.min_extreme = int(cfg["fusion.edges.min_extreme"]);
    s.refinements = int(cfg["fusion.edges.refinements"]);
    s.min_share = float(cfg["fusion.edges.min_share"]), s.min_passed = float(cfg["fusion.edges.min_passed"]);
    s.margin = s.has_edges ? float(cfg["fusion.edges.margin"]) : 0;
    s.min_settled = s.has_edges ? float(cfg["fusion.edges.min_settled"]) : 0;
}

void set_fusion(const Config& cfg, FusionSettings& s) {
    s.resolution = float(cfg["grid.resolution"]), s.relief = float(cfg["fusion.relief"] * cfg["grid.resolution"]);
    s.gate = float(cfg["fusion.gate"]), s.max_gate_std = float(cfg["fusion.max_gate_std"]);
    s.floor = float(cfg["fusion.scan_variance_floor"]), s.outlier_variance = float(cfg["fusion.outlier_variance"]);
    s.max_support = float(cfg["fusion.max_support"]), s.max_variance = float(cfg["fusion.max_variance"]);
    s.min_above = int(cfg["fusion.min_above"]), s.max_above_per_scan = int(cfg["fusion.max_above_per_scan"]);
    s.has_rays = cfg.has("raycast");
    set_edges(cfg, s);
}

std::string with_commas(int64_t number) {
    std::string text = std::to_string(number);
    for (int k = int(text.size()) - 3; k > 0; k -= 3) text.insert(k, ",");
    return text;
}

// The polar table: `PolarGrid.of`.
void set_table(const Config& cfg, VisibilitySettings& s) {
    const double diagonal = std::hypot(cfg["grid.length_x"], cfg["grid.length_y"]);
    const double range =
        cfg.has("raycast") && cfg.has("raycast.max_range") ? cfg["raycast.max_range"] : 0.55 * diagonal;
    const double reach = std::ceil(range / cfg["grid.resolution"]);
    const std::string rule = "rays of " + general(cfg["grid.resolution"]) + " m cells must reach over at most " +
                             with_commas(MAX_CELLS) + " of them";
    REQUIRE(!s.has_rays || reach <= MAX_CELLS, "raycast.max_range", rule,
            reach < 1e15 ? with_commas(int64_t(reach)) + " cells" : "more",
            cfg.has("raycast.max_range") ? "give fewer metres, or None" : "use larger cells, or a shorter window");
    const double azimuths = 2 * std::ceil(std::max(16.0, 1.08 * 2 * PI * reach) / 2);
    const double bins = BREADTH * azimuths / (2 * PI);
    const int most = int(std::size(s.widen));
    s.ranges = int(std::min(reach, 1e9)), s.azimuths = int(std::min(azimuths, 1e9)), s.bins = float(bins);
    s.levels = int(std::ceil(std::log2(2 * bins + 1))) - 1;
    for (int k = 0; k < most; k++) s.widen[k] = k < s.levels ? int(std::ceil(bins / (std::exp2(k + 1) - 1))) : 0;
    s.horizon_ranges = 8 * (s.ranges / 16 + 1);
}

void set_visibility(const Config& cfg, VisibilitySettings& s) {
    const double size = cfg["grid.resolution"];
    s.has_rays = cfg.has("raycast"), s.resolution = float(size), s.relief = float(square(0.5 * size));
    s.min_time = float(cfg["raycast.min_time"]), s.min_incidence = float(cfg["raycast.min_incidence"]);
    s.min_support = float(cfg["raycast.min_support"]), s.gate = float(cfg["raycast.gate"]);
    s.near_cells = std::max(1, int(NEAR / size));
    set_table(cfg, s);
}

// Which of so many cells may lie within a radius [cells] of the window's centre: `middle`.
void set_middle(int64_t size, double radius, int32_t& first, int32_t& end) {
    const int64_t half = int64_t(std::ceil(std::min(radius, double(size)))) + 1;
    first = int32_t(std::max<int64_t>(0, size / 2 - half)), end = int32_t(std::min(size, (size + 1) / 2 + half));
}

void set_overlap(const Config& cfg, OverlapSettings& s) {
    const double radius = cfg["overlap.radius"] / cfg["grid.resolution"];
    s.has_overlap = cfg.has("overlap") && !cfg.has_levels(), s.resolution = float(cfg["grid.resolution"]);
    s.radius_square = float(square(cfg["overlap.radius"]));
    s.slope = float(cfg["overlap.height"] / cfg["overlap.radius"]), s.height = float(cfg["overlap.height"]);
    s.base_height = float(cfg["overlap.base_height"]), s.max_base_height = float(cfg["overlap.max_base_height"]);
    set_middle(cfg.rows(), radius, s.first_row, s.end_row);
    set_middle(cfg.columns(), radius, s.first_column, s.end_column);
}

// Least spread of cells that span a plane: `min_spread` of plane_fit.py.
double min_spread(int radius) { return std::max(0.25, 0.4 * 0.4 * radius * (radius + 1) / 3) - 1e-3; }

void set_surface(const Config& cfg, SurfaceSettings& s) {
    const bool has_head = cfg.has("traversability");
    s.radius = int(cfg["surface.radius"]), s.cells = has_head ? cells_within(cfg, cfg["traversability.radius"]) : 0;
    s.steps = std::min(s.cells, cells_within(cfg, STEP_REACH));
    s.per_cell = float(1 / cfg["grid.resolution"]);
    s.min_spread[0] = float(min_spread(s.radius)), s.min_spread[1] = float(min_spread(s.cells));
    const char* const critical[] = {"critical_slope", "critical_step", "critical_roughness"};
    for (int k = 0; k < 3; k++)
        s.per_critical[k] = has_head ? float(1 / cfg[std::string("traversability.") + critical[k]]) : 1.0f;
}

// Sizes of the tables of rays: `SightGrid.of`.
void set_sight(const Config& cfg, LevelsSettings& s) {
    const double cells = double(std::max(cfg.rows(), cfg.columns()));
    s.azimuths = int32_t(std::min(1024.0, std::max(64.0, std::exp2(std::ceil(std::log2(PI * cells / 2))))));
    s.elevations = s.azimuths / 4;
    s.ranges = int32_t(std::ceil(0.75 * std::hypot(double(cfg.rows()), double(cfg.columns())))) + 4;
}

void set_levels(const Config& cfg, LevelsSettings& s) {
    const bool has_overlap = cfg.has("overlap");
    s.resolution = cfg["grid.resolution"], s.variance_rate = float(cfg["aging.variance_rate"]);
    s.max_variance = float(cfg["fusion.max_variance"]), s.max_support = float(cfg["fusion.max_support"]);
    s.variance_floor = float(cfg["fusion.scan_variance_floor"]);
    s.min_time = cfg.has("raycast") ? float(cfg["raycast.min_time"]) : INFINITY;
    s.overlap_height = has_overlap ? float(cfg["overlap.height"]) : 0;
    s.overlap_radius = has_overlap ? float(cfg["overlap.radius"]) : 0;
    set_sight(cfg, s);
    s.min_gap = float(cfg["levels.min_gap"]), s.max_step = float(cfg["levels.max_step"]);
    s.min_support = float(cfg["levels.min_support"]), s.least_support = std::max(s.min_support, 0.5f);
    s.by_gap = cfg.word("levels.separation") == "gap";
    s.max_blind = int32_t(std::min(cfg["levels.max_blind"], 1e3) / cfg["grid.resolution"]);
}

}  // namespace

Settings settings_of(const Config& cfg) {
    Settings s = default_settings();
    s.recenter.resolution = s.disagreement.resolution = float(cfg["grid.resolution"]);
    s.age.variance_rate = float(cfg["aging.variance_rate"]);
    set_measure(cfg, s.measure);
    set_compensate(cfg, s.compensate);
    set_fusion(cfg, s.fusion);
    set_visibility(cfg, s.visibility);
    set_overlap(cfg, s.overlap);
    set_surface(cfg, s.surface);
    set_levels(cfg, s.levels);
    return s;
}
