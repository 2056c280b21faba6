// What the rays of one sensor say of the cells below them: stages/visibility/clean_up.py.
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF  // rounded as in torch, so that cells and rays fall into the same bins
#else
#pragma GCC optimize("fp-contract=off")
#endif

#include "../threads.h"
#include "cells.h"

constexpr int AT_A_TIME = 2048;  // cells that a thread takes

namespace {

struct Inputs {
    const float *x, *y, *z;
    int height, width;
};

Layers from(const Layers& l, int64_t n) {
    return {l.elevation + n,
            l.variance + n,
            l.time + n,
            l.gradient_x + n,
            l.gradient_y + n,
            l.challenger + n,
            l.upper_bound + n,
            l.validity + n,
            l.bounded + n,
            l.challenger_support + n,
            l.new_upper_bound + n,
            l.new_validity + n,
            l.new_bounded + n,
            l.new_challenger_support + n};
}

}  // namespace

// The four changed layers of maps (B, H, W) with N rays (B, N); `x` (B, H), `y` (B, W) and `z` (B) are where the cells
// lie from the sensor, and its height [m]. Masks are bytes.
extern "C" int clear_and_bound(const int32_t* range, const int32_t* azimuth, const float* slope, const float* x,
                               const float* y, const float* z, const float* elevation, const float* variance,
                               const uint8_t* validity, const float* time, const float* gradient_x,
                               const float* gradient_y, const float* challenger, const uint8_t* challenger_support,
                               const float* upper_bound, const uint8_t* bounded, uint8_t* new_validity,
                               uint8_t* new_bounded, float* new_upper_bound, uint8_t* new_challenger_support, int64_t B,
                               int64_t N, int64_t H, int64_t W, int64_t ranges, int64_t azimuths, const int64_t* widen,
                               int64_t levels, float bins, float resolution, float min_time, float min_incidence,
                               float gate, int num_threads) {
    const Polar polar{int(ranges), int(azimuths), bins, widen, int(levels)};
    const Limits limits{resolution, min_time, min_incidence, gate};
    const Layers layers{elevation,  variance,  time,          gradient_x,         gradient_y,
                        challenger, upper_bound, validity,    bounded,            challenger_support,
                        new_upper_bound, new_validity, new_bounded, new_challenger_support};
    const int rows_at_a_time = int(std::max<int64_t>(1, AT_A_TIME / W));
    auto update = [&](int64_t b, int parts, auto each) {
        Table table(polar, NO_RAY);
        table.build({range + b * N, azimuth + b * N, slope + b * N, N}, parts, each);
        each(int((H + rows_at_a_time - 1) / rows_at_a_time), [&](int k) {
            const int64_t first = int64_t(k) * rows_at_a_time, end = std::min(H, first + rows_at_a_time);
            for (int64_t i = first; i < end; i++) {
                const Layers cells = from(layers, (b * H + i) * W);
                Row{table, polar, limits, cells, x[b * H + i], z[b], y + b * W, int(W)}.apply();
            }
        });
    };
    auto one_by_one = [](int count, auto work) {
        for (int k = 0; k < count; k++) work(k);
    };
    auto side_by_side = [&](int count, auto work) { for_each(count, num_threads, work); };
    return code_of([&] {
        // A thread for each map, or all of them for one map after the other.
        if (num_threads == 1 || B >= 4 * num_threads)
            for_each(int(B), num_threads, [&](int b) { update(b, 1, one_by_one); });
        else
            for (int64_t b = 0; b < B; b++) update(b, 4 * num_threads, side_by_side);
    });
}
