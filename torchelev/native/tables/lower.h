// For CPUs and GPUs.
#pragma once

// The lower value; NaN if one of them is.
inline float lower(float a, float b) { return a < b || a != a ? a : b; }
