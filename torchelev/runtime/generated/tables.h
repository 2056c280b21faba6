// Written by `python -m torchelev.runtime.generate`.
#pragma once

#include "runtime/source/table_types.h"

constexpr Setting SETTINGS[] = {
    {"grid", GROUP, false, false, {}},
    {"grid.resolution", NUMBER, false, false, {0.04}},
    {"grid.length_x", NUMBER, false, false, {10.0}},
    {"grid.length_y", NUMBER, false, false, {10.0}},
    {"sensor", GROUP, false, false, {}},
    {"sensor.noise_factor", NUMBER, false, false, {0.0001}},
    {"sensor.noise_floor", NUMBER, false, false, {2.5e-05}},
    {"sensor.min_distance", NUMBER, false, false, {0.1}},
    {"sensor.max_distance", NUMBER, false, false, {50.0}},
    {"sensor.exclusion", GROUP, true, false, {}},
    {"sensor.exclusion.slope", NUMBER, false, false, {0.3}},
    {"sensor.exclusion.distance", NUMBER, false, false, {1.0}},
    {"sensor.exclusion.offset", NUMBER, false, false, {0.2}},
    {"sensor.exclusion.height", NUMBER, false, false, {1.0}},
    {"sensor.body", GROUP, true, true, {}},
    {"sensor.body.lower", PLACE, false, false, {-0.4, -0.25, -0.2}},
    {"sensor.body.upper", PLACE, false, false, {0.4, 0.25, 0.3}},
    {"sensor.depth", ONLY_PYTHON, true, true, {}},
    {"aging", GROUP, false, false, {}},
    {"aging.variance_rate", NUMBER, false, false, {1e-07}},
    {"drift", GROUP, true, false, {}},
    {"drift.min_traversability", NUMBER, true, true, {}},
    {"drift.max_variance", NUMBER, false, false, {0.01}},
    {"drift.max_error", NUMBER, false, false, {0.1}},
    {"drift.gate", NUMBER, false, false, {2.0}},
    {"drift.relief", NUMBER, false, false, {0.003}},
    {"drift.min_points", INTEGER, false, false, {50}},
    {"drift.max_drift", NUMBER, false, false, {0.1}},
    {"drift.gain", NUMBER, false, false, {1.0}},
    {"drift.inliers", ONLY_PYTHON, true, true, {}},
    {"fusion", GROUP, false, false, {}},
    {"fusion.gate", NUMBER, false, false, {3.0}},
    {"fusion.max_gate_std", NUMBER, false, false, {0.05}},
    {"fusion.relief", NUMBER, false, false, {0.25}},
    {"fusion.scan_variance_floor", NUMBER, false, false, {1e-06}},
    {"fusion.outlier_variance", NUMBER, false, false, {0.0001}},
    {"fusion.max_support", NUMBER, false, false, {60.0}},
    {"fusion.min_above", INTEGER, false, false, {5}},
    {"fusion.max_above_per_scan", INTEGER, false, false, {2}},
    {"fusion.max_variance", NUMBER, false, false, {1.0}},
    {"fusion.edges", GROUP, true, false, {}},
    {"fusion.edges.min_points", INTEGER, false, false, {6}},
    {"fusion.edges.min_share", NUMBER, false, false, {0.25}},
    {"fusion.edges.min_passed", NUMBER, false, false, {0.1}},
    {"fusion.edges.min_extreme", INTEGER, false, false, {2}},
    {"fusion.edges.refinements", INTEGER, false, false, {7}},
    {"fusion.edges.margin", NUMBER, false, false, {0.25}},
    {"fusion.edges.min_settled", NUMBER, false, false, {6.0}},
    {"fusion.averaging", ONLY_PYTHON, true, true, {}},
    {"raycast", GROUP, true, false, {}},
    {"raycast.min_time", NUMBER, false, false, {1.0}},
    {"raycast.min_incidence", NUMBER, false, false, {0.1}},
    {"raycast.max_range", NUMBER, true, true, {}},
    {"raycast.min_support", NUMBER, false, false, {3.0}},
    {"raycast.gate", NUMBER, false, false, {3.0}},
    {"raycast.steps", ONLY_PYTHON, true, true, {}},
    {"overlap", GROUP, true, false, {}},
    {"overlap.radius", NUMBER, false, false, {3.0}},
    {"overlap.height", NUMBER, false, false, {1.5}},
    {"overlap.base_height", NUMBER, false, false, {0.6}},
    {"overlap.max_base_height", NUMBER, false, false, {2.5}},
    {"overlap.square", ONLY_PYTHON, true, true, {}},
    {"surface", GROUP, false, false, {}},
    {"surface.radius", INTEGER, false, false, {1}},
    {"surface.upper_bound", ONLY_PYTHON, true, true, {}},
    {"traversability", GROUP, true, false, {}},
    {"traversability.radius", NUMBER, false, false, {0.1}},
    {"traversability.critical_slope", NUMBER, false, false, {0.7}},
    {"traversability.critical_step", NUMBER, false, false, {0.2}},
    {"traversability.critical_roughness", NUMBER, false, false, {0.05}},
    {"traversability.robot", IGNORED, true, true, {}},
    {"levels", GROUP, true, true, {}},
    {"levels.max_levels", INTEGER, false, false, {3}},
    {"levels.min_gap", NUMBER, false, false, {0.4}},
    {"levels.separation", CHOICE, false, false, {0}},
    {"levels.max_step", NUMBER, false, false, {0.3}},
    {"levels.max_blind", NUMBER, false, false, {0.5}},
    {"levels.min_support", NUMBER, false, false, {3.0}},
    {"filters", CHAIN, false, false, {}},
    {"channels", ONLY_PYTHON, false, false, {}},
};

constexpr Choice CHOICES[] = {
    {"separation", "rays"},
    {"separation", "gap"},
};

constexpr Tensor STATE[] = {
    {"corner", "I64", sizeof(int64_t), {2}, 0.0},
    {"base_height", "F32", sizeof(float), {}, 0.0},
    {"pose_covariance", "F32", sizeof(float), {3, 3}, 0.0},
    {"elapsed", "I64", sizeof(int64_t), {}, 0.0},
    {"elevation", "F32", sizeof(float), {ROWS, COLUMNS}, 0.0},
    {"variance", "F32", sizeof(float), {ROWS, COLUMNS}, 1.0},
    {"validity", "BOOL", sizeof(uint8_t), {ROWS, COLUMNS}, 0.0},
    {"support", "F32", sizeof(float), {ROWS, COLUMNS}, 0.0},
    {"challenger", "F32", sizeof(float), {ROWS, COLUMNS}, 0.0},
    {"challenger_support", "U8", sizeof(uint8_t), {ROWS, COLUMNS}, 0.0},
    {"time", "F32", sizeof(float), {ROWS, COLUMNS}, 0.0},
    {"upper_bound", "F32", sizeof(float), {ROWS, COLUMNS}, 0.0},
    {"bounded", "BOOL", sizeof(uint8_t), {ROWS, COLUMNS}, 0.0},
    {"gradient_x", "F32", sizeof(float), {ROWS, COLUMNS}, 0.0},
    {"gradient_y", "F32", sizeof(float), {ROWS, COLUMNS}, 0.0},
    {"has_normal", "BOOL", sizeof(uint8_t), {ROWS, COLUMNS}, 0.0},
    {"traversability", "F32", sizeof(float), {ROWS, COLUMNS}, 0.0},
    {"rated", "BOOL", sizeof(uint8_t), {ROWS, COLUMNS}, 0.0},
    {"last_points_used", "I64", sizeof(int64_t), {}, 0.0},
    {"last_rejected_invalid", "I64", sizeof(int64_t), {}, 0.0},
    {"last_rejected_range", "I64", sizeof(int64_t), {}, 0.0},
    {"last_rejected_body", "I64", sizeof(int64_t), {}, 0.0},
    {"last_rejected_overhang", "I64", sizeof(int64_t), {}, 0.0},
    {"last_rejected_outside", "I64", sizeof(int64_t), {}, 0.0},
    {"last_rejected_outlier", "I64", sizeof(int64_t), {}, 0.0},
    {"last_rejected_edge", "I64", sizeof(int64_t), {}, 0.0},
    {"last_drift_points", "I64", sizeof(int64_t), {}, 0.0},
    {"last_drift_error", "F32", sizeof(float), {}, 0.0},
    {"last_drift_correction", "F32", sizeof(float), {}, 0.0},
    {"last_disagreement", "F32", sizeof(float), {}, 0.0},
    {"last_cleared_seen_through", "I64", sizeof(int64_t), {}, 0.0},
    {"last_cleared_other_floors", "I64", sizeof(int64_t), {}, 0.0},
    {"last_cells_bounded", "I64", sizeof(int64_t), {}, 0.0},
};

constexpr int CONFIG_VERSION = 1;
constexpr int MAX_RADIUS = 1000;
constexpr int MAX_REFINEMENTS = 100;
constexpr int MAX_CELLS = 16384;
constexpr int MAX_LEVELS = 8;
constexpr double MAX_HEIGHT = 20.0;
constexpr double MIN_RESOLUTION = 0.0001;
constexpr double FARTHEST = 1000000000.0;
constexpr double STEP_REACH = 0.1;
constexpr double NEAR = 1.0;
constexpr double BREADTH = 1.4142135623730951;
constexpr double MARGIN = 0.5;
constexpr double MAX_BLOCK = 1.0;
constexpr double DAMPING = 0.8;
constexpr double OVERCORRECTION = 1.8;
constexpr double SAFETY = 4.0;

namespace diagnosis {

constexpr int MAX_UPDATES = 8;
constexpr int MAX_CORRECTIONS = 32;
constexpr int MAX_POINTS = 3000;
constexpr int PERIOD = 7;
constexpr int MIN_POINTS = 20;
constexpr double FAR = 250.0;
constexpr double MIN_BIAS = 0.01;
constexpr int MAX_TURNS = 6;
constexpr int MIN_TURNS = 5;
constexpr double MIN_EXPLAINED = 0.8;
constexpr double CELL_SIZE = 0.1;
constexpr int MIN_IN_CELL = 4;
constexpr double SPREAD = 0.05;
constexpr Gate GATES[] = {
    {"invalid", "are NaN or infinite, or their pose or variance is: check what makes them"},
    {"range", "are too near or too far: check their unit, and sensor.min_distance and sensor.max_distance"},
    {"body", "lie on the robot's own body: check sensor.body, T_map_base and T_base_links"},
    {"overhang", "lie above the exclusion ramp: check that the pose's z axis points up, that points with optical axes have a pose with such axes, and sensor.exclusion"},
};

}  // namespace diagnosis

constexpr FilterSetting FILTER_SETTINGS[] = {
    {"box", "radius", 0.1},
    {"gaussian", "sigma", 0.1},
    {"inpaint_diffusion", "tolerance", 0.001},
    {"inpaint_diffusion", "iterations", 40},
    {"inpaint_minimum", "iterations", NAN},
    {"median", "radius", 0.05},
};

constexpr const char* ALL_FILTERS[] = {
    "box",
    "closing",
    "curvature",
    "dilation",
    "em_cupy_erosion",
    "em_cupy_inpainting",
    "em_cupy_max_filter",
    "em_cupy_min_filter",
    "em_cupy_smooth_filter",
    "erosion",
    "expression",
    "fill_from",
    "foothold_score",
    "gaussian",
    "inpaint_diffusion",
    "inpaint_minimum",
    "inpaint_navier_stokes",
    "inpaint_nearest",
    "inpaint_telea",
    "maximum",
    "median",
    "minimum",
    "normal_x",
    "normal_y",
    "normal_z",
    "opening",
    "roughness",
    "signed_distance",
    "slope",
    "smooth_ground",
    "standard_deviation",
    "step_height",
    "traversability_three_part",
    "virtual_floor",
};

inline Settings default_settings() {
    Settings s{};
    s.measure.resolution = 0.04;
    s.measure.farthest = float(1000000000.0);
    s.measure.noise_factor = float(0.0001);
    s.measure.noise_floor = float(2.5e-05);
    s.measure.min_square = float(0.010000000000000002);
    s.measure.max_square = float(2500.0);
    s.measure.max_distance = float(50.0);
    s.measure.has_ramp = 1;
    s.measure.ramp_slope = float(0.3);
    s.measure.ramp_distance = float(1.0);
    s.measure.ramp_offset = float(0.2);
    s.measure.ramp_height = float(1.0);
    s.measure.has_box = 0;
    s.measure.box_lower[0] = float(-0.4);
    s.measure.box_lower[1] = float(-0.25);
    s.measure.box_lower[2] = float(-0.2);
    s.measure.box_upper[0] = float(0.4);
    s.measure.box_upper[1] = float(0.25);
    s.measure.box_upper[2] = float(0.3);
    s.recenter.resolution = float(0.04);
    s.age.variance_rate = float(1e-07);
    s.compensate.has_drift = 1;
    s.compensate.resolution = float(0.04);
    s.compensate.min_traversability = float(0.5);
    s.compensate.max_variance = float(0.01);
    s.compensate.max_error = float(0.1);
    s.compensate.gate_square = float(4.0);
    s.compensate.relief_square = float(9e-06);
    s.compensate.min_points = 50;
    s.compensate.max_drift = float(0.1);
    s.compensate.gain = float(1.0);
    s.compensate.nowhere = float(60000.0);
    s.disagreement.resolution = float(0.04);
    s.disagreement.significant_square = float(9.0);
    s.disagreement.newest = float(0.2);
    s.disagreement.max_bias = float(0.1);
    s.disagreement.min_cells = 20;
    s.disagreement.least = float(1e-12);
    s.fusion.resolution = float(0.04);
    s.fusion.relief = float(0.01);
    s.fusion.gate = float(3.0);
    s.fusion.max_gate_std = float(0.05);
    s.fusion.floor = float(1e-06);
    s.fusion.outlier_variance = float(0.0001);
    s.fusion.max_support = float(60.0);
    s.fusion.max_variance = float(1.0);
    s.fusion.min_above = 5;
    s.fusion.max_above_per_scan = 2;
    s.fusion.min_challengers = 4;
    s.fusion.has_rays = 1;
    s.fusion.has_edges = 1;
    s.fusion.min_points = 6;
    s.fusion.min_extreme = 2;
    s.fusion.refinements = 7;
    s.fusion.min_share = float(0.25);
    s.fusion.min_passed = float(0.1);
    s.fusion.margin = float(0.25);
    s.fusion.min_settled = float(6.0);
    s.fusion.many_points = 1048576;
    s.visibility.has_rays = 1;
    s.visibility.resolution = float(0.04);
    s.visibility.relief = float(0.0004);
    s.visibility.min_time = float(1.0);
    s.visibility.min_incidence = float(0.1);
    s.visibility.min_support = float(3.0);
    s.visibility.gate = float(3.0);
    s.visibility.ranges = 195;
    s.visibility.azimuths = 1324;
    s.visibility.bins = float(298.00470064800214);
    s.visibility.levels = 9;
    s.visibility.widen[0] = 299;
    s.visibility.widen[1] = 100;
    s.visibility.widen[2] = 43;
    s.visibility.widen[3] = 20;
    s.visibility.widen[4] = 10;
    s.visibility.widen[5] = 5;
    s.visibility.widen[6] = 3;
    s.visibility.widen[7] = 2;
    s.visibility.widen[8] = 1;
    s.visibility.widen[9] = 0;
    s.visibility.widen[10] = 0;
    s.visibility.widen[11] = 0;
    s.visibility.widen[12] = 0;
    s.visibility.widen[13] = 0;
    s.visibility.widen[14] = 0;
    s.visibility.widen[15] = 0;
    s.visibility.horizon_ranges = 104;
    s.visibility.near_cells = 25;
    s.visibility.clearance = float(0.05);
    s.visibility.no_ray = float(10000.0);
    s.visibility.no_fall = float(10000.0);
    s.visibility.nowhere = float(60000.0);
    s.overlap.has_overlap = 1;
    s.overlap.resolution = float(0.04);
    s.overlap.radius_square = float(9.0);
    s.overlap.slope = float(0.5);
    s.overlap.height = float(1.5);
    s.overlap.base_height = float(0.6);
    s.overlap.max_base_height = float(2.5);
    s.overlap.stance_square = float(0.25);
    s.overlap.first_row = 49;
    s.overlap.end_row = 201;
    s.overlap.first_column = 49;
    s.overlap.end_column = 201;
    s.surface.radius = 1;
    s.surface.cells = 2;
    s.surface.steps = 2;
    s.surface.per_cell = float(25.0);
    s.surface.min_spread[0] = float(0.249);
    s.surface.min_spread[1] = float(0.31900000000000006);
    s.surface.per_critical[0] = float(1.4285714285714286);
    s.surface.per_critical[1] = float(5.0);
    s.surface.per_critical[2] = float(20.0);
    s.surface.min_det = float(0.0001);
    s.surface.min_trace = float(0.01);
    s.surface.nowhere = float(60000.0);
    s.surface.tile_memory = 2880;
    s.levels.resolution = 0.04;
    s.levels.variance_rate = float(1e-07);
    s.levels.max_variance = float(1.0);
    s.levels.max_support = float(60.0);
    s.levels.variance_floor = float(1e-06);
    s.levels.min_gap = float(0.4);
    s.levels.max_step = float(0.3);
    s.levels.min_support = float(3.0);
    s.levels.least_support = float(3.0);
    s.levels.min_time = float(1.0);
    s.levels.overlap_height = float(1.5);
    s.levels.overlap_radius = float(3.0);
    s.levels.by_gap = 0;
    s.levels.max_blind = 12;
    s.levels.azimuths = 512;
    s.levels.elevations = 128;
    s.levels.ranges = 270;
    return s;
}

extern "C" {
void run_measure(Update&);
void run_recenter(Update&);
void run_sort_levels(Update&);
void run_reset_statistics(Update&);
void run_subtract_disagreement(Update&);
void run_age(Update&);
void run_compensate(Update&);
void run_raise_levels(Update&);
void run_fuse(Update&);
void run_clear_seen_through(Update&);
void run_clear_other_floors(Update&);
void run_count_bounded(Update&);
void run_add_disagreement(Update&);
void run_rate_surface(Update&);
}
constexpr Stage ORDER[] = {
    run_measure,
    run_reset_statistics,
    run_subtract_disagreement,
    run_recenter,
    run_age,
    run_compensate,
    run_fuse,
    run_clear_seen_through,
    run_clear_other_floors,
    run_count_bounded,
    run_add_disagreement,
    run_rate_surface,
};
constexpr Stage ORDER_WITH_LEVELS[] = {
    run_measure,
    run_recenter,
    run_sort_levels,
    run_reset_statistics,
    run_subtract_disagreement,
    run_age,
    run_compensate,
    run_raise_levels,
    run_fuse,
    run_clear_seen_through,
    run_clear_other_floors,
    run_count_bounded,
    run_add_disagreement,
    run_rate_surface,
};

constexpr double ISAAC_LAB_X[] = {-0.8, -0.7000000000000001, -0.6000000000000001, -0.5, -0.4, -0.30000000000000004, -0.19999999999999996, -0.09999999999999998, 0.0, 0.09999999999999998, 0.19999999999999996, 0.30000000000000004, 0.40000000000000013, 0.5, 0.6000000000000001, 0.7, 0.8};
constexpr double ISAAC_LAB_Y[] = {-0.5, -0.4, -0.3, -0.19999999999999996, -0.09999999999999998, 0.0, 0.10000000000000009, 0.20000000000000007, 0.30000000000000004, 0.4, 0.5};

constexpr double MJLAB_X[] = {-0.8, -0.7000000000000001, -0.6000000000000001, -0.5, -0.4, -0.30000000000000004, -0.19999999999999996, -0.09999999999999998, 0.0, 0.09999999999999998, 0.19999999999999996, 0.30000000000000004, 0.40000000000000013, 0.5, 0.6000000000000001, 0.7, 0.8};
constexpr double MJLAB_Y[] = {-0.5, -0.4, -0.3, -0.19999999999999996, -0.09999999999999998, 0.0, 0.10000000000000009, 0.20000000000000007, 0.30000000000000004, 0.4, 0.5};

constexpr double LEGGED_GYM_X[] = {-0.8, -0.7, -0.6, -0.5, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8};
constexpr double LEGGED_GYM_Y[] = {-0.5, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5};

constexpr Preset PRESETS[] = {
    {"isaac_lab", ISAAC_LAB_X, int(std::size(ISAAC_LAB_X)), ISAAC_LAB_Y, int(std::size(ISAAC_LAB_Y)), true, scans::BILINEAR, 0.5, 1.0, 1.0, 0.5},
    {"mjlab", MJLAB_X, int(std::size(MJLAB_X)), MJLAB_Y, int(std::size(MJLAB_Y)), true, scans::BILINEAR, 0.0, INFINITY, 0.2, 0.5},
    {"legged_gym", LEGGED_GYM_X, int(std::size(LEGGED_GYM_X)), LEGGED_GYM_Y, int(std::size(LEGGED_GYM_Y)), false, scans::MINIMUM, 0.5, 1.0, 5.0, 0.5},
};
