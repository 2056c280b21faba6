// The lowest ray over each cell, and what it says of them: `find_lowest_rays` and `clear_and_bound`.
#pragma once

#include "stages/visibility/table.h"

namespace visibility {

// Memory of all sensors and maps.
struct CellsMemory {
    Buffer<float> y;
};

class Cells {
    static constexpr int TOGETHER = 32;  // vectors that are looked up one after the other, so that memory is read ahead
    const Sensor& sensor;
    const Table& table;
    const VisibilitySettings& s;
    const MapState& map;
    const int64_t height, width;
    const float reach;  // [m] of rays, and a cell to spare for rounding
    const Extent box;   // [m] of rays, and cells to spare: those of the table lie up to two cells beside a ray
    const float* y;     // [m] from the sensor to each column

  public:
    Cells(const Sensor& sensor, const Extent& extent, const Table& table, CellsMemory& memory)
        : sensor(sensor), table(table), s(sensor.s), map(sensor.u.state), height(sensor.u.sizes.H),
          width(sensor.u.sizes.W), reach(float(table.far + 1) * s.resolution), box(extent.widened(3 * s.resolution)) {
        float* places = memory.y.resize(width);
        for (int64_t j = 0; j < width; j++) places[j] = place(1, j);
        y = places;
    }

    // Clear and bound; return how many cells are cleared.
    int64_t apply() const {
        if (table.far == 0) return 0;
        const int64_t first = begin(0, reach, height), rows = end(0, reach, height) - first;
        std::atomic<int64_t> number{0};
        sensor.u.each(rows, std::max(int64_t(1), CELLS_AT_A_TIME / width), [&](int64_t, int64_t begin, int64_t end) {
            int64_t own = 0;
            for (int64_t i = first + begin; i < first + end; i++) own += apply_to_row(i);
            number += own;
        });
        return number;
    }

  private:
    // [m] from the sensor to the centre of a row or a column.
    float place(int axis, int64_t k) const {
        return center_offset(sensor.u, axis, k, s.resolution) - sensor.view.origin[axis];
    }

    // A row or column that lies, by up to two cells, before a place [m] from the sensor.
    int64_t before(int axis, float distance, int64_t size) const {
        const float cell = (sensor.view.start[axis] + distance) / s.resolution;
        return int64_t(std::clamp(cell - 2, 0.0f, float(size)));
    }

    // The first row or column at most so far [m] from the sensor and in the box, and the one after the last.
    int64_t begin(int axis, float distance, int64_t size) const {
        return before(axis, std::max(-distance, box.low[axis]), size);
    }
    int64_t end(int axis, float distance, int64_t size) const {
        return std::min(before(axis, std::min(distance, box.high[axis]), size) + 3, size);
    }

    int64_t apply_to_row(int64_t i) const {
        const float x = place(0, i), square = reach * reach - x * x;
        if (square < 0) return 0;
        const float most = std::sqrt(square);
        const int64_t first = begin(1, most, width), last = end(1, most, width);
        int64_t number = 0;
        for (int64_t j = first; j < last; j += TOGETHER * LANES)
            number += apply_to_columns(i * width, x, j, std::min(last, j + TOGETHER * LANES));
        return number;
    }

    // Where the lowest rays over cells are found.
    struct Found {
        Lanes rho, lowest;
        Places places;
    };

    int64_t apply_to_columns(int64_t row, float x, int64_t first, int64_t last) const {
        Found found[TOGETHER];
        int count = 0, number = 0, next = 0;
        each_vector(first, last, width, [&](int64_t j, auto size) {
            const float beside = std::max(0.0f, std::max(y[j], -y[j + size - 1]));
            const int nearest = int(std::max(std::fabs(x), beside) / s.resolution) - 1;
            found[count++] = find(x, load(y + j, size), nearest);
        });
        for (int k = 0; k < count; k++) found[k].lowest = smaller(found[k].lowest, table.lowest(found[k].places));
        each_vector(first, last, width, [&](int64_t j, auto size) {
            const Found& at = found[next++];
            const Flags is_over = at.lowest < s.no_ray;
            if (!any(is_over)) return;
            const Lanes slope = pick(is_over, at.lowest, splat(0));
            const Lanes height = sensor.view.origin[2] + slope * at.rho;
            number += apply_at({is_over, splat(x), load(y + j, size), at.rho, slope, height}, row + j, size);
        });
        return number;
    }

    // `find_lowest_rays` over cells, none of which lies in a range bin below `nearest`.
    Found find(float x, Lanes ys, int nearest) const {
        const Lanes xs = splat(x), rho = horizontal(xs, ys);
        const Lanes k = smaller(floor_of(rho / s.resolution), splat(float(s.ranges)));
        const Lanes azimuth = azimuth_fraction(xs, ys) * float(s.azimuths);
        int levels = 0;
        while (levels < s.levels && nearest < s.widen[levels]) levels++;
        const Lanes entry = entry_of(k, levels, s);
        const Window<Lanes> window = window_of(k, azimuth, entry, s);
        return {rho, nearest < table.near ? lowest_near(k, window, entry) : splat(s.no_ray), table.places(k, window)};
    }

    // The lowest rays over those cells that lie in rows that are stored whole.
    [[gnu::noinline]] Lanes lowest_near(Lanes k, const Window<Lanes>& window, Lanes entry) const {
        Lanes lowest = splat(s.no_ray);
        const Flags row = integers(k), first = integers(window.first), number = integers(window.further + entry);
        for (int l = 0; l < LANES; l++)
            if (row[l] < table.near) lowest[l] = table.lowest_near(row[l], first[l], number[l]);
        return lowest;
    }

    // Apply rays over cells from place k on; return how many are cleared.
    template <class Count> int apply_at(const RayOverCell<Lanes>& ray, int64_t k, Count count) const {
        Flags known = load_bytes(map.validity + k, count) > 0;
        int number = 0;
        if (any(ray.found & known)) {
            const Flags cleared = gone(ray, k, known, count);
            if (any(cleared)) {
                number = count_set(cleared), known &= ~cleared;
                store_bytes(map.validity + k, -known, count);
            }
        }
        refute_challengers(ray, k, known, count);
        if (any(ray.found & ~known)) bound(ray, k, known, count);
        return number;
    }

    // Eq. 3 and 4, of known cells with a ray over them.
    template <class Count> Flags gone(const RayOverCell<Lanes>& ray, int64_t k, Flags known, Count count) const {
        const Lanes depth = load(map.elevation + k, count) - ray.height, variance = load(map.variance + k, count);
        const Flags may = ray.found & known & passes_below(depth, variance) & is_old(load(map.time + k, count), s);
        if (!any(may)) return may;
        const Lanes gx = load(map.gradient_x + k, count), gy = load(map.gradient_y + k, count);
        return may & is_credible(ray, depth, variance, gx, gy, s);
    }

    template <class Count>
    void refute_challengers(const RayOverCell<Lanes>& ray, int64_t k, Flags known, Count count) const {
        uint64_t words[(LANES + 7) / 8]{};
        std::memcpy(words, map.challenger_support + k, count);
        if (!words[0] && !words[(LANES + 7) / 8 - 1]) return;
        const Flags support = load_bytes(map.challenger_support + k, count);
        const Flags refuted = refutes(ray, load(map.challenger + k, count), s);
        store_bytes(map.challenger_support + k, ~refuted & known & support, count);
    }

    template <class Count> void bound(const RayOverCell<Lanes>& ray, int64_t k, Flags known, Count count) const {
        const Flags bounds = ray.found & ~known, bounded = load_bytes(map.bounded + k, count) > 0;
        const Lanes upper_bound = load(map.upper_bound + k, count);
        const Lanes lower = visibility::lower_upper_bound(ray, bounded, upper_bound);
        store(map.upper_bound + k, pick(bounds, lower, upper_bound), count);
        store_bytes(map.bounded + k, -(bounds | (bounded & ~known)), count);
    }
};

}  // namespace visibility
