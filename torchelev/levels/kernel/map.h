// The levels of a map in an update, and where they are.
#pragma once

#include "kernels/threads.h"
#include "levels/kernel/ground.h"
#include "levels/kernel/rays.h"
#include "levels/kernel/surfaces.h"
#include "levels/kernel/update.h"

namespace levels {

using places::TINY;
constexpr int64_t BLOCK = 64;  // points or cells that are looked at together

// What a scan will found the ground of a cell with, where that is not known.
struct Waiting {
    float height, number;  // [m], of points; 0: nothing
};

struct Cluster;  // of sorting.h

// Memory of a thread, kept between updates.
struct Scratch {
    Points points;
    std::vector<Sight> sights;
    std::vector<float> x, y, highest, lowest;  // centres of the cells [m], rays over them [m]
    std::vector<float> bottom, top;            // (H W) [m] of the scan's points
    std::vector<int32_t> number, list;         // (H W) of the scan's points; place in `complex`, -1 for none
    std::vector<uint8_t> all_above, changed;   // (H W)
    std::vector<uint8_t> had_levels;           // (H W) of the ring, before the scan
    std::vector<uint8_t> simple;               // of `touched`
    std::vector<int32_t> touched, complex, first, next, sorted;
    std::vector<int32_t> row, column;          // places of the window's cells in the ring
    std::vector<Waiting> waiting;              // of `complex`
    std::vector<std::vector<int32_t>> with_levels;  // cells, of each part of the window
    std::vector<std::vector<Cluster>> clusters;    // of a cell, for each part of the window
    Search search;
};

// The levels of one map in an update.
struct Map {
    const Update& u;
    int64_t b;
    Parts parts;
    Scratch& own;
    int64_t cells, M;
    float g2;  // [m^2] what the disagreement of scans adds to the variance of the ground
    Sights sights;
    float base[3] = {};
    bool has_base = false;
    std::vector<int32_t>& row = own.row;
    std::vector<int32_t>& column = own.column;
    int64_t statistics[STATISTICS] = {};

    Map(const Update& u, int64_t b, int num_threads, Scratch& own)
        : u(u), b(b), parts{num_threads, num_threads}, own(own), cells(u.H * u.W), M(u.S * u.N),
          g2(u.disagreement[b] * u.disagreement[b]), sights{SightGrid(u), own.sights, u.min_gap} {}

    static int64_t ring(int64_t k, int64_t size) { return ((k % size) + size) % size; }
    int64_t place(int64_t c) const { return row[int32_t(c) / int32_t(u.W)] + column[int32_t(c) % int32_t(u.W)]; }

    Cell cell_at(int64_t p) const {
        const int64_t first = b * u.L * cells + p;
        return {u.lower + first, u.upper + first, u.level_variance + first, u.support + first, u.time + first, u.L, cells};
    }
    float& free_top(int64_t p) const { return u.free_top[b * cells + p]; }
    uint8_t& is_open(int64_t p) const { return u.is_open[b * cells + p]; }
    void forget_space(int64_t p) const { free_top(p) = -INFINITE, is_open(p) = 0; }

    // Call `work(j, p, number)` for the two stretches of a row whose cells lie side by side in the ring, too: from column
    // j of the window and place p.
    template <class Work> void for_stretches(int64_t i, const Work& work) const {
        const int64_t first = column[0], number = u.W - first;
        work(int64_t(0), row[i] + first, number);
        if (first > 0) work(number, int64_t(row[i]), first);
    }

    void blank(int64_t p) const {
        for (int64_t l = 0; l < u.L; l++) cell_at(p).remove(l);
        forget_space(p);
    }

    // Whether any of some places side by side in the ring has levels.
    bool any_levels(int64_t p, int64_t number) const {
        int32_t any = 0;
        for (int64_t l = 0; l < u.L; l++) {
            const float* support = u.support + (b * u.L + l) * cells + p;
            for (int64_t n = 0; n < number; n++) any |= support[n] > 0;
        }
        return any;
    }
    bool has_levels(int64_t p) const { return any_levels(p, 1); }

    // Whether rays passed below a surface at height `top` over a cell: it hangs free.
    bool floats(int64_t c, float top) const {
        if (!(own.lowest[c] < top - HEIGHTS[0] * u.min_gap)) return false;  // mostly
        return sights.are_free_below(own.x[c / u.W], own.y[c % u.W], top);
    }

    // The ground as a surface: `as_found`.
    Found ground_of(int64_t c) const {
        const int64_t n = b * cells + c;
        const float g = u.elevation[n], variance = std::max(u.ground_variance[n] - g2, u.variance_floor);
        return {g, g, g, variance, variance, std::max(u.ground_support[n], u.min_support)};
    }

    // Make a level the ground of a cell that has none.
    void found_ground(int64_t c, int64_t l) const {
        const int64_t n = b * cells + c, p = place(c), q = l * cells;
        const Cell cell = cell_at(p);
        u.elevation[n] = cell.upper[q], u.ground_variance[n] = cell.variance[q] + g2;
        u.ground_support[n] = cell.support[q], u.ground_time[n] = cell.time[q];
        u.validity[n] = 1, u.bounded[n] = 0, u.challenger_support[n] = 0;
        cell.remove(l);
    }

    void forget_ground(int64_t c) const { u.validity[b * cells + c] = 0, u.challenger_support[b * cells + c] = 0; }
};

}  // namespace levels
