// Values by slot, and tables of minima: ops/operators.py.

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "native/minima.h"
#include "kernels/threads.h"

namespace {

constexpr int64_t COLUMNS = 1024;  // of a table that one thread scans: their rows stay in its cache

// Turn each row into the minimum of itself and the one before it.
void scan(float* table, int64_t first, int64_t last, int64_t step, int64_t width, int64_t begin, int64_t end) {
    for (int64_t r = first; r != last; r += step) {
        const float* before = table + (r - step) * width;
        float* row = table + r * width;
        for (int64_t a = begin; a < end; a++) row[a] = lower(before[a], row[a]);
    }
}

struct Polar {
    int64_t rows, azimuths, ranges, number;
    const int64_t* widen;
    int64_t levels;
    float blank;

    void fill(const int64_t* index, const float* values, float* table) const {
        const int64_t size = rows * azimuths;
        std::fill(table, table + size, blank);
        for (int64_t i = 0; i < number; i++) {
            const int64_t slot = checked(index[i], size);
            table[slot] = lower(table[slot], values[i]);
        }
        std::fill(table + ranges * azimuths, table + (ranges + 1) * azimuths, blank);
    }

    void scan_columns(float* table, int64_t begin, int64_t end) const {
        scan(table, rows - 2, -1, -1, azimuths, begin, end);
    }

    void widen_rows(float* table, int64_t begin, int64_t end) const {
        std::vector<float> start(azimuths);
        for (int64_t r = begin; r < end; r++)
            for (int64_t w = 0; w < levels; w++)
                if (r < widen[w]) widen_row(table + r * azimuths, azimuths, (int64_t(1) << w) % azimuths, start.data());
    }
};

}  // namespace

// Sum values (rows, number) by index (num_index, number), which row r takes from r % num_index, into sums (rows, size).
extern "C" int add_by_slot(const int64_t* index, const float* values, float* sums, int64_t rows, int64_t num_index,
                           int64_t number, int64_t size, int num_threads) {
    auto add = [&](int64_t r) {
        const int64_t* slot = index + (r % num_index) * number;
        const float* value = values + r * number;
        float* sum = sums + r * size;
        std::fill(sum, sum + size, 0.0f);
        for (int64_t i = 0; i < number; i++) sum[checked(slot[i], size)] += value[i];
    };
    return code_of([&] { for_each(rows, num_threads, add); });
}

// The running minimum of tables (B, rows, width) along their rows.
extern "C" int running_minimum(const float* tables, float* results, int64_t B, int64_t rows, int64_t width,
                               int num_threads) {
    const int64_t blocks = (width + COLUMNS - 1) / COLUMNS;
    auto scan_block = [&](int64_t k) {
        const int64_t first = (k / blocks) * rows * width, begin = (k % blocks) * COLUMNS;
        const int64_t end = std::min(width, begin + COLUMNS);
        for (int64_t r = 0; r < rows; r++) {
            const float* row = tables + first + r * width;
            std::copy(row + begin, row + end, results + first + r * width + begin);
        }
        scan(results + first, 1, rows, 1, width, begin, end);
    };
    return code_of([&] { for_each(B * blocks, num_threads, scan_block); });
}

// The table of the lowest rays: `polar_minimum`.
extern "C" int polar_minimum(const int64_t* index, const float* values, float* tables, int64_t B, int64_t number,
                             int64_t rows, int64_t azimuths, int64_t ranges, const int64_t* widen, int64_t levels,
                             float blank, int num_threads) {
    const Polar polar{rows, azimuths, ranges, number, widen, levels, blank};
    auto make = [&](int64_t b, int threads) {
        float* table = tables + b * rows * azimuths;
        polar.fill(index + b * number, values + b * number, table);
        const Parts parts{threads == 1 ? 1 : 4 * threads, threads};
        parts(azimuths, [&](int64_t, int64_t begin, int64_t end) { polar.scan_columns(table, begin, end); });
        parts(rows, [&](int64_t, int64_t begin, int64_t end) { polar.widen_rows(table, begin, end); });
    };
    return code_of([&] { for_environments(B, num_threads, make); });
}
