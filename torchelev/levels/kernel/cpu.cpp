// The levels of a map in an update: step.py.

#include "levels/kernel/choice.h"

namespace {

using levels::Cell;

struct MapUpdate : levels::Choice {
    using Choice::Choice;

    void run() {
        follow();
        find_points();
        look();
        sort_points();
        note_space();
        tidy();
        if (measured.moves) choose();
        put_aside();
        std::copy_n(statistics, levels::STATISTICS, u.levels.numbers);
    }

    struct Range {
        int64_t begin, end;
    };
    // Which rows or columns of a window were in it before.
    static Range staying(int64_t now, int64_t before, int64_t size) {
        const int64_t shift = std::clamp(before - now, -size, size);
        return {std::max<int64_t>(shift, 0), std::min(shift + size, size)};
    }

    // Move to the window of the map, and age: `move`, `age`.
    void follow() {
        const int64_t* const now = ground.corner;
        int64_t* const before = u.levels.corner;
        row.resize(H), column.resize(W);
        for (int64_t i = 0; i < H; i++) row[i] = int32_t(ring(now[0] + i, H) * W);
        for (int64_t j = 0; j < W; j++) column[j] = int32_t(ring(now[1] + j, W));
        const Range rows = staying(now[0], before[0], H), columns = staying(now[1], before[1], W);
        for (int64_t i = 0; i < H; i++) {
            const bool stays = i >= rows.begin && i < rows.end;
            for (int64_t j = 0; j < (stays ? columns.begin : W); j++) blank(row[i] + column[j]);
            for (int64_t j = columns.end; stays && j < W; j++) blank(row[i] + column[j]);
        }
        for (int axis = 0; axis < 2; axis++) before[axis] = now[axis];
        find_old();
    }

    // List the cells with levels, and age these: `age`.
    void find_old() {
        own.had_levels.assign(cells, 0), own.old.clear(), own.old.reserve(cells);
        for_levels([&](int64_t p) {
            const int32_t c = cell_of(int32_t(p));
            own.had_levels[c] = 1, own.old.push_back(c), fetch(cell_at(p));
        });
        for (const int32_t c : own.old) grow_older(cell_at(place(c)));
    }

    // Ask for the memory of a cell ahead: of many maps, it lies outside the caches.
    void fetch(const Cell& cell) const {
        for (int64_t q = 0; q < L * cells; q += cells)
            for (const float* values : {cell.time, cell.variance, cell.lower, cell.upper}) __builtin_prefetch(values + q, 1);
    }

    void grow_older(const Cell& cell) const {
        for (int64_t q = 0; q < L * cells; q += cells) {
            if (!(cell.support[q] > 0)) continue;
            cell.time[q] += measured.dt;
            cell.variance[q] = std::min(cell.variance[q] + s.variance_rate * measured.dt, s.max_variance);
        }
    }

    // Leave to the stages that follow the points that measure the ground: `set_aside`.
    void put_aside() const {
        const bool chose = statistics[levels::CHOSEN] > 0;
        uint8_t* const used = measured.used.data();
        int64_t number = 0;
        for (int64_t m = 0; m < M; m++) {
            const int32_t c = own.points.cell[m];
            const bool is_aside = own.is_aside[m] || (chose && c >= 0 && own.changed[c]);
            number += used[m] & is_aside, used[m] &= !is_aside;
        }
        measured.counts.used -= number;
    }

    // Raise all surfaces as drift compensation raised the ground: `raise_surfaces`.
    void raise(float height) const {
        for_levels([&](int64_t p) {
            const Cell cell = cell_at(p);
            for (int64_t q = 0; q < L * cells; q += cells)
                if (cell.support[q] > 0) cell.lower[q] += height, cell.upper[q] += height;
        });
        float* const free_top = u.levels.free_top;
        for (int64_t p = 0; p < cells; p++) free_top[p] += height;
    }
};

}  // namespace

extern "C" void run_sort_levels(Update& u) { MapUpdate(u).run(); }

extern "C" void run_raise_levels(Update& u) {
    const float height = *u.state.statistics.drift_correction;
    if (u.settings.compensate.has_drift && height != 0) MapUpdate(u).raise(height);
}
