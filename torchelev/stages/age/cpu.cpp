#include "kernels/update.h"

extern "C" void run_age(Update&) {}
