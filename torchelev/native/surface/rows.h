// The known heights of a part of a map, row by row.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "kernels/simd.h"

inline int whole_lanes(int count) { return (count + LANES - 1) / LANES * LANES; }

// Numbers that begin where vectors are read fastest.
class Buffer {
public:
    void resize(size_t count) { blocks_.resize((count + LANES - 1) / LANES); }
    float* data() { return blocks_.data()->values; }
    const float* data() const { return blocks_.data()->values; }

private:
    struct alignas(4 * LANES) Block {
        float values[LANES];
    };
    std::vector<Block> blocks_;
};

// Layers of a map (H, W).
struct Map {
    const float* elevation;
    const uint8_t* validity;
    int H, W;
};

// Some of its rows and columns.
struct Extent {
    int first_row, rows, first_column, columns;
};

// A row of an extent, and `rim` columns on both sides.
class Row {
public:
    // Choose an extent; false if nothing is known in it, and `rim` cells around it.
    bool choose(const Map& map, const Extent& extent, int rim) {
        map_ = map, extent_ = extent, offset_ = whole_lanes(rim);
        begin_ = std::max(-rim, -extent.first_column);
        end_ = std::min(extent.columns + rim, map.W - extent.first_column);
        const size_t width = offset_ + whole_lanes(extent.columns + rim) + LANES;
        known_.resize(width), height_.resize(width);
        clear();
        return find_mean(rim);
    }

    // Read a row of the extent, or one above or below it. Nothing is known outside the map.
    void read(int row) {
        if (row + extent_.first_row < 0 || row + extent_.first_row >= map_.H) return clear();
        const float* elevation = map_.elevation + cell(row);
        const uint8_t* validity = map_.validity + cell(row);
        float *known = known_.data() + offset_, *height = height_.data() + offset_;
        int k = begin_;
        for (; k + LANES <= end_; k += LANES) {
            const Flags is_known = load_bytes(validity + k, LANES) > 0;
            store(known + k, one_if(is_known)), store(height + k, pick(is_known, load(elevation + k) - mean_, all(0)));
        }
        for (; k < end_; k++) known[k] = validity[k] ? 1 : 0, height[k] = validity[k] ? elevation[k] - mean_ : 0;
    }

    // Whether cells are known (1 or 0), and their heights [m] from a mean (0 where unknown).
    const float* known(int column) const { return known_.data() + offset_ + column; }
    const float* height(int column) const { return height_.data() + offset_ + column; }

private:
    Map map_{};
    Extent extent_{};
    int offset_ = 0, begin_ = 0, end_ = 0;  // columns
    float mean_ = 0;                        // [m]
    Buffer known_, height_;

    ptrdiff_t cell(int row) const { return ptrdiff_t(extent_.first_row + row) * map_.W + extent_.first_column; }

    void clear() {
        const size_t width = offset_ + whole_lanes(end_) + LANES;
        std::fill_n(known_.data(), width, 0.0f), std::fill_n(height_.data(), width, 0.0f);
    }

    // Heights count from their mean: squares of absolute heights would cost float32 its millimetres.
    bool find_mean(int rim) {
        Lanes number{}, sum{};
        double count = 0, total = 0;
        const int first = std::max(-rim, -extent_.first_row);
        const int last = std::min(extent_.rows + rim, map_.H - extent_.first_row);
        for (int row = first; row < last; row++) {
            const float* elevation = map_.elevation + cell(row);
            const uint8_t* validity = map_.validity + cell(row);
            int k = begin_;
            for (; k + LANES <= end_; k += LANES) {
                const Flags is_known = load_bytes(validity + k, LANES) > 0;
                if (!any(is_known)) continue;
                number += one_if(is_known), sum += pick(is_known, load(elevation + k), all(0));
            }
            for (; k < end_; k++)
                if (validity[k]) count += 1, total += elevation[k];
        }
        for (int l = 0; l < LANES; l++) count += number[l], total += sum[l];
        mean_ = float(total / std::max(1.0, count));
        return count > 0;
    }
};
