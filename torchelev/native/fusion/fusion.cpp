// The height update: stages/fusion/fuse.py, cell by cell, its points gathered beforehand.

#include <memory>
#include <vector>

#include "../threads.h"
#include "cell.h"

namespace {

// The scan of B environments with M points each, of S sensors.
struct Scan {
    const float *points, *noise, *shared, *origins;  // (B, M, 3) [m], (B, M) [m^2] or null, (B, S, 3) [m]
    const uint8_t* used;                             // (B, M)
    const int64_t* slots;                            // (B, M)
    int64_t number, sensors;                         // M, S
};

// Points of cells [first, last) of one environment, those of a cell one after the other.
struct Band {
    int64_t environment, first, last;
    std::vector<int64_t> cells, starts;  // slots; where their points start
    std::vector<Consensus> consensus;
    std::unique_ptr<Point[]> sorted;
    int64_t num_used = 0, num_ignored = 0;  // points

    Points points(int64_t k) const {
        return {&sorted[starts[k]], &sorted[starts[k + 1]], float(starts[k + 1] - starts[k])};
    }
};

// Whether a ray passed over the middle of its cell before it hit: `passed_center`.
inline bool passed_center(float x, float y, float ray_x, float ray_y, float resolution) {
    const float from_x = x - (std::floor(x / resolution) + 0.5f) * resolution;
    const float from_y = y - (std::floor(y / resolution) + 0.5f) * resolution;
    return from_x * ray_x + from_y * ray_y > std::fabs(from_x * ray_y - from_y * ray_x);
}

// A point as the update needs it.
inline Point make_point(const float* xyz, const float* origin, float noise, float shared, const Settings& s) {
    const float ray_x = xyz[0] - origin[0], ray_y = xyz[1] - origin[1];
    const bool passed = passed_center(xyz[0], xyz[1], ray_x, ray_y, s.resolution);
    return {xyz[2], noise + square(s.relief) + shared, 1.0f / noise, shared, ray_x, ray_y, passed};
}

// Sort a band's points by cell.
void sort_points(Band& band, const Scan& scan, const Settings& s) {
    const int64_t offset = band.environment * scan.number;
    const int64_t* slots = scan.slots + offset;
    const uint8_t* used = scan.used + offset;
    const uint64_t size = band.last - band.first;
    auto each = [&](int64_t first, int64_t last, const auto& work) {
        for (int64_t i = first; i < last; i++) {
            const uint64_t place = slots[i] - band.first;
            if (used[i] && place < size) work(i, place);
        }
    };
    std::vector<int32_t> next(size, 0);  // number of a cell's points, and then where its next one goes
    each(0, scan.number, [&](int64_t, uint64_t place) { next[place]++; });
    int32_t total = 0;
    for (uint64_t place = 0; place < size; place++) {
        const int32_t number = next[place];
        if (number == 0) continue;
        band.cells.push_back(band.first + place), band.starts.push_back(total);
        next[place] = total;
        total += number;
    }
    band.starts.push_back(total);
    band.sorted.reset(new Point[total]);
    const int64_t per_sensor = scan.number / scan.sensors;
    for (int64_t k = 0; k < scan.sensors; k++) {
        const float* origin = scan.origins + 3 * (band.environment * scan.sensors + k);
        each(k * per_sensor, (k + 1) * per_sensor, [&](int64_t i, uint64_t place) {
            const float* xyz = scan.points + 3 * (offset + i);
            const float noise = scan.noise[offset + i], shared = scan.shared ? scan.shared[offset + i] : 0.0f;
            band.sorted[next[place]++] = make_point(xyz, origin, noise, shared, s);
        });
    }
}

// Divide the cells of one environment into bands of whole rows, with about as many points each.
void add_bands(std::vector<Band>& bands, int64_t environment, int64_t count, const Scan& scan, int64_t rows,
               int64_t columns) {
    std::vector<int64_t> points(rows, 0);
    const int64_t* slots = scan.slots + environment * scan.number;
    for (int64_t i = 0; count > 1 && i < scan.number; i++) points[slots[i] / columns]++;
    int64_t first = 0, passed = 0;
    for (int64_t row = 0; row < rows; row++) {
        passed += points[row];
        const bool is_full = count > 1 && passed > 0 && passed * count >= scan.number;
        if (row + 1 < rows && !is_full) continue;
        Band& band = bands.emplace_back();
        band.environment = environment, band.first = first * columns, band.last = (row + 1) * columns;
        first = row + 1, passed = 0;
    }
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

// The maps of B environments, and the scan's means.
struct Maps {
    Map map;
    int64_t rows, columns;
    float* in_scan;

    Map of(int64_t b) const {
        const int64_t k = b * rows * columns;
        return {map.elevation + k, map.variance + k, map.support + k,           map.challenger + k,
                map.time + k,      map.known + k,    map.challenger_support + k};
    }

    // Sort a band's points, and write their means for other bands to see.
    void prepare(Band& band, const Scan& scan, const Settings& s) const {
        float* means = in_scan + band.environment * rows * columns;
        std::fill(means + band.first, means + band.last, NO_HEIGHT);
        sort_points(band, scan, s);
        for (size_t k = 0; k < band.cells.size(); k++) {
            band.consensus.push_back(find_consensus(band.points(k), of(band.environment), band.cells[k], s));
            means[band.cells[k]] = band.consensus[k].mean;
        }
    }

    // Update a band's cells, the first of which is result `first`; leave the numbers of points in the band.
    void update(Band& band, int64_t first, const Results& results, const Settings& s) const {
        const Map own = of(band.environment);
        const int64_t offset = band.environment * rows * columns;
        const Around around{rows, columns, own.elevation, in_scan + offset, own.known};
        for (size_t k = 0; k < band.cells.size(); k++) {
            const int64_t slot = band.cells[k];
            const Cell cell = update_cell(band.points(k), own, slot, band.consensus[k], around, s);
            results.set(first + k, offset + slot, cell);
            band.num_used += cell.used, band.num_ignored += cell.ignored;
        }
    }
};

}  // namespace

// Update the cells that points fall into; write T, their number.
extern "C" int fuse_points(const float* points, const float* noise, const float* shared, const float* origins,
                           const uint8_t* used, const int64_t* slots, const float* elevation, const float* variance,
                           const float* support, const float* challenger, const uint8_t* challenger_support,
                           const uint8_t* known, const float* time, int64_t* cells, float* elevations,
                           float* variances, float* supports, float* challengers, uint8_t* challenger_supports,
                           uint8_t* knowns, float* times, int64_t* num_used, int64_t* num_ignored, int64_t* count,
                           int64_t B, int64_t M, int64_t S, int64_t rows, int64_t columns, const Settings* settings,
                           int num_threads) {
    const Scan scan{points, noise, shared, origins, used, slots, M, S};
    const Results results{cells, elevations, variances,          supports, challengers,
                          times, challenger_supports, knowns, num_used, num_ignored};
    return code_of([&] {
        for (int64_t i = 0; i < B * M; i++)
            if (uint64_t(slots[i]) >= uint64_t(rows * columns)) throw std::out_of_range("slot");
        const std::unique_ptr<float[]> in_scan(new float[B * rows * columns]);
        const Map map{elevation, variance, support, challenger, time, known, challenger_support};
        const Maps maps{map, rows, columns, in_scan.get()};
        std::vector<Band> bands;
        for (int64_t b = 0; b < B; b++) add_bands(bands, b, B >= num_threads ? 1 : 2 * num_threads, scan, rows, columns);
        for_each(bands.size(), num_threads, [&](int64_t k) { maps.prepare(bands[k], scan, *settings); });
        std::vector<int64_t> firsts{0};
        for (const Band& band : bands) firsts.push_back(firsts.back() + band.cells.size());
        for_each(bands.size(), num_threads,
                 [&](int64_t k) { maps.update(bands[k], firsts[k], results, *settings); });
        std::fill(num_used, num_used + B, 0), std::fill(num_ignored, num_ignored + B, 0);
        for (const Band& band : bands)
            num_used[band.environment] += band.num_used, num_ignored[band.environment] += band.num_ignored;
        *count = firsts.back();
    });
}
