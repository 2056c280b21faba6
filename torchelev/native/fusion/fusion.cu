// The height update on a GPU: stages/fusion/fuse.py, a thread for each cell, its points gathered beforehand.
//
// B environments with M points each, of S sensors, and with C cells each.

#include "points_of_warp.h"

#include "cell.h"
#include "threads.h"

constexpr int AHEAD = 4;  // points that a thread reads at a time
constexpr int FEW = 8;    // points of a cell up to which one thread takes it, as few cells have more

// The points of all environments, those of a cell one after the other.
struct Sorted {
    const Point* points;           // of all cells
    const int32_t *ends, *counts;  // (B, C) where a cell's points end, and how many they are

    Points of(int64_t cell, int threads) const {
        const Point* end = points + ends[cell];
        return {end - counts[cell], end, float(counts[cell]), threads};
    }
};

// The scan: points (B, 3, M), and what else they need to be made a `Point`.
struct Hits {
    const float *points, *noise, *shared, *origins;
    const uint8_t* used;
    const int64_t* slots;

    // Point k of a row that has M of them, of S sensors.
    Point get(int64_t row, int32_t k, int64_t M, int64_t S, const Settings& s) const {
        const float* x = points + 3 * row * M + k;
        const float xyz[3] = {x[0], x[M], x[2 * M]};
        const int64_t hit = row * M + k, sensor = row * S + k / (int32_t(M) / int32_t(S));
        return make_point(xyz, origins + 3 * sensor, noise[hit], shared ? shared[hit] : 0.0f, s);
    }
};

// Count the points of each cell, and number them.
extern "C" __global__ void count_points(Hits hits, int32_t* counts, int32_t* numbers, int64_t M, int64_t C) {
    const Place at = place(M);
    const int64_t k = at.row * M + at.k;
    if (at.k < M && hits.used[k]) numbers[k] = atomicAdd(&counts[at.row * C + hits.slots[k]], 1);
}

// Put each point beside those of its cell.
extern "C" __global__ void sort_points(Hits hits, const int32_t* numbers, Sorted sorted, Point* result, int64_t M,
                                       int64_t S, int64_t C, Settings s) {
    const Place at = place(M);
    const int64_t k = at.row * M + at.k;
    if (at.k >= M || !hits.used[k]) return;
    const int64_t cell = at.row * C + hits.slots[k];
    const int32_t start = sorted.ends[cell] - sorted.counts[cell];
    result[start + numbers[k]] = hits.get(at.row, int32_t(at.k), M, S, s);
}

// Average the points of each cell: (B, C) [m], NO_HEIGHT without points.
extern "C" __global__ void average_points(Sorted sorted, float* in_scan, int64_t C) {
    const Place at = place(C);
    if (at.k >= C) return;
    const int64_t cell = at.row * C + at.k;
    in_scan[cell] = sorted.counts[cell] ? mean_height(sorted.of(cell, 1)) : NO_HEIGHT;
}

// Call `use(k, slot)` for this thread's share of the used points of a row, which has M points and begins at `hit`.
template <class Use> inline void each_hit(const Hits& hits, int64_t hit, int32_t M, const Use& use) {
    const int32_t step = blockDim.x;
    for (int32_t first = threadIdx.x; first < M; first += AHEAD * step) {
        int32_t slots[AHEAD];
#pragma unroll
        for (int e = 0; e < AHEAD; e++) {
            const int32_t k = first + e * step;
            slots[e] = k < M && hits.used[hit + k] ? int32_t(hits.slots[hit + k]) : -1;
        }
#pragma unroll
        for (int e = 0; e < AHEAD; e++)
            if (slots[e] >= 0) use(first + e * step, slots[e]);
    }
}

// Count, sort and average the points of maps whose counts fit into a block's own memory. A block for each map.
extern "C" __global__ __launch_bounds__(512, 3) void sort_in_block(Hits hits, int32_t* counts, int32_t* ends,
                                                                   Point* result, float* in_scan, int64_t M, int64_t S,
                                                                   int64_t C, Settings s) {
    const int64_t row = blockIdx.x, hit = row * M, cell = row * C;
    const int32_t first = threadIdx.x, step = blockDim.x, share = (int32_t(C) + step - 1) / step;
    const int32_t own = std::min(first * share, int32_t(C)), own_end = std::min(own + share, int32_t(C));
    int32_t *next = block_memory(), *sums = next + C;  // (C,) where a cell's next point goes; (step,)
    for (int32_t k = first; k < C; k += step) next[k] = 0;
    __syncthreads();
    each_hit(hits, hit, int32_t(M), [&](int32_t, int32_t slot) { atomicAdd(&next[slot], 1); });
    __syncthreads();
    int32_t before = 0;
    for (int32_t k = own; k < own_end; k++) before += next[k];
    before = sum_before(before, sums);
    for (int32_t k = own; k < own_end; k++) {
        const int32_t count = next[k];
        next[k] = before, before += count;
    }
    __syncthreads();
    each_hit(hits, hit, int32_t(M), [&](int32_t k, int32_t slot) {
        result[hit + atomicAdd(&next[slot], 1)] = hits.get(row, k, M, S, s);
    });
    __syncthreads();
    for (int32_t k = first; k < C; k += step) {  // `next` is now where each cell's points end
        const int32_t begin = k ? next[k - 1] : 0, end = next[k];
        const Points points{result + hit + begin, result + hit + end, float(end - begin), 1};
        counts[cell + k] = end - begin, ends[cell + k] = int32_t(hit) + end;
        in_scan[cell + k] = begin < end ? mean_height(points) : NO_HEIGHT;
    }
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

// Maps before the update, and the scan.
struct Scan {
    Sorted sorted;
    const float* in_scan;  // (B, C) [m]
    Map map;
    int64_t rows, columns;

    Cell update(int64_t row, int64_t slot, const Points& points, const Settings& s) const {
        const int64_t first = row * rows * columns;
        const Map own = map.from(first);
        const Around around{rows, columns, own.elevation, in_scan + first, own.known};
        return update_cell(points, own, slot, find_consensus(points, own, slot, s), around, s);
    }
};

// The cells with more points than a thread takes.
struct Heavy {
    int32_t *cells, *number;
};

// Update all cells but the heavy ones, and list those.
extern "C" __global__ void update_cells(Sorted sorted, const float* in_scan, Map map, Results results, Heavy heavy,
                                        int64_t rows, int64_t columns, Settings s) {
    const Place at = place(rows * columns);
    const Scan scan{sorted, in_scan, map, rows, columns};
    int32_t used = 0, ignored = 0;
    if (at.k < rows * columns) {
        const int64_t cell = at.row * rows * columns + at.k;
        const int32_t count = sorted.counts[cell];
        if (count > FEW) {
            heavy.cells[atomicAdd(heavy.number, 1)] = int32_t(cell);
        } else {
            const Cell after = count ? scan.update(at.row, at.k, sorted.of(cell, 1), s) : untouched(map, cell, s);
            results.set(cell, after);
            used = int32_t(after.used), ignored = int32_t(after.ignored);
        }
    }
    add_of_warp(results.used + at.row, used);
    add_of_warp(results.ignored + at.row, ignored);
}

// Update the heavy cells, a team of `team` threads for each. The first of them writes, while others may still read what
// they need no more.
extern "C" __global__ void update_heavy_cells(Sorted sorted, const float* in_scan, Map map, Results results,
                                              Heavy heavy, int64_t rows, int64_t columns, Settings s, int64_t threads,
                                              int64_t team) {
    const Scan scan{sorted, in_scan, map, rows, columns};
    const int32_t C = int32_t(rows * columns), number = *heavy.number, size = std::min(int32_t(team), warpSize);
    for (int32_t k = int32_t(place(threads).k) / size; k < number; k += int32_t(threads) / size) {
        const int32_t cell = heavy.cells[k], row = cell / C;
        const Cell after = scan.update(row, cell % C, sorted.of(cell, size), s);
        if (threadIdx.x % size) continue;
        results.set(cell, after);
        atomicAdd(reinterpret_cast<unsigned long long*>(results.used + row), after.used);
        atomicAdd(reinterpret_cast<unsigned long long*>(results.ignored + row), after.ignored);
    }
}
