// The height update: stages/fusion/fuse.py, cell by cell, its points gathered beforehand.

#include <memory>
#include <vector>

#include "kernels/simd.h"
#include "kernels/threads.h"
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
    std::vector<Cell> after;           // what each cell holds after the update

    void clear() { cells.clear(), starts.clear(); }
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

// The layers of B environments, which the update changes, and what became of the points, (B,) each.
struct Layers {
    float *elevation, *variance, *support, *challenger;
    uint8_t *challenger_support, *known;
    float* time;
    int64_t *used, *ignored;

    Map from(int64_t cell) const {
        return Map{elevation, variance, support, challenger, challenger_support, known, time}.from(cell);
    }
    void set(int64_t cell, const Cell& after) const {
        elevation[cell] = after.elevation, variance[cell] = after.variance, support[cell] = after.support;
        challenger[cell] = after.challenger, time[cell] = after.time;
        challenger_support[cell] = after.challenger_support, known[cell] = after.known;
    }
    // Limit the variance of known cells; that of others is 1.
    void limit_variance(int64_t first, int64_t last, float limit) const {
        auto limit_some = [&](auto count) {
            const Lanes limited = smaller(load(variance + first, count), all(limit));
            store(variance + first, pick(load_bytes(known + first, count) > 0, limited, all(1)), count);
        };
        for (; first + LANES <= last; first += LANES) limit_some(std::integral_constant<int, LANES>());
        limit_some(int(last - first));
    }
};

// The maps of B environments, and their scan.
struct Maps {
    Layers layers;
    int64_t rows, columns;
    Scan scan;
    const Settings& s;

    Map of(int64_t b) const { return layers.from(b * rows * columns); }

    // Sort the points of environment b, and compare each cell's with its elevation; `means` [m] of the scan's cells.
    void prepare(int64_t b, Sorted& sorted, float* means, int num_threads) const {
        const int64_t num_cells = rows * columns;
        sorted.clear();
        const int64_t parts = num_cells <= CELLS_PER_POINT * scan.number ? num_threads : 1;
        sort_points(sorted, b, scan, num_cells, {parts, num_threads}, s);
        const Parts all{num_threads > 1 ? PARTS_PER_THREAD * num_threads : 1, num_threads};
        all(num_cells, [&](int64_t, int64_t first, int64_t last) {
            std::fill(means + first, means + last, NO_HEIGHT);
        });
        sorted.consensus.resize(sorted.cells.size());
        all(sorted.cells.size(), [&](int64_t, int64_t first, int64_t last) {
            for (int64_t k = first; k < last; k++) {
                sorted.consensus[k] = find_consensus(sorted.points(k), of(b), sorted.cells[k], s);
                means[sorted.cells[k]] = sorted.consensus[k].mean;
            }
        });
    }

    // Update the cells of environment b. None changes before all have looked at their neighbours.
    void update(int64_t b, Sorted& sorted, const float* means, int num_threads) const {
        const Map own = of(b);
        const int64_t offset = b * rows * columns;
        const Around around{rows, columns, own.elevation, means, own.known};
        const Parts parts{num_threads > 1 ? PARTS_PER_THREAD * num_threads : 1, num_threads};
        layers.used[b] = layers.ignored[b] = 0;
        sorted.after.resize(sorted.cells.size());
        parts(sorted.cells.size(), [&](int64_t, int64_t first, int64_t last) {
            int64_t used = 0, ignored = 0;
            for (int64_t k = first; k < last; k++) {
                const int64_t slot = sorted.cells[k];
                sorted.after[k] = update_cell(sorted.points(k), own, slot, sorted.consensus[k], around, s);
                used += sorted.after[k].used, ignored += sorted.after[k].ignored;
            }
            __atomic_fetch_add(&layers.used[b], used, __ATOMIC_RELAXED);
            __atomic_fetch_add(&layers.ignored[b], ignored, __ATOMIC_RELAXED);
        });
        parts(sorted.cells.size(), [&](int64_t, int64_t first, int64_t last) {
            for (int64_t k = first; k < last; k++) layers.set(offset + sorted.cells[k], sorted.after[k]);
        });
        parts(rows * columns, [&](int64_t, int64_t first, int64_t last) {
            layers.limit_variance(offset + first, offset + last, s.max_variance);
        });
    }
};

// What a thread keeps of an environment.
struct Scratch {
    Sorted sorted;
    std::unique_ptr<float[]> means;
};

}  // namespace

// Update the cells of layers (B, rows, columns), and count the points used and ignored (B,).
extern "C" int fuse_points(const float* points, const float* noise, const float* shared, const float* origins,
                           const uint8_t* used, const int64_t* slots, float* elevation, float* variance,
                           float* support, float* challenger, uint8_t* challenger_support, uint8_t* known, float* time,
                           int64_t* num_used, int64_t* num_ignored, int64_t B, int64_t M, int64_t S, int64_t rows,
                           int64_t columns, const Settings* settings, int num_threads) {
    const Scan scan{points, noise, shared, origins, used, slots, M, S};
    const Layers layers{elevation, variance, support,  challenger, challenger_support,
                        known,     time,     num_used, num_ignored};
    const Maps maps{layers, rows, columns, scan, *settings};
    auto make = [&] { return Scratch{{}, std::unique_ptr<float[]>(new float[rows * columns])}; };
    auto update = [&](int64_t b, int threads, Scratch& scratch) {
        maps.prepare(b, scratch.sorted, scratch.means.get(), threads);
        maps.update(b, scratch.sorted, scratch.means.get(), threads);
    };
    return code_of([&] { for_environments(B, num_threads, make, update); });
}
