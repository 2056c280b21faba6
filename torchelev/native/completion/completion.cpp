// The completed maps: complete.py.

#include "../threads.h"
#include "predict.h"
#include "refine.h"

namespace {

// Complete a row: all cells as measured ones, then the unknown ones.
void complete_row(const Weights& weights, const Map& map, int i) {
    const Squares of_row = describe(map, i);
    refine(weights, map, of_row, i);
    Cells cells;
    int count = 0;
    auto flush = [&] {
        for (int l = count; l < LANES; l++) cells.row[l] = i, cells.column[l] = cells.column[0];
        cells.adjacent = cells.column[LANES - 1] - cells.column[0] == LANES - 1;
        const Answer answer = predict(weights, map, of_row, cells);
        for (int l = 0; l < count; l++) {
            map.layers.mean[i * map.W + cells.column[l]] = answer.mean[l];
            map.layers.std[i * map.W + cells.column[l]] = answer.std[l];
        }
        count = 0;
    };
    for (int j = 0; j < map.W; j++) {
        if (map.layers.known[i * map.W + j]) continue;
        cells.row[count] = i, cells.column[count++] = j;
        if (count == LANES) flush();
    }
    if (count) flush();
}

}  // namespace

// Layers of (B, H, W) and parameters as in complete.py; H and W are below 32767. Returns what `code_of` does.
extern "C" int complete(const float* weights, const float* elevation, const bool* known, const float* variance,
                        const float* upper_bound, const bool* bounded, const float* age, float* mean, float* std,
                        int B, int H, int W, double resolution, int num_threads) {
    const Weights parameters(weights);
    auto make_map = [&](int b) {
        const size_t first = size_t(b) * H * W;
        return Map({elevation + first, variance + first, upper_bound + first, age + first, known + first,
                    bounded + first, mean + first, std + first}, H, W, resolution);
    };
    auto fill = [&](int64_t b, int threads) {
        Map map = make_map(int(b));
        for_each(2, threads, [&](int part) { part ? map.count_steps() : map.sum_layers(); });
        for_each(H, threads, [&](int i) { complete_row(parameters, map, i); });
    };
    return code_of([&] { for_environments(B, num_threads, fill); });
}
