// The part of a map that a thread works on at a time, small enough for its cache.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "../lanes.h"

inline int whole_lanes(int count) { return (count + LANES - 1) / LANES * LANES; }

typedef uint8_t Bytes __attribute__((vector_size(LANES)));

inline Bytes bytes_of(Flags flags) { return __builtin_convertvector(flags & 1, Bytes); }

inline bool any(Flags flags) {
    uint64_t words[2]{};
    const Bytes bytes = bytes_of(flags);
    std::memcpy(words, &bytes, sizeof bytes);
    return words[0] | words[1];
}

// Some of the rows and columns of a map (H, W).
struct Extent {
    int first_row, rows, first_column, columns;
};

// The known heights of an extent, with a rim around it that windows reach into, and room for whole lanes.
class Tile {
public:
    int rim = 0, stride = 0;

    // Read the cells; false if none of them is known. Nothing is known outside the map.
    bool read(const float* elevation, const uint8_t* validity, int H, int W, const Extent& extent, int width) {
        rim = width, stride = whole_lanes(extent.columns) + whole_lanes(2 * rim) + LANES;
        const int rows = extent.rows + 2 * rim;
        known_.assign(size_t(rows) * stride, 0.0f), height_.assign(size_t(rows) * stride, 0.0f);
        const int first = extent.first_column - rim, begin = std::max(0, first);
        const int end = std::min(W, extent.first_column + extent.columns + rim);
        for (int k = 0; k < rows; k++) {
            const int row = extent.first_row - rim + k;
            if (row < 0 || row >= H) continue;
            const size_t from = size_t(row) * W + begin, to = size_t(k) * stride + begin - first;
            copy_row(elevation + from, validity + from, &known_[to], &height_[to], end - begin);
        }
        return count_from_mean();
    }

    // Whether cells are known (1 or 0), and their heights [m] from the tile's mean (0 where unknown).
    const float* known(int row, int column) const { return &known_[size_t(row + rim) * stride + column + rim]; }
    const float* height(int row, int column) const { return &height_[size_t(row + rim) * stride + column + rim]; }

private:
    std::vector<float> known_, height_;

    static void copy_row(const float* elevation, const uint8_t* validity, float* known, float* height, int count) {
        for (int k = 0; k < count; k++) {
            known[k] = validity[k] ? 1.0f : 0.0f;
            height[k] = validity[k] ? elevation[k] : 0.0f;  // unknown ones may be NaN
        }
    }

    // Heights from their mean: squares of absolute heights would cost float32 its millimetres.
    bool count_from_mean() {
        Lanes number{}, sum{};
        for (size_t k = 0; k < known_.size(); k += LANES) number += load(&known_[k]), sum += load(&height_[k]);
        double count = 0, total = 0;
        for (int l = 0; l < LANES; l++) count += number[l], total += sum[l];
        const float mean = float(total / std::max(1.0, count));
        for (size_t k = 0; k < known_.size(); k += LANES)
            store(&height_[k], (load(&height_[k]) - mean) * load(&known_[k]));
        return count > 0;
    }
};
