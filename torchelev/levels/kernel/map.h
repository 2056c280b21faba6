// The levels of a map in an update, and where they are.
#pragma once

#include "kernels/update.h"
#include "levels/kernel/ground.h"
#include "levels/kernel/rays.h"
#include "levels/kernel/surfaces.h"

namespace levels {

constexpr int64_t BLOCK = 64;  // points or cells that are looked at together

enum Statistic { OPENED, CLEARED, MERGED, DROPPED, CHOSEN, STATISTICS };

// What a scan will found the ground of a cell with, where that is not known.
struct Waiting {
    float height, number;  // [m], of points; 0: nothing
};

struct Cluster;  // of sorting.h

// Memory of a thread, kept between updates.
struct Scratch {
    Points points;
    std::vector<Sight> sights;                 // of at least as many sensors
    std::vector<float> x, y, highest, lowest;  // centres of the cells [m], rays over them [m]
    std::vector<float> bottom, top;            // (H W) [m] of the scan's points
    std::vector<int32_t> number, list;         // (H W) of the scan's points; place in `complex`, -1 for none
    std::vector<uint8_t> all_above, changed;   // (H W)
    std::vector<uint8_t> had_levels;           // (H W) before the scan
    std::vector<uint8_t> simple;               // of `touched`
    std::vector<uint8_t> is_aside;             // (M) points that do not measure the ground
    int64_t num_touched;                       // cells in `touched`
    std::vector<int32_t> touched, complex, first, next, sorted;
    std::vector<int32_t> old, candidates;      // cells that had levels, and those that may have some
    std::vector<int32_t> row, column;          // places of the window's cells in the ring
    std::vector<Waiting> waiting;              // of `complex`
    std::vector<std::vector<int32_t>> with_levels;  // cells, of each part of `candidates`
    std::vector<std::vector<Cluster>> clusters;    // of a cell, for each part of `complex`
    Search search;
};

// The levels of one map in an update.
struct Map {
    Update& u;
    const LevelsSettings& s;
    MapState& ground;
    Measurement& measured;
    Scratch& own;
    int64_t H, W, L, S, N, M, cells;
    Parts parts;
    float g2;  // [m^2] what the disagreement of scans adds to the variance of the ground
    Sights sights;
    std::vector<int32_t>& row = own.row;
    std::vector<int32_t>& column = own.column;
    int64_t statistics[STATISTICS] = {};

    explicit Map(Update& u)
        : u(u), s(u.settings.levels), ground(u.state), measured(u.measurement), own(u.memory.get<Scratch>()),
          H(u.sizes.H), W(u.sizes.W), L(u.sizes.L), S(u.sizes.S), N(u.sizes.N), M(measured.number), cells(u.cells()),
          parts{u.threads, u.threads}, g2(*ground.statistics.disagreement * *ground.statistics.disagreement),
          sights{SightGrid(s), own.sights, size_t(S), s.min_gap} {}

    static int64_t ring(int64_t k, int64_t size) { return ((k % size) + size) % size; }
    int64_t place(int64_t c) const { return row[int32_t(c) / int32_t(W)] + column[int32_t(c) % int32_t(W)]; }
    // The cell of a place, the inverse of `place`.
    int32_t cell_of(int32_t p) const {
        const int32_t rows = int32_t(H), columns = int32_t(W);
        const int32_t i = p / columns - row[0] / columns, j = p % columns - column[0];
        return (i < 0 ? i + rows : i) * columns + (j < 0 ? j + columns : j);
    }
    float x_of(int64_t c) const { return own.x[int32_t(c) / int32_t(W)]; }  // [m]
    float y_of(int64_t c) const { return own.y[int32_t(c) % int32_t(W)]; }  // [m]

    Cell cell_at(int64_t p) const {
        const StoredLevels& all = u.levels;
        return {all.lower + p, all.upper + p, all.variance + p, all.support + p, all.time + p, L, cells};
    }
    float& free_top(int64_t p) const { return u.levels.free_top[p]; }
    uint8_t& is_open(int64_t p) const { return u.levels.is_open[p]; }
    void forget_space(int64_t p) const { free_top(p) = -INFINITE, is_open(p) = 0; }

    // Call `work(j, p, number)` for the two stretches of a row whose cells lie side by side in the ring, too: from column
    // j of the window and place p.
    template <class Work> void for_stretches(int64_t i, const Work& work) const {
        const int64_t first = column[0], number = W - first;
        work(int64_t(0), row[i] + first, number);
        if (first > 0) work(number, int64_t(row[i]), first);
    }

    void blank(int64_t p) const {
        for (int64_t l = 0; l < L; l++)
            if (cell_at(p).support[l * cells] > 0) cell_at(p).remove(l);
        forget_space(p);
    }

    // Whether any of some places side by side in the ring has levels.
    bool any_levels(int64_t p, int64_t number) const {
        int32_t any = 0;
        for (int64_t l = 0; l < L; l++) {
            const float* support = u.levels.support + l * cells + p;
            for (int64_t n = 0; n < number; n++) any |= support[n] > 0;
        }
        return any;
    }
    bool has_levels(int64_t p) const { return any_levels(p, 1); }

    // Call `work(p)` for the places in the ring that have levels.
    template <class Work> void for_levels(const Work& work) const {
        for (int64_t first = 0; first < cells; first += BLOCK) {
            const int64_t end = std::min(first + BLOCK, cells);
            if (!any_levels(first, end - first)) continue;  // mostly
            for (int64_t p = first; p < end; p++)
                if (has_levels(p)) work(p);
        }
    }

    // Whether rays passed below a surface at height `top` over a cell: it hangs free.
    bool floats(int64_t c, float top) const {
        if (!(own.lowest[c] < top - HEIGHTS[0] * s.min_gap)) return false;  // mostly
        return sights.are_free_below(x_of(c), y_of(c), top);
    }

    // The ground as a surface: `as_found`.
    Found ground_of(int64_t c) const {
        const float g = ground.elevation[c], variance = std::max(ground.variance[c] - g2, s.variance_floor);
        return {g, g, g, variance, variance, std::max(ground.support[c], s.min_support)};
    }

    // Make a level the ground of a cell that has none.
    void found_ground(int64_t c, int64_t l) const {
        const int64_t p = place(c), q = l * cells;
        const Cell cell = cell_at(p);
        ground.elevation[c] = cell.upper[q], ground.variance[c] = cell.variance[q] + g2;
        ground.support[c] = cell.support[q], ground.time[c] = cell.time[q];
        ground.validity[c] = 1, ground.bounded[c] = 0, ground.challenger_support[c] = 0;
        cell.remove(l);
    }

    void forget_ground(int64_t c) const { ground.validity[c] = 0, ground.challenger_support[c] = 0; }
};

}  // namespace levels
