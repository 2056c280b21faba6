// Sums over the windows around the cells of a row: first over the rows above and below, then along the row.
#pragma once

#include "stages/surface/equation.h"
#include "stages/surface/rows.h"

namespace surface {

// Radii [cells] of the windows of normals, of the head (0 without it) and of `find_steps`; and the columns of a tile's
// rows, with those on both sides.
struct Windows {
    int radius, cells, steps, pitch = whole_lanes(TILE + 2 * std::max(radius, cells));
};

// The usual ones, for which compilers unroll loops.
template <int RADIUS, int CELLS> struct FixedWindows {
    static constexpr int radius = RADIUS, cells = CELLS, steps = CELLS;
    static constexpr int pitch = whole_lanes(TILE + 2 * std::max(RADIUS, CELLS));
};

// Sums over the rows of windows, for the columns of a vector; u counts rows from the middle one.
struct ColumnSums {
    Lanes n, u, uu, z, uz, zz;  // of known cells, and of their heights [m]
    Lanes highest, lowest;      // of those near enough for a step [m]

    // Sums over three rows.
    ALWAYS_INLINE ColumnSums(const Rows& rows, int row, int column) {
        const Pair known(rows.known(row - 1), rows.known(row + 1), column);
        const Pair height(rows.height(row - 1), rows.height(row + 1), column);
        const Lanes middle = load(rows.height(row) + column);
        n = load(rows.known(row) + column) + known.sum(), u = known.difference(), uu = known.sum();
        z = middle + height.sum(), uz = height.difference(), zz = middle * middle + height.squares();
        highest = load(rows.highest(row) + column), lowest = load(rows.lowest(row) + column);
    }

    // Add the rows k above and below.
    ALWAYS_INLINE void add(const Rows& rows, int row, int column, int k) {
        const Pair known(rows.known(row - k), rows.known(row + k), column);
        const Pair height(rows.height(row - k), rows.height(row + k), column);
        n += known.sum(), u += float(k) * known.difference(), uu += float(k * k) * known.sum();
        z += height.sum(), uz += float(k) * height.difference(), zz += height.squares();
    }

    ALWAYS_INLINE void add_range(const Rows& rows, int row, int column, int k) {
        const Pair up(rows.highest(row - k), rows.highest(row + k), column);
        const Pair down(rows.lowest(row - k), rows.lowest(row + k), column);
        highest = larger(larger(up.before, up.after), highest);
        lowest = smaller(smaller(down.before, down.after), lowest);
    }

  private:
    struct Pair {
        Lanes before, after;

        Pair(const float* before, const float* after, int column)
            : before(load(before + column)), after(load(after + column)) {}
        Lanes sum() const { return before + after; }
        Lanes difference() const { return after - before; }
        Lanes squares() const { return before * before + after * after; }
    };
};

// `ColumnSums` of a whole row.
class Line {
    enum { N, U, UU, Z, UZ, ZZ, HIGHEST, LOWEST, COUNT };
    Numbers numbers;

    // Sums of a quantity along the row, times 1, v and v^2, where v counts columns from `at`.
    struct Sums {
        Lanes one, v, vv;

        ALWAYS_INLINE Sums(const float* at, int radius) {
            const Lanes before = load(at - 1), after = load(at + 1);
            v = after - before, vv = before + after, one = load(at) + vv;
#pragma GCC unroll 4
            for (int k = 2; k <= radius; k++) {
                const Lanes before = load(at - k), after = load(at + k), both = before + after;
                one += both, v += float(k) * (after - before), vv += float(k * k) * both;
            }
        }
    };

  public:
    float* values;

    void resize(int pitch) { values = numbers.resize(size_t(COUNT) * pitch); }

    ALWAYS_INLINE void put(int column, int pitch, const ColumnSums& sums, bool is_rated) {
        float* to = values + column;
        store(to + N * pitch, sums.n), store(to + U * pitch, sums.u), store(to + UU * pitch, sums.uu);
        store(to + Z * pitch, sums.z), store(to + UZ * pitch, sums.uz);
        if (!is_rated) return;
        store(to + ZZ * pitch, sums.zz);
        store(to + HIGHEST * pitch, sums.highest), store(to + LOWEST * pitch, sums.lowest);
    }

    ALWAYS_INLINE Moments<Lanes> moments(int column, int pitch, int radius) const {
        const float* at = values + column;
        const Sums n(at + N * pitch, radius), u(at + U * pitch, radius), uu(at + UU * pitch, radius);
        const Sums z(at + Z * pitch, radius), uz(at + UZ * pitch, radius), zz(at + ZZ * pitch, radius);
        return {n.one, u.one, n.v, uu.one, u.v, n.vv, z.one, uz.one, z.v, zz.one};
    }

    // The largest difference [m] between heights and those within `steps` cells: `find_steps`.
    ALWAYS_INLINE Lanes step(int column, int pitch, Lanes height, int steps) const {
        const float *up = values + HIGHEST * pitch + column, *down = values + LOWEST * pitch + column;
        Lanes highest = load(up), lowest = load(down);
#pragma GCC unroll 4
        for (int k = 1; k <= steps; k++) {
            highest = larger(larger(load(up - k), load(up + k)), highest);
            lowest = smaller(smaller(load(down - k), load(down + k)), lowest);
        }
        return larger(highest - height, height - lowest);
    }
};

}  // namespace surface
