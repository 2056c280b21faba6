// The lowest ray over each cell of a row, and what it says of them: clean_up.py, with the same names.
#pragma once

#include "table.h"

typedef uint8_t Bytes __attribute__((vector_size(LANES)));

template <class Count> inline Flags load_bytes(const uint8_t* values, Count count) {
    Bytes bytes{};
    std::memcpy(&bytes, values, count);
    return __builtin_convertvector(bytes, Flags);
}

template <class Count> inline void store_bytes(uint8_t* values, Flags numbers, Count count) {
    const Bytes bytes = __builtin_convertvector(numbers, Bytes);
    std::memcpy(values, &bytes, count);
}

inline Flags smaller_int(Flags a, Flags b) { return a < b ? a : b; }

struct Limits {
    float resolution, min_time, min_incidence, gate;
};

// Of all cells, or of those from some place on.
struct Layers {
    const float *elevation, *variance, *time, *gradient_x, *gradient_y, *challenger, *upper_bound;
    const uint8_t *validity, *bounded, *challenger_support;
    float* new_upper_bound;
    uint8_t *new_validity, *new_bounded, *new_challenger_support;
};

// angle or full - angle, as `mirrored`
inline Lanes mirrored(Lanes angle, float full, Lanes side) {
    return absolute(angle + pick((Flags)side < 0, all(-full), all(0)));
}

inline Lanes azimuth_fraction(Lanes x, Lanes y) {
    const Lanes ax = absolute(x), ay = absolute(y);
    const Lanes t = smaller(ax, ay) / larger(larger(ax, ay), all(1e-30f));
    const Lanes eighth = t * (0.125f + 0.0434f * (1 - t));
    return mirrored(mirrored(mirrored(eighth, 0.25f, ax - ay), 0.5f, x), 1, y);
}

// Return the lower of each two entries in a row.
inline Lanes lower_entries(const Table& table, Lanes row, Lanes a, Lanes b) {
    const Flags rows = integers(row), first = integers(a), second = integers(b);
    int32_t k[LANES], i[LANES], j[LANES];
    float lower[LANES];
    std::memcpy(k, &rows, sizeof k), std::memcpy(i, &first, sizeof i), std::memcpy(j, &second, sizeof j);
    for (int l = 0; l < LANES; l++) lower[l] = std::min(table.at(k[l], i[l]), table.at(k[l], j[l]));
    return load(lower);
}

// `lowest_slope`; no row below `first_row` is asked for.
inline Lanes lowest_slope(const Table& table, const Polar& polar, Lanes k, Lanes azimuth, int first_row) {
    Lanes entry = all(1);
    for (int w = 0; w < polar.levels && first_row < polar.widen[w]; w++)
        entry += pick(k < float(polar.widen[w]), all(float(int64_t(1) << w)), all(0));
    const Lanes half = 0.5f * (polar.bins / larger(k, all(0.5f)));
    const float azimuths = float(polar.azimuths);
    Lanes a = floor_of(azimuth - half);
    const Lanes further = larger(floor_of(azimuth + half) - a + 1 - entry, all(0));
    a = smaller(pick(a < 0, a + azimuths, a), all(azimuths - 1));
    Lanes b = a + further;
    b = pick(b < azimuths, b, b - azimuths);
    return lower_entries(table, k, a, b);
}

// Copy bytes, zero where the mask has a value.
template <bool VALUE>
inline void clear_where(const uint8_t* __restrict mask, const uint8_t* __restrict from, uint8_t* __restrict to, int count) {
    for (int j = 0; j < count; j++) to[j] = from[j] & ((mask[j] == VALUE) - 1);
}

// The cells of one row that the sensor sees at so many metres along x.
struct Row {
    const Table& table;
    const Polar& polar;
    const Limits& limits;
    const Layers& cells;  // from the row's first one on
    float x, z;
    const float* y;
    int width;

    void apply() const {
        pass_on();
        const float size = limits.resolution, reach = (table.far + 1) * size;  // a cell to spare for rounding
        const float half = reach * reach - x * x;
        if (half < 0 || table.far == 0) return;
        const float end = __builtin_sqrtf(half);
        const int first_row = std::max(0, int(__builtin_fabsf(x) / size) - 1);
        for (int j = 0; j < width; j += LANES) {
            const int count = std::min(LANES, width - j);
            if (y[j] > end || y[j + count - 1] < -end) continue;
            if (count == LANES)
                apply_at(j, first_row, std::integral_constant<int, LANES>());
            else
                apply_at(j, first_row, count);
        }
    }

  private:
    // What becomes of cells that no ray passes over.
    void pass_on() const {
        std::memcpy(cells.new_upper_bound, cells.upper_bound, sizeof(float) * width);
        std::memcpy(cells.new_validity, cells.validity, width);
        clear_where<true>(cells.validity, cells.bounded, cells.new_bounded, width);
        clear_where<false>(cells.validity, cells.challenger_support, cells.new_challenger_support, width);
    }

    // `clear_and_bound` from cell j on
    template <class Count> void apply_at(int j, int first_row, Count count) const {
        const Lanes ys = load(y + j, count), xs = all(x);
        const Lanes rho = root(larger(xs * xs + ys * ys, all(1e-12f)));
        const Lanes k = smaller(floor_of(rho / limits.resolution), all(float(polar.ranges)));
        const Lanes azimuth = azimuth_fraction(xs, ys) * float(polar.azimuths);
        const Lanes slope = lowest_slope(table, polar, k, azimuth, first_row);
        const Flags found = slope < NO_RAY;
        if (!count_set(found)) return;
        const Lanes height = z + slope * rho;
        Flags known = load_bytes(cells.validity + j, count) > 0;
        if (count_set(found & known)) {
            known &= ~gone(j, count, found & known, ys, rho, slope, height);
            store_bytes(cells.new_validity + j, -known, count);
        }
        refute_challengers(j, count, found, known, slope, height);
        lower_upper_bound(j, count, found, known, height);
    }

    // Eq. 3 and 4, of cells that are known and below a ray.
    template <class Count>
    Flags gone(int j, Count count, Flags below, Lanes y, Lanes rho, Lanes slope, Lanes height) const {
        const Lanes depth = load(cells.elevation + j, count) - height, variance = load(cells.variance + j, count);
        const Flags may = below & (depth > root(variance)) & (load(cells.time + j, count) > limits.min_time);
        if (!count_set(may)) return may;
        const Lanes gx = load(cells.gradient_x + j, count), gy = load(cells.gradient_y + j, count);
        const Lanes along = absolute(slope - (gx * x + gy * y) / rho);
        const Lanes incidence = along / root((1 + slope * slope) * (1 + gx * gx + gy * gy));
        const float half = 0.5f * limits.resolution;
        const Lanes margin = smaller(limits.gate * root(variance + half * half), all(NOWHERE));
        const Lanes rise = root(gx * gx + gy * gy) * half;
        return may & ((incidence > limits.min_incidence) | (depth > margin + rise));
    }

    template <class Count>
    void refute_challengers(int j, Count count, Flags found, Flags known, Lanes slope, Lanes height) const {
        const Flags support = load_bytes(cells.challenger_support + j, count);
        if (!count_set(support > 0)) return;
        const Lanes fall = absolute(slope) * limits.resolution;
        const Flags passes_below = found & (height < load(cells.challenger + j, count) + 0.70710678f * fall);
        store_bytes(cells.new_challenger_support + j, ~passes_below & known & support, count);
    }

    template <class Count> void lower_upper_bound(int j, Count count, Flags found, Flags known, Lanes height) const {
        const Flags bounds = found & ~known, bounded = load_bytes(cells.bounded + j, count) > 0;
        const Lanes upper_bound = load(cells.upper_bound + j, count);
        const Lanes lower = pick(bounded, smaller(upper_bound, height), height);
        store(cells.new_upper_bound + j, pick(bounds, lower, upper_bound), count);
        store_bytes(cells.new_bounded + j, -(bounds | (bounded & ~known)), count);
    }
};
