// The heights of a part of a map, row by row.
#pragma once

#include <algorithm>
#include <type_traits>

#include "kernels/simd.h"
#include "kernels/update.h"

#define ALWAYS_INLINE [[gnu::always_inline]]

namespace surface {

constexpr int TILE = 64;  // rows and columns of cells that one thread rates at a time

constexpr int whole_lanes(int count) { return (count + LANES - 1) / LANES * LANES; }

// Numbers that begin where vectors are read fastest.
class Numbers {
    struct alignas(64) Block {
        float values[16];
    };
    Buffer<Block> blocks;

  public:
    float* resize(size_t number) { return blocks.resize(number / 16 + 1)->values; }
};

// Call `work(k, count)` for vectors from begin to end, of which the last may begin before the one before it ends. They
// have LANES numbers, a constant, unless there are fewer.
template <class Work> ALWAYS_INLINE inline void for_lanes(int begin, int end, const Work& work) {
    const int last = end - LANES;
    if (last < begin) return work(begin, end - begin);
    for (int k = begin; k <= last; k = k == last ? end : std::min(k + LANES, last))
        work(k, std::integral_constant<int, LANES>());
}

// Some cells of a map (H, W).
struct Extent {
    int row, rows, column, columns;
};

// The last rows of an extent that were read, with `rim` columns on both sides, where nothing is known beyond the map.
class Rows {
    const float* elevation;
    const uint8_t* validity;
    int H, W, rim, number, width;
    int begin, end;  // columns inside the map, counted from the first that is kept
    float mean;      // [m]
    float nowhere;   // [m]
    Extent extent;
    Numbers numbers;
    Buffer<uint8_t> flags;
    float* values;

    size_t place(int row) const { return size_t((row + number) % number) * 4 * width; }
    const float* of(int row, int layer) const { return values + place(row) + layer * width; }
    bool is_inside(int row) const { return row + extent.row >= 0 && row + extent.row < H; }
    ptrdiff_t cell(int row) const { return ptrdiff_t(extent.row + row) * W + extent.column - rim; }

    void clear(int row) {
        float* to = values + place(row);
        std::fill_n(to, 2 * width, 0.0f), std::fill_n(to + 2 * width, width, -nowhere);
        std::fill_n(to + 3 * width, width, nowhere);
        flags[(row + number) % number] = 0;
    }

    // Heights count from about their mean: squares of absolute heights would cost float32 its millimetres.
    bool find_mean() {
        PartialSums known_cells, sum;
        for (int row = -rim; row < extent.rows + rim; row++) {
            const ptrdiff_t first = cell(row);
            if (!is_inside(row) || !any_set(validity + first + begin, end - begin)) continue;
            for_vectors(begin, end, [&](int64_t k, auto count) {
                const Flags known = load_bytes(validity + first + k, count) > 0;
                known_cells.add(k - begin, one_if(known));
                sum.add(k - begin, zero_unless(known, load(elevation + first + k, count)));
            });
        }
        mean = sum.total<float>() / larger(known_cells.total<float>(), 1);
        return known_cells.total<float>() > 0;
    }

  public:
    // Choose an extent, of which as many rows are kept as windows have; return whether anything is known in them.
    bool choose(const Update& u, const Extent& chosen, int of_rim, float of_nowhere) {
        elevation = u.state.elevation, validity = u.state.validity, H = int(u.sizes.H), W = int(u.sizes.W);
        extent = chosen, rim = of_rim, nowhere = of_nowhere, number = 2 * rim + 1;
        width = whole_lanes(TILE + 2 * rim);
        begin = std::max(0, rim - extent.column), end = std::min(extent.columns + 2 * rim, W - extent.column + rim);
        values = numbers.resize(size_t(number) * 4 * width), flags.resize(number);
        if (!find_mean()) return false;
        for (int row = 0; row < number; row++) clear(row);
        return true;
    }

    // Read a row of the extent, or one above or below it.
    void read(int row) {
        if (!is_inside(row)) return clear(row);
        const ptrdiff_t first = cell(row);
        float* to = values + place(row);
        Flags some{};
        for_lanes(begin, end, [&](int k, auto count) {
            const Flags is_known = load_bytes(validity + first + k, count) > 0;
            const Lanes z = load(elevation + first + k, count) - mean;
            store(to + k, one_if(is_known), count), store(to + width + k, pick(is_known, z, splat(0)), count);
            store(to + 2 * width + k, pick(is_known, z, splat(-nowhere)), count);
            store(to + 3 * width + k, pick(is_known, z, splat(nowhere)), count);
            some |= is_known;
        });
        flags[(row + number) % number] = any(some);
    }

    bool has_known(int row) const { return flags[(row + number) % number]; }

    // Whether cells are known (1 or 0), their heights [m] from about the mean (0 where unknown), and as maxima and
    // minima take them; from `rim` columns before the extent on.
    const float* known(int row) const { return of(row, 0); }
    const float* height(int row) const { return of(row, 1); }
    const float* highest(int row) const { return of(row, 2); }
    const float* lowest(int row) const { return of(row, 3); }
};

}  // namespace surface
