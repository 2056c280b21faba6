// Levels without Python: what levels/module.py and levels/native.py do around levels/kernel/levels.cpp.
#include "runtime/source/levels.h"

#include <algorithm>
#include <cmath>
#include <new>

extern "C" int update_levels(const levels::Update* u, int num_threads);

namespace {

// Sizes of the tables of rays: `SightGrid.of`.
void set_tables(const Config& cfg, levels::Update& u) {
    const double cells = double(std::max(cfg.rows(), cfg.columns()));
    u.azimuths = int32_t(std::min(1024.0, std::max(64.0, std::exp2(std::ceil(std::log2(M_PI * cells / 2))))));
    u.elevations = u.azimuths / 4;
    u.ranges = int32_t(std::ceil(0.75 * std::hypot(double(cfg.rows()), double(cfg.columns())))) + 4;
}

void set_sensor(const Config& cfg, levels::Update& u) {
    u.noise_factor = float(cfg["sensor.noise_factor"]), u.noise_floor = float(cfg["sensor.noise_floor"]);
    u.min_distance = float(cfg["sensor.min_distance"]), u.max_distance = float(cfg["sensor.max_distance"]);
    u.has_box = cfg.has("sensor.body"), u.has_ramp = cfg.has("sensor.exclusion");
    for (int axis = 0; u.has_box && axis < 3; axis++) {
        u.box[axis] = float(cfg.place("sensor.body.lower")[axis]);
        u.box[3 + axis] = float(cfg.place("sensor.body.upper")[axis]);
    }
    const char* const ramp[] = {"slope", "distance", "offset", "height"};
    for (int k = 0; u.has_ramp && k < 4; k++) u.ramp[k] = float(cfg[std::string("sensor.exclusion.") + ramp[k]]);
}

void set_surfaces(const Config& cfg, levels::Update& u) {
    u.variance_rate = float(cfg["aging.variance_rate"]), u.max_variance = float(cfg["fusion.max_variance"]);
    u.max_support = float(cfg["fusion.max_support"]), u.variance_floor = float(cfg["fusion.scan_variance_floor"]);
    u.min_gap = float(cfg["levels.min_gap"]), u.max_step = float(cfg["levels.max_step"]);
    u.min_support = float(cfg["levels.min_support"]);
    u.min_time = cfg.has("raycast") ? float(cfg["raycast.min_time"]) : INFINITY;
    const bool has_overlap = cfg.has("overlap");
    u.overlap_height = has_overlap ? float(cfg["overlap.height"]) : 0;
    u.overlap_radius = has_overlap ? float(cfg["overlap.radius"]) : 0;
    u.by_gap = cfg.word("levels.separation") == "gap";
    u.max_blind = int32_t(std::min(cfg["levels.max_blind"], 1e3) / cfg["grid.resolution"]);
}

// The tensors of a map that an update of levels reads and writes.
void set_ground(const MapState& state, levels::Update& u) {
    u.corner = state.corner, u.elevation = state.elevation, u.ground_variance = state.variance;
    u.validity = state.validity, u.ground_support = state.support, u.challenger_support = state.challenger_support;
    u.ground_time = state.time, u.bounded = state.bounded, u.disagreement = state.statistics.disagreement;
}

}  // namespace

MapLevels::MapLevels(const Config& cfg, const torchelev_limits& limits)
    : H(cfg.rows()), W(cfg.columns()), L(int64_t(cfg["levels.max_levels"]) - 1), corner{-(H / 2), -(W / 2)},
      aside(limits.max_points), statistics{}, fixed{} {
    for (std::vector<float>* values : {&lower, &upper, &variance, &support, &time}) values->resize(L * H * W);
    free_top.resize(H * W), is_open.resize(H * W);
    levels::Update& u = fixed;
    u.before = corner, u.lower = lower.data(), u.upper = upper.data(), u.level_variance = variance.data();
    u.support = support.data(), u.time = time.data(), u.free_top = free_top.data(), u.is_open = is_open.data();
    u.aside = aside.data(), u.statistics = statistics;
    u.B = 1, u.H = H, u.W = W, u.L = L, u.resolution = cfg["grid.resolution"];
    set_sensor(cfg, u), set_surfaces(cfg, u), set_tables(cfg, u);
    forget();
}

void MapLevels::forget() {
    for (std::vector<float>* values : {&lower, &upper, &variance, &support, &time})
        std::fill(values->begin(), values->end(), 0.0f);
    std::fill(free_top.begin(), free_top.end(), -INFINITY), std::fill(is_open.begin(), is_open.end(), 0);
}

void MapLevels::sort_points(const MapState& state, const Sizes& sizes, Inputs& inputs, int num_threads) {
    levels::Update u = fixed;
    u.points = inputs.points, u.T_map_sensor = inputs.T_map_sensor, u.T_map_base = inputs.T_map_base;
    u.variance = inputs.variance, u.own = inputs.own, u.dt = inputs.dt;
    u.S = sizes.S, u.N = sizes.N;
    set_ground(state, u);
    if (update_levels(&u, num_threads)) throw std::bad_alloc();
    inputs.aside = aside.data();
}

void MapLevels::raise(float height) {
    for (std::vector<float>* values : {&lower, &upper, &free_top})
        for (float& value : *values) value += height;
}

bool MapLevels::holds(const MapState& state, int64_t cell) const {
    const int64_t x = state.corner[0] + cell / W, y = state.corner[1] + cell % W;
    return x >= corner[0] && x < corner[0] + H && y >= corner[1] && y < corner[1] + W;
}

int64_t MapLevels::place(const MapState& state, int64_t cell) const {
    const int64_t x = state.corner[0] + cell / W, y = state.corner[1] + cell % W;
    return (x % H + H) % H * W + (y % W + W) % W;
}

void MapLevels::blank(int64_t place) {
    for (std::vector<float>* values : {&lower, &upper, &variance, &support, &time})
        for (int64_t l = 0; l < L; l++) (*values)[l * H * W + place] = 0;
    free_top[place] = -INFINITY, is_open[place] = 0;
}

void MapLevels::follow(const MapState& state) {
    for (int64_t cell = 0; cell < H * W; cell++)
        if (!holds(state, cell)) blank(place(state, cell));
    std::copy_n(state.corner, 2, corner);
}

void MapLevels::forget_cell(const MapState& state, int64_t cell) {
    if (holds(state, cell)) blank(place(state, cell));
}

Ceiling MapLevels::ceiling(const MapState& state, int64_t cell) const {
    const bool has_floor = state.validity[cell] || state.bounded[cell];
    const float floor = state.validity[cell] ? state.elevation[cell] : state.upper_bound[cell];
    if (!has_floor || !holds(state, cell)) return {INFINITY, false};
    const float least = std::max(fixed.min_support, 0.5f);
    const int64_t p = place(state, cell);
    float lowest = INFINITY;
    for (int64_t l = 0; l < L; l++) {
        const int64_t q = l * H * W + p;
        if (support[q] >= least && lower[q] > floor) lowest = std::min(lowest, lower[q]);
    }
    return {lowest, lowest < INFINITY || free_top[p] >= floor + fixed.min_gap};
}

std::vector<Stored> MapLevels::stored() {
    const std::vector<int64_t> all{L, H, W}, one{H, W};
    auto numbers = [](const char* name, std::vector<float>& values, const std::vector<int64_t>& shape) {
        return Stored{name, "F32", shape, values.data(), sizeof(float), false};
    };
    Stored top = numbers("levels_free_top", free_top, one);
    top.has_infinities = true;
    return {{"levels_corner", "I64", {2}, corner, sizeof(int64_t), false},
            numbers("levels_lower", lower, all),
            numbers("levels_upper", upper, all),
            numbers("levels_variance", variance, all),
            numbers("levels_support", support, all),
            numbers("levels_time", time, all),
            top,
            {"levels_is_open", "BOOL", one, is_open.data(), 1, false}};
}
