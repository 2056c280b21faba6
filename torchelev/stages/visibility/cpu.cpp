#include "kernels/update.h"

extern "C" void run_clear_seen_through(Update&) {}
extern "C" void run_count_bounded(Update&) {}
