// What looks wrong with a map's inputs: diagnosis/causes.py.
#pragma once

#include <string>

struct torchelev_map;

// Return the findings of the rules that need no fit of planes and poses: a line each, worst first.
std::string diagnose(torchelev_map& map);
