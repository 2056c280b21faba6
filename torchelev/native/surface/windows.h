// Sums over the windows around the cells of a row: first along each row, then over the rows above and below.
#pragma once

#include "rows.h"

// Sums over the cells to the left and right; v counts columns from the middle one.
struct Sums {
    Lanes n{}, v_n{}, vv_n{};  // of known cells
    Lanes z{}, v_z{}, zz{};    // of their heights [m]
    Lanes highest = all(-NOWHERE), minus_lowest = all(-NOWHERE);  // of those near enough for a step [m]

    template <bool HAS_RANGE> void add(const Row& row, int column, int v) {
        const Lanes known = load(row.known(column + v)), height = load(row.height(column + v));
        n += known, v_n += float(v) * known, vv_n += float(v * v) * known;
        z += height, v_z += float(v) * height, zz += height * height;
        if constexpr (HAS_RANGE) {
            const Lanes sunk = NOWHERE * known - NOWHERE;  // where nothing is known
            highest = larger(highest, sunk + height), minus_lowest = larger(minus_lowest, sunk - height);
        }
    }
};

// `Sums` of the last rows, for windows of one radius.
class Lines {
public:
    enum Name { N, V_N, VV_N, Z, V_Z, ZZ, HIGHEST, MINUS_LOWEST, HEIGHT, KNOWN, COUNT };
    int radius = 0;

    // Make room for rows of `columns` cells, `kept` rows of them.
    void resize(int radius, int columns, int kept) {
        this->radius = radius, width_ = whole_lanes(columns), kept_ = kept;
        values_.resize(size_t(COUNT) * width_ * kept);
    }

    // A row's sums; the first row is at least -kept.
    const float* row(int row) const { return values_.data() + size_t(COUNT) * width_ * ((row + kept_) % kept_); }
    float* row(int row) { return const_cast<float*>(const_cast<const Lines*>(this)->row(row)); }

    int at(Name name, int column) const { return name * width_ + column; }

    template <bool HAS_RANGE> void put(float* row, int column, const Sums& sums) const {
        put(row, N, column, sums.n), put(row, V_N, column, sums.v_n), put(row, VV_N, column, sums.vv_n);
        put(row, Z, column, sums.z), put(row, V_Z, column, sums.v_z), put(row, ZZ, column, sums.zz);
        if constexpr (!HAS_RANGE) return;
        put(row, HIGHEST, column, sums.highest), put(row, MINUS_LOWEST, column, sums.minus_lowest);
    }

    void put_middle(float* row, const Row& cells, int column) const {
        put(row, KNOWN, column, load(cells.known(column))), put(row, HEIGHT, column, load(cells.height(column)));
    }

    void put(float* row, Name name, int column, Lanes values) const { store(row + at(name, column), values); }

private:
    Buffer values_;
    int width_ = 0, kept_ = 0;
};

// Sum along a row around each of its cells; the windows of `inner` are part of those of `outer`. A height difference
// within `steps` cells, which are no more than the radius of the lines that keep it, is a step.
template <bool HAS_INNER_RANGE, bool HAS_OUTER_RANGE>
inline void sum_along(const Row& row, int number, int columns, int steps, Lines& inner, Lines& outer) {
    constexpr bool HAS_RANGE = HAS_INNER_RANGE || HAS_OUTER_RANGE;
    float *inner_row = inner.row(number), *outer_row = outer.row(number);
    for (int column = 0; column < columns; column += LANES) {
        Sums sums;
        auto add = [&](int first, int last) {
            int v = first;
            for (; v <= std::min(last, steps); v++)
                sums.add<HAS_RANGE>(row, column, -v), sums.add<HAS_RANGE>(row, column, v);
            for (; v <= last; v++) sums.add<false>(row, column, -v), sums.add<false>(row, column, v);
        };
        sums.add<HAS_RANGE>(row, column, 0), add(1, inner.radius);
        inner.put_middle(inner_row, row, column);
        inner.put<HAS_INNER_RANGE>(inner_row, column, sums);
        if (&outer == &inner) continue;
        add(inner.radius + 1, outer.radius);
        outer.put_middle(outer_row, row, column);
        outer.put<HAS_OUTER_RANGE>(outer_row, column, sums);
    }
}

// The rows of `Lines` around one of them. RADIUS is theirs, or 0 where compilers shall not unroll loops.
template <int RADIUS> class Window {
public:
    Window(const Lines& lines, int row) : lines_(lines) {
        if (!RADIUS) rows_.resize(2 * lines.radius + 1);
        for (int u = -radius(); u <= radius(); u++) rows()[u] = lines.row(row + u);
    }

    int radius() const { return RADIUS ? RADIUS : lines_.radius; }

    Lanes at(int u, Lines::Name name, int column) const { return load(rows()[u] + lines_.at(name, column)); }

    // Call `work` with each u, which counts rows from the middle one.
    template <class Work> [[gnu::always_inline]] void each(const Work& work) const {
        const int r = radius();
#pragma GCC unroll 8
        for (int u = -r; u <= r; u++) work(u);
    }

    // The largest value of the rows at most `reach` away.
    [[gnu::always_inline]] Lanes largest(Lines::Name name, int column, int reach) const {
        Lanes largest = at(0, name, column);
        each([&](int u) {
            if (std::abs(u) <= reach) largest = larger(largest, at(u, name, column));
        });
        return largest;
    }

private:
    const Lines& lines_;
    const float* few_[2 * RADIUS + 1];
    std::vector<const float*> rows_;

    const float** rows() { return (RADIUS ? few_ : rows_.data()) + radius(); }
    const float* const* rows() const { return (RADIUS ? few_ : rows_.data()) + radius(); }
};

// Call `work` with a radius, as a constant: 0 unless it is small.
template <class Work> inline void with_radius(int radius, const Work& work) {
    switch (radius) {
    case 1: return work(std::integral_constant<int, 1>());
    case 2: return work(std::integral_constant<int, 2>());
    case 3: return work(std::integral_constant<int, 3>());
    default: return work(std::integral_constant<int, 0>());
    }
}
