// Merging surfaces that meet, clearing those that rays passed through, and noting what space is free.
#pragma once

#include "levels/kernel/sorting.h"

namespace levels {

struct Tidying : Sorting {
    using Sorting::Sorting;

    void note_space() {
        parts(H, [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t i = begin; i < end; i++) {
                for_stretches(i, [&](int64_t j, int64_t p, int64_t number) {
                    note_open(i * W + j, &is_open(p), number);
                    raise_free_top(i, j, &free_top(p), number);
                });
            }
        });
    }

    void tidy() {
        own.candidates.reserve(cells), own.candidates.assign(own.old.begin(), own.old.end());
        for (const int32_t c : own.complex)
            if (!own.had_levels[c]) own.candidates.push_back(c);
        std::atomic<int64_t> merged{0}, cleared{0};
        own.with_levels.resize(parts.number);
        parts(int64_t(own.candidates.size()), [&](int64_t part, int64_t begin, int64_t end) {
            int64_t of_part[STATISTICS] = {};
            std::vector<int32_t>& found = own.with_levels[part];
            found.clear();
            for (int64_t k = begin; k < end; k++) {
                const int32_t c = own.candidates[k];
                const int64_t p = place(c);
                tidy_cell(c, p, of_part);
                if (has_levels(p)) found.push_back(c);
            }
            merged += of_part[MERGED], cleared += of_part[CLEARED];
        });
        statistics[MERGED] += merged, statistics[CLEARED] += cleared;
    }

  private:
    // Note over which of some cells side by side rays passed close above the ground, and higher by the gap.
    void note_open(int64_t first, uint8_t* __restrict open, int64_t number) const {
        const float *g = ground.elevation + first, *support = ground.support + first;
        const float *high = &own.highest[first], *low = &own.lowest[first];
        const uint8_t* known = ground.validity + first;
        const float gap = s.min_gap, least = s.least_support;
        for (int64_t n = 0; n < number; n++)
            open[n] |= known[n] & uint8_t((support[n] >= least) & (low[n] < g[n] + 0.5f * gap) & (high[n] >= g[n] + gap));
    }

    // Raise up to where space is free over cells side by side, from column j of row i.
    void raise_free_top(int64_t i, int64_t j, float* top, int64_t number) const {
        const float step = RISE * float(s.resolution), *high = &own.highest[i * W + j];
        for (int64_t begin = 0; begin < number; begin += BLOCK) {
            int32_t rising[BLOCK], count = 0;
            for (int64_t n = begin; n < std::min(begin + BLOCK, number); n++)
                rising[count] = int32_t(n), count += high[n] > top[n] + step;
            for (int32_t k = 0; k < count; k++) raise_free_top(i, j + rising[k], top[rising[k]]);
        }
    }

    void raise_free_top(int64_t i, int64_t j, float& top) const {
        const int64_t c = i * W + j;
        const float low = own.number[c] ? std::min(own.bottom[c], own.lowest[c]) : own.lowest[c];
        const float floor = ground.validity[c] ? ground.elevation[c] : low;
        if (!(own.highest[c] > floor + RISE * float(s.resolution))) return;
        for (const Sight& sight : sights)
            top = sight.raise_free_top(top, floor, own.x[i], own.y[j], s.min_gap, sights.size);
    }

    void tidy_cell(int32_t c, int64_t p, int64_t* numbers) const {
        const Cell cell = cell_at(p);
        numbers[MERGED] += cell.merge();
        const float g = ground.elevation[c];
        for (int64_t l = 0; l < L; l++) {
            const int64_t q = l * cells;
            if (!(cell.support[q] > 0)) continue;
            if (ground.validity[c] && distance(cell.lower[q], cell.upper[q], g, g) < 0.5f * s.min_gap) {
                cell.remove(l), numbers[MERGED]++;
            } else if (cell.time[q] > s.min_time) {
                for (const Sight& sight : sights)
                    if (sight.passes(x_of(c), y_of(c), cell.lower[q], cell.upper[q], cell.variance[q], sights.size)) {
                        cell.remove(l), numbers[CLEARED]++;
                        break;
                    }
            }
        }
    }
};

}  // namespace levels
