// The height update: stages/fusion/fuse.py, cell by cell, its points gathered beforehand.

#include <memory>
#include <vector>

#include "../threads.h"
#include "points_of_thread.h"
#include "cell.h"

namespace {

constexpr int64_t CELLS_PER_POINT = 4;  // up to which several threads sort the points: each counts in all cells
constexpr int64_t PARTS_PER_THREAD = 4;

// The scan of B environments with M points each, of S sensors.
struct Scan {
    const float *points, *noise, *shared, *origins;  // (B, M, 3) [m], (B, M) [m^2] or null, (B, S, 3) [m]
    const uint8_t* used;                             // (B, M)
    const int64_t* slots;                            // (B, M)
    int64_t number, sensors;                         // M, S
};

// The points of one environment, those of a cell one after the other.
struct Sorted {
    std::vector<int64_t> cells, starts;  // slots that are hit; where their points start
    std::unique_ptr<Point[]> sorted;
    std::vector<Consensus> consensus;  // of each cell

    Points points(int64_t k) const {
        return {&sorted[starts[k]], &sorted[starts[k + 1]], float(starts[k + 1] - starts[k])};
    }
};

// Sort the points of environment b by cell: count, add up, and put each where its turn is. `parts` are of its points.
void sort_points(Sorted& result, int64_t b, const Scan& scan, int64_t num_cells, const Parts& parts,
                 const Settings& s) {
    const int64_t per_sensor = scan.number / scan.sensors;
    const uint8_t* used = scan.used + b * scan.number;
    const int64_t* slots = scan.slots + b * scan.number;
    std::vector<int32_t> counts(parts.number * num_cells, 0);
    parts(scan.number, [&](int64_t part, int64_t first, int64_t last) {
        int32_t* count = &counts[part * num_cells];
        for (int64_t i = first; i < last; i++) count[checked(slots[i], num_cells)] += used[i];
    });
    int64_t total = 0;
    for (int64_t slot = 0; slot < num_cells; slot++) {
        const int64_t start = total;
        for (int64_t k = 0; k < parts.number; k++) {  // turn numbers into where the first point of the part goes
            int32_t& count = counts[k * num_cells + slot];
            const int32_t number = count;
            count = int32_t(total);
            total += number;
        }
        if (total > start) result.cells.push_back(slot), result.starts.push_back(start);
    }
    result.starts.push_back(total);
    result.sorted.reset(new Point[total]);
    parts(scan.number, [&](int64_t part, int64_t first, int64_t last) {
        int32_t* next = &counts[part * num_cells];
        for (int64_t i = first; i < last; i++) {
            if (!used[i]) continue;
            const int64_t k = b * scan.number + i;
            const float* origin = scan.origins + 3 * (b * scan.sensors + (scan.sensors > 1 ? i / per_sensor : 0));
            const float shared = scan.shared ? scan.shared[k] : 0.0f;
            result.sorted[next[slots[i]]++] = make_point(scan.points + 3 * k, origin, scan.noise[k], shared, s);
        }
    });
}

// What the cells that are hit hold after the update, (T,) each, and what became of the points, (B,) each.
struct Results {
    int64_t* cells;
    float *elevation, *variance, *support, *challenger, *time;
    uint8_t *challenger_support, *known;
    int64_t *used, *ignored;

    void set(int64_t k, int64_t cell, const Cell& after) const {
        cells[k] = cell;
        elevation[k] = after.elevation, variance[k] = after.variance, support[k] = after.support;
        challenger[k] = after.challenger, time[k] = after.time;
        challenger_support[k] = after.challenger_support, known[k] = after.known;
    }
};

// The maps of B environments, and their scan.
struct Maps {
    Map map;
    int64_t rows, columns;
    Scan scan;
    float* in_scan;  // [m] the scan's mean in each cell
    const Settings& s;

    Map of(int64_t b) const { return map.from(b * rows * columns); }

    // Sort the points of environment b, and compare each cell's with its elevation.
    void prepare(int64_t b, Sorted& sorted, int num_threads) const {
        const int64_t num_cells = rows * columns;
        float* means = in_scan + b * num_cells;
        const int64_t parts = num_cells <= CELLS_PER_POINT * scan.number ? num_threads : 1;
        sort_points(sorted, b, scan, num_cells, {parts, num_threads}, s);
        const Parts all{num_threads > 1 ? PARTS_PER_THREAD * num_threads : 1, num_threads};
        all(num_cells, [&](int64_t, int64_t first, int64_t last) { std::fill(means + first, means + last, NO_HEIGHT); });
        sorted.consensus.resize(sorted.cells.size());
        all(sorted.cells.size(), [&](int64_t, int64_t first, int64_t last) {
            for (int64_t k = first; k < last; k++) {
                sorted.consensus[k] = find_consensus(sorted.points(k), of(b), sorted.cells[k], s);
                means[sorted.cells[k]] = sorted.consensus[k].mean;
            }
        });
    }

    // Update the cells of environment b, the first of which is result `start`.
    void update(int64_t b, const Sorted& sorted, int64_t start, const Results& results, int num_threads) const {
        const Map own = of(b);
        const int64_t offset = b * rows * columns;
        const Around around{rows, columns, own.elevation, in_scan + offset, own.known};
        const Parts parts{num_threads > 1 ? PARTS_PER_THREAD * num_threads : 1, num_threads};
        parts(sorted.cells.size(), [&](int64_t, int64_t first, int64_t last) {
            int64_t used = 0, ignored = 0;
            for (int64_t k = first; k < last; k++) {
                const int64_t slot = sorted.cells[k];
                const Cell cell = update_cell(sorted.points(k), own, slot, sorted.consensus[k], around, s);
                results.set(start + k, offset + slot, cell);
                used += cell.used, ignored += cell.ignored;
            }
            __atomic_fetch_add(&results.used[b], used, __ATOMIC_RELAXED);
            __atomic_fetch_add(&results.ignored[b], ignored, __ATOMIC_RELAXED);
        });
    }
};

}  // namespace

// Update the cells that points fall into; write their number.
extern "C" int fuse_points(const float* points, const float* noise, const float* shared, const float* origins,
                           const uint8_t* used, const int64_t* slots, const float* elevation, const float* variance,
                           const float* support, const float* challenger, const uint8_t* challenger_support,
                           const uint8_t* known, const float* time, int64_t* cells, float* elevations,
                           float* variances, float* supports, float* challengers, uint8_t* challenger_supports,
                           uint8_t* knowns, float* times, int64_t* num_used, int64_t* num_ignored, int64_t* count,
                           int64_t B, int64_t M, int64_t S, int64_t rows, int64_t columns, const Settings* settings,
                           int num_threads) {
    const Scan scan{points, noise, shared, origins, used, slots, M, S};
    const Map map{elevation, variance, support, challenger, challenger_support, known, time};
    const Results results{cells, elevations, variances,          supports, challengers,
                          times, challenger_supports, knowns, num_used, num_ignored};
    return code_of([&] {
        const std::unique_ptr<float[]> in_scan(new float[B * rows * columns]);
        const Maps maps{map, rows, columns, scan, in_scan.get(), *settings};
        std::vector<Sorted> sorted(B);
        for_environments(B, num_threads, [&](int64_t b, int threads) { maps.prepare(b, sorted[b], threads); });
        std::vector<int64_t> starts{0};
        for (const Sorted& each : sorted) starts.push_back(starts.back() + each.cells.size());
        std::fill(num_used, num_used + B, 0), std::fill(num_ignored, num_ignored + B, 0);
        for_environments(B, num_threads, [&](int64_t b, int threads) {
            maps.update(b, sorted[b], starts[b], results, threads);
        });
        *count = starts.back();
    });
}
