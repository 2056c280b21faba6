// The height update on a GPU: stages/fusion/fuse.py, a thread for each cell, its points gathered beforehand.
//
// B environments with M points each, of S sensors, and with C cells each.

#include "cell.h"
#include "threads.h"

// The points of all environments, those of a cell one after the other.
struct Sorted {
    const Point* points;       // of all cells
    const int32_t *ends, *counts;  // (B, C) where a cell's points end, and how many they are

    Points of(int64_t cell) const {
        const Point* end = points + ends[cell];
        return {end - counts[cell], end, float(counts[cell])};
    }
};

// Count the points of each cell, and number them.
extern "C" __global__ void count_points(const uint8_t* used, const int64_t* slots, int32_t* counts, int32_t* numbers,
                                        int64_t M, int64_t C) {
    const Place at = place(M);
    const int64_t k = at.row * M + at.k;
    if (at.k < M && used[k]) numbers[k] = atomicAdd(&counts[at.row * C + slots[k]], 1);
}

// Put each point beside those of its cell.
extern "C" __global__ void sort_points(const float* points, const float* noise, const float* shared,
                                       const float* origins, const uint8_t* used, const int64_t* slots,
                                       const int32_t* numbers, Sorted sorted, Point* result, int64_t M, int64_t S,
                                       int64_t C, Settings s) {
    const Place at = place(M);
    const int64_t k = at.row * M + at.k;
    if (at.k >= M || !used[k]) return;
    const int64_t cell = at.row * C + slots[k], sensor = at.row * S + at.k * S / M;
    const int32_t start = sorted.ends[cell] - sorted.counts[cell];
    result[start + numbers[k]] =
        make_point(points + 3 * k, origins + 3 * sensor, noise[k], shared ? shared[k] : 0.0f, s);
}

// Average the points of each cell: (B, C) [m], NO_HEIGHT without points.
extern "C" __global__ void average_points(Sorted sorted, float* in_scan, int64_t C) {
    const Place at = place(C);
    if (at.k >= C) return;
    const int64_t cell = at.row * C + at.k;
    in_scan[cell] = sorted.counts[cell] ? mean_height(sorted.of(cell)) : NO_HEIGHT;
}

// What all cells hold after the update, (B, C) each, and what became of the points, (B,) each.
struct Results {
    float *elevation, *variance, *support, *challenger;
    uint8_t *challenger_support, *known;
    float* time;
    int64_t *used, *ignored;

    void set(int64_t cell, const Cell& after) const {
        elevation[cell] = after.elevation, variance[cell] = after.variance, support[cell] = after.support;
        challenger[cell] = after.challenger, challenger_support[cell] = after.challenger_support;
        known[cell] = after.known, time[cell] = after.time;
    }
};

// A cell without points.
inline Cell untouched(const Map& map, int64_t slot, const Settings& s) {
    Cell cell{};
    cell.elevation = map.elevation[slot], cell.support = map.support[slot], cell.time = map.time[slot];
    cell.challenger = map.challenger[slot], cell.challenger_support = map.challenger_support[slot];
    cell.known = map.known[slot];
    cell.variance = cell.known ? std::min(map.variance[slot], s.max_variance) : 1.0f;
    return cell;
}

// Update all cells.
extern "C" __global__ void update_cells(Sorted sorted, const float* in_scan, Map map, Results results, int64_t rows,
                                        int64_t columns, Settings s) {
    const int64_t C = rows * columns;
    const Place at = place(C);
    int32_t used = 0, ignored = 0;
    if (at.k < C) {
        const int64_t cell = at.row * C + at.k;
        const Map own = map.from(at.row * C);
        Cell after;
        if (sorted.counts[cell]) {
            const Points points = sorted.of(cell);
            const Around around{rows, columns, own.elevation, in_scan + at.row * C, own.known};
            after = update_cell(points, own, at.k, find_consensus(points, own, at.k, s), around, s);
        } else {
            after = untouched(own, at.k, s);
        }
        results.set(cell, after);
        used = int32_t(after.used), ignored = int32_t(after.ignored);
    }
    add_of_warp(results.used + at.row, used);
    add_of_warp(results.ignored + at.row, ignored);
}
