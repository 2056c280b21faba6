// An update of B maps on a GPU: what every kernel of the stages takes, by value.
#pragma once

#include <cmath>
#include <cstdint>

#include "generated.h"  // Sizes, MapState, Statistics, Inputs, Scratch and Settings, derived from their declarations
#include "kernels/cuda/blocks.h"

struct Update {
    Sizes sizes;
    MapState state;     // (B, ...) each
    Inputs inputs;      // (B, ...) each
    Scratch scratch;    // (B, ...) each: the measurement, and what stages pass on
    Settings settings;
    int64_t sensor;     // of a stage whose launches run for each sensor

    int64_t cells() const { return sizes.H * sizes.W; }
};
