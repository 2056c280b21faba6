// Values by slot, and tables of minima: ops/operators.py.

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "../threads.h"

namespace {

constexpr int64_t COLUMNS = 1024;  // of a table that one thread scans: their rows stay in its cache

// The lower value; NaN if one of them is.
inline float lower(float a, float b) { return a < b || a != a ? a : b; }

// Turn each row into the minimum of itself and the one before it.
void scan(float* table, int64_t first, int64_t last, int64_t step, int64_t width, int64_t begin, int64_t end) {
    for (int64_t r = first; r != last; r += step) {
        const float* before = table + (r - step) * width;
        float* row = table + r * width;
        for (int64_t a = begin; a < end; a++) row[a] = lower(before[a], row[a]);
    }
}

// Make each entry of a row the minimum of itself and the one `shift` on, all around; `start` has room for `shift`.
void widen_row(float* row, int64_t width, int64_t shift, float* start) {
    std::copy(row, row + shift, start);
    for (int64_t a = 0; a < width - shift; a++) row[a] = lower(row[a], row[a + shift]);
    for (int64_t a = width - shift; a < width; a++) row[a] = lower(row[a], start[a - (width - shift)]);
}

struct Polar {
    int64_t rows, azimuths, ranges, number;
    const int64_t* widen;
    int64_t levels;
    float blank;

    bool fill(const int64_t* index, const float* values, float* table) const {
        const int64_t size = rows * azimuths;
        std::fill(table, table + size, blank);
        for (int64_t i = 0; i < number; i++) {
            if (uint64_t(index[i]) >= uint64_t(size)) return false;
            table[index[i]] = lower(table[index[i]], values[i]);
        }
        std::fill(table + ranges * azimuths, table + (ranges + 1) * azimuths, blank);
        return true;
    }

    void scan_columns(float* table, int64_t begin, int64_t end) const {
        scan(table, rows - 2, -1, -1, azimuths, begin, end);
    }

    void widen_rows(float* table, int64_t begin, int64_t end) const {
        std::vector<float> start(azimuths);
        for (int64_t r = begin; r < end; r++)
            for (int64_t w = 0; w < levels && r < widen[w]; w++)
                widen_row(table + r * azimuths, azimuths, (int64_t(1) << w) % azimuths, start.data());
    }
};

}  // namespace

// Sum values (rows, number) by index (num_index, number), which row r takes from r % num_index, into sums (rows, size).
// False if an index is outside.
extern "C" bool add_by_slot(const int64_t* index, const float* values, float* sums, int64_t rows, int64_t num_index,
                            int64_t number, int64_t size, int num_threads) {
    std::atomic<bool> is_inside{true};
    for_each(rows, num_threads, [&](int r) {
        const int64_t* slot = index + (r % num_index) * number;
        const float* value = values + r * number;
        float* sum = sums + r * size;
        std::fill(sum, sum + size, 0.0f);
        for (int64_t i = 0; i < number; i++) {
            if (uint64_t(slot[i]) >= uint64_t(size)) {
                is_inside = false;
                return;
            }
            sum[slot[i]] += value[i];
        }
    });
    return is_inside;
}

// The running minimum of tables (B, rows, width) along their rows.
extern "C" bool running_minimum(const float* tables, float* result, int64_t B, int64_t rows, int64_t width,
                                int num_threads) {
    const int64_t blocks = (width + COLUMNS - 1) / COLUMNS;
    for_each(B * blocks, num_threads, [&](int k) {
        const int64_t first = (k / blocks) * rows * width, begin = (k % blocks) * COLUMNS;
        const int64_t end = std::min(width, begin + COLUMNS);
        for (int64_t r = 0; r < rows; r++) {
            const float* row = tables + first + r * width;
            std::copy(row + begin, row + end, result + first + r * width + begin);
        }
        scan(result + first, 1, rows, 1, width, begin, end);
    });
    return true;
}

// The table of the lowest rays: `polar_minimum`. False if an index is outside.
extern "C" bool polar_minimum(const int64_t* index, const float* values, float* tables, int64_t B, int64_t number,
                              int64_t rows, int64_t azimuths, int64_t ranges, const int64_t* widen, int64_t levels,
                              float blank, int num_threads) {
    const Polar polar{rows, azimuths, ranges, number, widen, levels, blank};
    std::atomic<bool> is_inside{true};
    auto fill = [&](int64_t b) {
        const bool done = polar.fill(index + b * number, values + b * number, tables + b * rows * azimuths);
        if (!done) is_inside = false;
        return done;
    };
    if (B >= num_threads) {
        for_each(B, num_threads, [&](int b) {
            float* table = tables + b * rows * azimuths;
            if (!fill(b)) return;
            polar.scan_columns(table, 0, azimuths);
            polar.widen_rows(table, 0, rows);
        });
        return is_inside;
    }
    const int64_t blocks = 4 * num_threads;
    for (int64_t b = 0; b < B && fill(b); b++) {
        float* table = tables + b * rows * azimuths;
        for_each(blocks, num_threads, [&](int k) {
            polar.scan_columns(table, k * azimuths / blocks, (k + 1) * azimuths / blocks);
        });
        for_each(blocks, num_threads, [&](int k) {
            polar.widen_rows(table, k * rows / blocks, (k + 1) * rows / blocks);
        });
    }
    return is_inside;
}
