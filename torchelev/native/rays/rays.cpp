// What the rays of one sensor say of the cells below them: stages/visibility/clean_up.py.
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF  // rounded as in torch, so that cells and rays fall into the same bins
#else
#pragma GCC optimize("fp-contract=off")
#endif

#include "cells.h"

constexpr int64_t AT_A_TIME = 2048;  // cells that a thread takes
constexpr int64_t LARGE = 1000000;  // entries of a table that is worth several threads
constexpr int MAPS_PER_THREAD = 4;  // from which on each thread takes whole maps

// What rays (B, N) of one sensor make of maps (B, H, W); masks are bytes. `x` (B, H) and `y` (B, W) are the cells'
// places as seen from the sensors, and `z` (B) the sensors' heights [m]. The last four layers change;
// `numbers` (B) of the cells cleared.
extern "C" int apply_rays(const int32_t* range, const int32_t* azimuth, const float* slope, const float* x,
                          const float* y, const float* z, const float* elevation, const float* variance,
                          const float* time, const float* gradient_x, const float* gradient_y, const float* challenger,
                          uint8_t* validity, uint8_t* bounded, float* upper_bound, uint8_t* challenger_support,
                          int64_t* numbers, int64_t B, int64_t N, int64_t H, int64_t W, int64_t ranges,
                          int64_t azimuths, int64_t levels,
                          const int64_t* widen, float bins, float resolution, float min_time, float min_incidence,
                          float gate, int num_threads) {
    const Polar polar{int(ranges), int(azimuths), bins, widen, int(levels)};
    const Settings settings{resolution, min_time, min_incidence, gate};
    const Layers layers{elevation, variance, time, gradient_x, gradient_y, challenger};
    const Changed changed{validity, bounded, upper_bound, challenger_support};
    const int64_t at_a_time = std::max(int64_t(1), AT_A_TIME / W);
    auto update = [&](int64_t b, int threads) {
        const int builders = ranges * azimuths < LARGE ? 1 : threads;
        const Table table(polar, {range + b * N, azimuth + b * N, slope + b * N, N}, builders);
        numbers[b] = 0;
        for_each(int((H + at_a_time - 1) / at_a_time), threads, [&](int k) {
            int64_t number = 0;
            for (int64_t i = b * H + k * at_a_time; i < b * H + std::min(H, (k + 1) * at_a_time); i++)
                number += Row{table, polar, settings, layers, changed, i * W, x[i], z[b], y + b * W, int(W)}.apply();
            __atomic_fetch_add(&numbers[b], number, __ATOMIC_RELAXED);
        });
    };
    return code_of([&] { for_environments(B, num_threads, update, MAPS_PER_THREAD); });
}
