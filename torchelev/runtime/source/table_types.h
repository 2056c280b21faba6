// The types of the tables that follow from Python's declarations: generate.py.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iterator>

#include "kernels/update.h"
#include "observations/kernel/scan.h"

// GROUP: an object of settings. CHOICE: one of several words. ONLY_PYTHON: what this library cannot do. IGNORED: what no
// update reads. CHAIN: filters.
enum Kind { GROUP, NUMBER, INTEGER, PLACE, CHOICE, ONLY_PYTHON, IGNORED, CHAIN };

struct Setting {
    const char* name;  // with its groups, as "fusion.edges.margin"
    Kind kind;
    bool is_nullable, is_null;
    double values[3];  // by default
};

// A word of a setting that is one of several; the setting's value is its place among them.
struct Choice {
    const char *setting, *word;
};

// A setting of a filter; NAN by default: none.
struct FilterSetting {
    const char *filter, *name;
    double usual;
};

// A gate of the sensor, and what a diagnosis says of points that it rejects.
struct Gate {
    const char *name, *reason;
};

constexpr int64_t ROWS = -1, COLUMNS = -2;

struct Tensor {
    const char *name, *dtype;  // of safetensors
    size_t size;               // [bytes] of an element
    int64_t shape[2];          // of one map; 0: none
    double blank;
};

struct Preset {
    const char* name;
    const double* x;
    int num_x;
    const double* y;
    int num_y;
    bool is_x_fastest;
    scans::Mode mode;
    double nominal_height, clip, scale, standing_height;
};
