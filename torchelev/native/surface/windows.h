// Sums over the windows around the cells of a row: first over the rows above and below, then along the row.
#pragma once

#include "tile.h"

// Sums over the cells above and below; u counts rows from the middle one.
struct Sums {
    Lanes n{}, u_n{}, uu_n{};  // of known cells
    Lanes z{}, u_z{}, zz{};    // of their heights [m]
    Lanes highest = all(-NOWHERE), minus_lowest = all(-NOWHERE);  // of them [m]

    template <bool HAS_RANGE> void add(const Tile& tile, int row, int column, int u) {
        const Lanes known = load(tile.known(row + u, column)), height = load(tile.height(row + u, column));
        n += known, u_n += float(u) * known, uu_n += float(u * u) * known;
        z += height, u_z += float(u) * height, zz += height * height;
        if constexpr (HAS_RANGE) {
            const Lanes sunk = NOWHERE * known - NOWHERE;  // where nothing is known
            highest = larger(highest, sunk + height), minus_lowest = larger(minus_lowest, sunk - height);
        }
    }
};

// `Sums` of a row of a tile, for windows of one radius.
class Lines {
public:
    enum Name { N, U_N, UU_N, Z, U_Z, ZZ, HIGHEST, MINUS_LOWEST, COUNT };
    int radius = 0;

    // Make room for `columns` cells, and `rim` more on both sides.
    void resize(int radius, int columns, int rim) {
        this->radius = radius, rim_ = rim, width_ = whole_lanes(columns) + whole_lanes(2 * rim) + LANES;
        values_.resize(size_t(COUNT) * width_);
    }

    const float* at(Name name, int column) const { return &values_[size_t(name) * width_ + column + rim_]; }

    template <bool HAS_RANGE> void put(int column, const Sums& sums) {
        put(N, column, sums.n), put(U_N, column, sums.u_n), put(UU_N, column, sums.uu_n);
        put(Z, column, sums.z), put(U_Z, column, sums.u_z), put(ZZ, column, sums.zz);
        if constexpr (HAS_RANGE) put(HIGHEST, column, sums.highest), put(MINUS_LOWEST, column, sums.minus_lowest);
    }

private:
    std::vector<float> values_;
    int width_ = 0, rim_ = 0;

    void put(Name name, int column, Lanes values) { store(&values_[size_t(name) * width_ + column + rim_], values); }
};

// Sum the rows around the cells begin to end of a row, and those beside them; the windows of `inner` are part of those
// of `outer`.
template <bool HAS_RANGE>
inline void sum_rows(const Tile& tile, int row, int begin, int end, Lines& inner, Lines& outer) {
    for (int column = begin - outer.radius; column < end + outer.radius; column += LANES) {
        Sums sums;
        auto add = [&](int first, int last) {
            for (int u = first; u <= last; u++)
                sums.add<HAS_RANGE>(tile, row, column, -u), sums.add<HAS_RANGE>(tile, row, column, u);
        };
        sums.add<HAS_RANGE>(tile, row, column, 0), add(1, inner.radius);
        inner.put<HAS_RANGE>(column, sums);
        if (&outer == &inner) continue;
        add(inner.radius + 1, outer.radius);
        outer.put<HAS_RANGE>(column, sums);
    }
}

// Call `work` with a radius: as a constant where it is small, so that compilers unroll its loops, else with 0.
template <class Work> inline void with_radius(int radius, const Work& work) {
    switch (radius) {
    case 1: return work(std::integral_constant<int, 1>());
    case 2: return work(std::integral_constant<int, 2>());
    case 3: return work(std::integral_constant<int, 3>());
    default: return work(std::integral_constant<int, 0>());
    }
}

template <int RADIUS> [[gnu::always_inline]] inline Lanes sum_along(const Lines& lines, Lines::Name name, int column) {
    const int r = RADIUS ? RADIUS : lines.radius;
    Lanes sum{};
#pragma GCC unroll 8
    for (int v = -r; v <= r; v++) sum += load(lines.at(name, column + v));
    return sum;
}

template <int RADIUS> [[gnu::always_inline]] inline Lanes largest_along(const Lines& lines, Lines::Name name, int column) {
    const int r = RADIUS ? RADIUS : lines.radius;
    Lanes largest = load(lines.at(name, column));
#pragma GCC unroll 8
    for (int v = -r; v <= r; v++) largest = larger(largest, load(lines.at(name, column + v)));
    return largest;
}
