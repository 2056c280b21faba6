// The completed maps: complete.py.

// To multiply and add in one step takes a quarter of the time off convolutions.
#ifdef __clang__
#pragma clang fp contract(fast)
#else
#pragma GCC optimize("fp-contract=fast")
#endif

#include "kernels/threads.h"
#include "predict.h"
#include "refine.h"

namespace {

constexpr int ROWS_AT_A_TIME = 8;

// Complete some rows: the measured cells of each, then all unknown ones.
void complete_rows(const Weights& weights, const Map& map, Squares& of_rows, int first, int end) {
    of_rows.describe(map, first, end);
    for (int i = first; i < end; i++) refine(weights, map, of_rows, i);
    Cells cells[GROUPS];
    int count = 0;
    auto put = [&](int at, int i, int j) {
        cells[at / LANES].row[at % LANES] = i, cells[at / LANES].column[at % LANES] = j;
    };
    auto flush = [&] {
        for (int l = count; l < GROUPS * LANES; l++) put(l, cells[0].row[0], cells[0].column[0]);
        for (Cells& group : cells)
            group.adjacent = group.row[0] == group.row[LANES - 1] &&
                             group.column[LANES - 1] - group.column[0] == LANES - 1;
        Answer answers[GROUPS];
        predict(weights, map, of_rows, cells, answers);
        for (int l = 0; l < count; l++) {
            const int g = l / LANES, place = cells[g].row[l % LANES] * map.W + cells[g].column[l % LANES];
            map.layers.mean[place] = answers[g].mean[l % LANES], map.layers.std[place] = answers[g].std[l % LANES];
        }
        count = 0;
    };
    for (int i = first; i < end; i++)
        for (int j = 0; j < map.W; j++) {
            if (map.layers.known[i * map.W + j]) continue;
            put(count++, i, j);
            if (count == GROUPS * LANES) flush();
        }
    if (count) flush();
}

}  // namespace

// Layers of (B, H, W) and parameters as in complete.py; H and W are below 32767. Returns what `code_of` does.
extern "C" int complete(const float* weights, const float* elevation, const uint8_t* known, const float* variance,
                        const float* upper_bound, const uint8_t* bounded, const float* age, float* mean, float* std,
                        int B, int H, int W, double resolution, int num_threads) {
    const Weights parameters(weights);
    auto make = [&] { return Map(H, W, resolution); };
    auto fill = [&](int64_t b, int threads, Map& map) {
        const size_t first = size_t(b) * H * W;
        map.read({elevation + first, variance + first, upper_bound + first, age + first, known + first, bounded + first,
                  mean + first, std + first});
        for_each(2, threads, [&](int part) { part ? map.count_steps() : map.sum_layers(); });
        auto room = [] { return Squares(); };
        for_each((H + ROWS_AT_A_TIME - 1) / ROWS_AT_A_TIME, threads, room, [&](int k, Squares& of_rows) {
            complete_rows(parameters, map, of_rows, k * ROWS_AT_A_TIME, std::min((k + 1) * ROWS_AT_A_TIME, H));
        });
    };
    return code_of([&] { for_environments(B, num_threads, make, fill); });
}
