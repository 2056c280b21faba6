// The surfaces of a map besides its ground, kept between updates: levels/module.py.
#pragma once

#include <vector>

#include "kernels/update.h"
#include "runtime/source/config.h"

// A tensor as files and readers see it.
struct Stored {
    const char *name, *dtype;    // of safetensors
    std::vector<int64_t> shape;  // of one map
    void* data;
    size_t size;  // [bytes] of an element
    bool has_infinities;

    int64_t count() const {
        int64_t number = 1;
        for (const int64_t length : shape) number *= length;
        return number;
    }
    size_t bytes() const { return count() * size; }
};

struct Ceiling {
    float height;
    bool known;
};

class MapLevels {
    int64_t H, W, L;
    int64_t corner[2];  // of the window that the rings hold
    std::vector<float> lower, upper, variance, support, time, free_top;
    std::vector<uint8_t> is_open;
    int64_t numbers[5];  // `LevelStatistics` of the last update
    float min_gap, least_support;

    bool holds(const MapState& state, int64_t cell) const;     // whether a cell of the map lies in the rings' window
    int64_t place(const MapState& state, int64_t cell) const;  // of a cell of the map in the rings
    void blank(int64_t place);

  public:
    MapLevels(const Config& cfg, const LevelsSettings& settings);

    int64_t number() const { return L; }  // of surfaces besides the ground
    StoredLevels tensors();               // as updates change them
    void follow(const MapState& state);   // to the window of a map that moved besides updates
    void forget();
    void forget_cell(const MapState& state, int64_t cell);
    // The underside of the lowest surface above a cell's ground [m]: `ceiling` of levels/views.py.
    Ceiling ceiling(const MapState& state, int64_t cell) const;
    std::vector<Stored> stored();
};
