#include "kernels/update.h"

extern "C" void run_rate_surface(Update&) {}
