// Levels without Python: what levels/module.py does besides updates.
#include "runtime/source/levels.h"

#include <algorithm>
#include <cmath>

MapLevels::MapLevels(const Config& cfg, const LevelsSettings& s)
    : H(cfg.rows()), W(cfg.columns()), L(int64_t(cfg["levels.max_levels"]) - 1), corner{-(H / 2), -(W / 2)},
      numbers{}, min_gap(s.min_gap), least_support(s.least_support) {
    for (std::vector<float>* values : {&lower, &upper, &variance, &support, &time}) values->resize(L * H * W);
    free_top.resize(H * W), is_open.resize(H * W);
    forget();
}

StoredLevels MapLevels::tensors() {
    return {corner,      lower.data(),    upper.data(),   variance.data(), support.data(),
            time.data(), free_top.data(), is_open.data(), numbers};
}

void MapLevels::forget() {
    for (std::vector<float>* values : {&lower, &upper, &variance, &support, &time})
        std::fill(values->begin(), values->end(), 0.0f);
    std::fill(free_top.begin(), free_top.end(), -INFINITY), std::fill(is_open.begin(), is_open.end(), 0);
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
    const int64_t p = place(state, cell);
    float lowest = INFINITY;
    for (int64_t l = 0; l < L; l++) {
        const int64_t q = l * H * W + p;
        if (support[q] >= least_support && lower[q] > floor) lowest = std::min(lowest, lower[q]);
    }
    return {lowest, lowest < INFINITY || free_top[p] >= floor + min_gap};
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
