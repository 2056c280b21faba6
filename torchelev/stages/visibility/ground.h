// The ground that a sensor's rays may meet: accepted_rays.py and horizon.py, with the same names.
#pragma once

#include "stages/visibility/minima.h"
#include "stages/visibility/sensor.h"

namespace visibility {

constexpr float UNKNOWN = std::numeric_limits<float>::infinity();

// Memory of all sensors and maps.
struct GroundMemory {
    Buffer<float> below, floor, borders, heights;
};

// The lowest ground of each cell that rays reach, in whole rows of the map.
class Ground {
    const Sensor& sensor;
    const VisibilitySettings& s;
    const MapState& map;
    const int64_t height, width;
    int64_t rows[2], columns[2];  // of the cells that are looked at
    float *below, *floor, *borders;
    bool has_borders;

  public:
    Ground(const Sensor& sensor, const Extent& extent, GroundMemory& memory)
        : sensor(sensor), s(sensor.s), map(sensor.u.state), height(sensor.u.sizes.H), width(sensor.u.sizes.W) {
        place(extent, 0, height, rows), place(extent, 1, width, columns);
        below = memory.below.resize((rows[1] - rows[0]) * width) - rows[0] * width;
        floor = memory.floor.resize((rows[1] - rows[0]) * width) - rows[0] * width;
        look(memory.heights);
        has_borders = leaves(extent, 0) || leaves(extent, 1);
        if (has_borders) look_at_borders(memory.borders);
    }

    // Return how far below the sensor the lowest ground of cells lies [m], NO_FALL where it was not hit recently, and
    // `beyond` outside the window. Cells that no ray reaches may have any value.
    Lanes below_sensor(Lanes i, Lanes j, float beyond) const {
        const Lanes near_i = clamp(i, 0, sensor.view.size[0] - 1), near_j = clamp(j, 0, sensor.view.size[1] - 1);
        const Lanes row = clamp(near_i, float(rows[0]), float(rows[1] - 1));
        const Lanes column = clamp(near_j, float(columns[0]), float(columns[1] - 1));
        const Lanes found = gather(below, integers(row) * int(width) + integers(column));
        return pick((i == near_i) & (j == near_j), found, splat(beyond));
    }

    // Return where the lowest ground at the ends of rays is found.
    Flags place(const RayEnds<Lanes>& end, Flags ends) const {
        const Flags slot = integers(end.i) * int(width) + integers(end.j);
        return pick_int(ends, slot, Flags{} + int(rows[0] * width + columns[0]));
    }

    // Return the lowest ground [m], UNKNOWN where it is not well supported.
    Lanes floor_at(Flags place) const { return gather(floor, place); }

    // Return the lowest ground near the borders that rays leave through [m]: `ground_at_borders`.
    Lanes near(const RayEnds<Lanes>& end, Flags ends) const {
        if (!has_borders) return splat(s.nowhere);
        const float length = float(std::max(height, width));
        return gather(borders, pick_int(ends, integers(end.side * length + end.place), Flags{}));
    }

  private:
    // The cells of an axis that rays, or bins of the horizon beside them, reach, and those NEAR them.
    void place(const Extent& extent, int axis, int64_t size, int64_t* range) const {
        const float cells = 1 / s.resolution;
        const float margin = float(s.near_cells) + 4 + 0.01f * extent.farthest * cells;  // bins are two cells wide
        auto cell = [&](float place) {
            return int64_t(std::clamp((sensor.view.start[axis] + place) * cells, -1e6f, 1e6f));
        };
        range[0] = std::clamp<int64_t>(cell(extent.low[axis]) - int64_t(margin), 0, size - 1);
        range[1] = std::clamp<int64_t>(cell(extent.high[axis]) + int64_t(margin), range[0] + 1, size);
    }

    bool leaves(const Extent& extent, int axis) const {
        const float start = sensor.view.start[axis], size = (axis ? width : height) * s.resolution;
        return start + extent.low[axis] < 0 || start + extent.high[axis] >= size;
    }

    // Look at all cells, row by row; their heights and those of the rows beside them stay in the cache.
    void look(Buffer<float>& memory) const {
        const int64_t room = width + 2 * LANES, parts = 4 * sensor.u.threads;
        float* heights = memory.resize(parts * 3 * room);
        const int64_t least = std::max(int64_t(1), CELLS_AT_A_TIME / width);
        sensor.u.each(rows[1] - rows[0], least, [&](int64_t part, int64_t begin, int64_t end) {
            auto row = [&](int64_t i) { return heights + (3 * part + (i + 3) % 3) * room + LANES; };
            const int64_t first = rows[0] + begin, last = rows[0] + end;
            for (int64_t i = first - 1; i <= first; i++) find_sure_heights(i, row(i));
            for (int64_t i = first; i < last; i++) {
                find_sure_heights(i + 1, row(i + 1));
                each_vector(columns[0], columns[1], width, [&](int64_t j, auto count) {
                    look_at(i * width + j, count, row(i - 1) + j, row(i) + j, row(i + 1) + j);
                });
            }
        });
    }

    // The elevation of a row's cells that enough points support, NOWHERE higher elsewhere.
    void find_sure_heights(int64_t i, float* heights) const {
        if (i < 0 || i >= height) return std::fill(heights + columns[0], heights + columns[1] + LANES, s.nowhere);
        const int64_t k = i * width;
        const int64_t first = std::max(columns[0] - 1, int64_t(0)), last = std::min(columns[1] + 1, width);
        each_vector(first, last, width, [&](int64_t j, auto count) {
            const Flags known = load_bytes(map.validity + k + j, count) > 0;
            const Lanes elevation = load(map.elevation + k + j, count), support = load(map.support + k + j, count);
            store(heights + j, sure_height(elevation, known, support, s), count);
        });
        heights[-1] = heights[width] = s.nowhere;
    }

    // Look at cells from place k on, whose sure heights and those of the rows before and after are given.
    template <class Count>
    void look_at(int64_t k, Count count, const float* before, const float* own, const float* after) const {
        const Flags known = load_bytes(map.validity + k, count) > 0;
        if (!any(known)) return store(below + k, splat(s.no_fall), count), store(floor + k, splat(UNKNOWN), count);
        const Lanes elevation = load(map.elevation + k, count);
        const Lanes lowest = elevation - height_margin(load(map.variance + k, count), s);
        const Lanes fall = visibility::below_sensor(lowest, known, load(map.time + k, count), sensor.view.origin[2], s);
        const Lanes left = load(own - 1, count), right = load(own + 1, count);
        const Flags supported = well_supported<Lanes>(elevation, known, load(own, count), load(before, count),
                                                      load(after, count), left, right, s);
        store(below + k, fall, count), store(floor + k, pick(supported, lowest, splat(UNKNOWN)), count);
    }

    // `ground_at_borders`, of the cells that were looked at.
    void look_at_borders(Buffer<float>& memory) {
        const int64_t cells = s.near_cells, length = std::max(height, width), padded = length + 2 * cells;
        borders = memory.resize(4 * length + 2 * padded);
        for (int side = 0; side < 4; side++) {
            float *minima = borders + 4 * length, *room = minima + padded;
            std::fill_n(minima, padded, s.nowhere);
            border_minima(side, minima + cells);
            sliding_minimum(minima, padded, 2 * cells + 1, room);
            std::copy_n(minima, length, borders + side * length);
        }
    }

    // The lowest ground within so many cells of a border, place by place.
    void border_minima(int side, float* minima) const {
        const int64_t size = side < 2 ? height : width, cells = std::min<int64_t>(s.near_cells, size);
        int64_t band[2][2]{{rows[0], rows[1]}, {columns[0], columns[1]}};
        int64_t* across = band[side / 2];
        if (side % 2)
            across[0] = std::max(across[0], size - cells);
        else
            across[1] = std::min(across[1], cells);
        for (int64_t i = band[0][0]; i < band[0][1]; i++) {
            const int64_t k = i * width;
            if (side < 2)
                lower_all(minima, k, band[1][0], band[1][1]);
            else
                minima[i] = lowest_of(k, band[1][0], band[1][1]);
        }
    }

    template <class Count> Lanes known_ground(int64_t k, Count count) const {
        const Lanes elevation = load(map.elevation + k, count);
        return pick(load(floor + k, count) < UNKNOWN, elevation, elevation + s.nowhere);
    }

    void lower_all(float* minima, int64_t row, int64_t begin, int64_t end) const {
        each_vector(begin, end, width, [&](int64_t j, auto count) {
            store(minima + j, smaller(load(minima + j, count), known_ground(row + j, count)), count);
        });
    }

    float lowest_of(int64_t row, int64_t begin, int64_t end) const {
        Lanes lowest = splat(s.nowhere);
        int64_t j = begin;
        for (; j + LANES <= end; j += LANES) lowest = smaller(lowest, known_ground(row + j, Full()));
        float values[LANES], least = s.nowhere;
        store(values, lowest);
        for (float value : values) least = std::min(least, value);
        for (; j < end; j++) least = std::min(least, known_ground(row + j, 1)[0]);
        return least;
    }
};

}  // namespace visibility
