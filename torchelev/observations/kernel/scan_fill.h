// Heights of unknown cells: ground.py, and `inpaint` of fill.py.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "observations/kernel/scan.h"

namespace scans {

constexpr float HOLE = std::numeric_limits<float>::quiet_NaN();

inline Lanes or_zero(Lanes a) { return pick(a == a, a, splat(0)); }

// A part of a map, HOLE where not known, in rows that a rim of holes surrounds.
struct Part {
    int height = 0, width = 0, stride = 0;
    float top = 0, left = 0;  // where it begins
    std::vector<float> heights;

    void resize(int rows, int columns) {
        height = rows, width = columns, stride = columns + 1 + LANES;
        heights.resize((rows + 2) * size_t(stride) + LANES);
        std::fill_n(heights.begin(), stride, HOLE);
        for (int i = 0; i < rows; i++) {
            heights[place(i, -1)] = HOLE;
            std::fill_n(&heights[place(i, width)], LANES, HOLE);
        }
        std::fill(heights.begin() + place(rows, -1), heights.end(), HOLE);
    }

    int place(int i, int j) const { return (i + 1) * stride + j + 1; }

    // Copy what begins at a row and a column of a map, less z.
    void copy(const Cells<uint8_t>& map, int row, int column, float z) {
        for (int i = 0; i < height; i++) {
            const int64_t first = (row + i) * int64_t(map.stride) + column;
            const float* values = map.values + first;
            const uint8_t* known = map.known + first;
            float* __restrict out = &heights[place(i, 0)];
            for (int j = 0; j < width; j++) {
                const float height = values[j] - z;
                out[j] = known[j] ? height : HOLE;
            }
        }
        top = float(row), left = float(column);
    }

    Read at(Lanes i, Lanes j) const {
        i = clamp(i - top, -1, float(height)), j = clamp(j - left, -1, float(width));
        const Lanes value = gather(heights.data(), (integers(i) + 1) * stride + integers(j) + 1);
        return {or_zero(value), value == value};
    }
};

// A part of a map averaged over blocks of 1, 2, 4, ... cells a side, up to one block.
struct Blocks {
    std::vector<Part> levels;

    // The mean of a block is that of its known quarters.
    static void average(const Part& fine, Part& coarse) {
        coarse.resize((fine.height + 1) / 2, (fine.width + 1) / 2);
        for (int i = 0; i < coarse.height; i++) {
            const float *a = &fine.heights[fine.place(2 * i, 0)], *b = a + fine.stride;
            float* __restrict mean = &coarse.heights[coarse.place(i, 0)];
            for (int j = 0; j < coarse.width; j++) mean[j] = mean_of(a[2 * j], a[2 * j + 1], b[2 * j], b[2 * j + 1]);
        }
    }

    static float mean_of(float a, float b, float c, float d) {
        float sum = 0, count = 0;
        for (float value : {a, b, c, d}) {
            sum += value == value ? value : 0;
            count += value == value ? 1.0f : 0.0f;
        }
        return sum / count;
    }

    void average(const Cells<uint8_t>& map, int top, int left, float z) {
        const int height = int(map.height) - 2 * top, width = int(map.width) - 2 * left;
        size_t count = 1;
        while (std::max(height, width) > 1 << (count - 1)) count++;
        levels.resize(count);
        levels[0].resize(height, width);
        levels[0].copy(map, top, left, z);
        levels[0].top = levels[0].left = 0;  // points count from the first block
        for (size_t k = 1; k < count; k++) average(levels[k - 1], levels[k]);
    }

    // The smallest block of the levels `first` to `end` that is known, and with `is_below` is lower than 0.
    Read find(Lanes u, Lanes v, size_t first, size_t end, bool is_below) const {
        Read found{splat(0), Flags{}};
        for (size_t k = first; k < std::min(end, levels.size()); k++) {
            const float scale = 1 / float(1 << k);
            const Read block = read_bilinear(levels[k], u * scale, v * scale);
            const Flags fits = is_below ? block.known & (block.value < 0) : block.known;
            found = {pick(found.known, found.value, pick(fits, block.value, splat(0))), found.known | fits};
            if (!any(~found.known)) break;
        }
        return found;
    }
};

// Cells of a map.
struct Box {
    int top, left, bottom, right;

    bool is_empty() const { return top >= bottom || left >= right; }

    // Include the four cells around a point.
    void include(float u, float v) {
        const int i = int(std::floor(u - 0.5f)), j = int(std::floor(v - 0.5f));
        top = std::min(top, i), left = std::min(left, j);
        bottom = std::max(bottom, i + 2), right = std::max(right, j + 2);
    }

    Box grown(int cells, const Box& limit) const {
        return {std::max(top - cells, limit.top), std::max(left - cells, limit.left),
                std::min(bottom + cells, limit.bottom), std::min(right + cells, limit.right)};
    }
};

// The cells around those of the first `count` points that are not valid.
inline Box box_around(const std::vector<float>& u, const std::vector<float>& v, const std::vector<float>& is_valid,
                      int64_t count) {
    Box box{INT32_MAX, INT32_MAX, INT32_MIN, INT32_MIN};
    for (int64_t k = 0; k < count; k++)
        if (!(is_valid[k] > 0) && std::abs(u[k]) < FAR && std::abs(v[k]) < FAR) box.include(u[k], v[k]);
    return box;
}

// A part of a map whose holes become the mean of their known neighbours among eight, ring by ring.
struct Inpainted {
    Part now, next;

    // Fill the cells of `box`, by what lies within `limit`.
    void fill(const Cells<uint8_t>& map, const Box& box, const Box& limit, int rings) {
        const Box part = box.grown(rings, limit);  // the cells that the fill of `box` depends on
        for (Part* cells : {&now, &next}) cells->resize(part.bottom - part.top, part.right - part.left);
        now.copy(map, part.top, part.left, 0);
        next.top = now.top, next.left = now.left;
        bool has_holes = true;
        for (int ring = rings - 1; ring >= 0 && has_holes; ring--) {
            const Box inner = box.grown(ring, limit);
            has_holes = false;
            for (int i = inner.top - part.top; i < inner.bottom - part.top; i++)
                has_holes |= fill_row(i, inner.left - part.left, inner.right - part.left);
            std::swap(now, next);
        }
    }

    // Return whether the row had holes.
    bool fill_row(int i, int first, int end) {
        const float* row = &now.heights[now.place(i, 0)];
        float* filled = &next.heights[next.place(i, 0)];
        bool has_holes = false;
        for (int j = first; j < end; j += LANES) {
            const Lanes height = load(row + j);
            const bool is_complete = !any(height != height);
            store(filled + j, is_complete ? height : pick(height == height, height, mean_around(row + j)));
            has_holes |= !is_complete;
        }
        if (end == now.width) std::fill_n(filled + end, LANES, HOLE);  // as the rim was
        return has_holes;
    }

    // Sums of columns, then of rows, as `window_moments` adds.
    Lanes mean_around(const float* cell) const {
        Lanes sums[3];
        Flags count{};
        for (int j = 0; j < 3; j++) {
            const float* middle = cell + j - 1;
            const Lanes above = load(middle - now.stride), here = load(middle), below = load(middle + now.stride);
            sums[j] = or_zero(here) + (or_zero(above) + or_zero(below));
            count -= (above == above) + (here == here) + (below == below);
        }
        return (sums[1] + (sums[0] + sums[2])) / numbers(count);
    }
};

}  // namespace scans
