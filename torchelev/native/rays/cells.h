// The lowest ray over each cell of a row, and what it says of them: clean_up.py, with the same names.
#pragma once

#include "table.h"

// [m], [s], RaycastConfig
struct Settings {
    float resolution, min_time, min_incidence, gate;
};

struct Layers {
    const float *elevation, *variance, *time, *gradient_x, *gradient_y, *challenger;
};

// Layers that rays change, in place.
struct Changed {
    uint8_t *validity, *bounded;
    float* upper_bound;
    uint8_t* challenger_support;
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

// `lowest_slope` of cells in range bins k, none below `nearest`
inline Lanes lowest_slope(const Table& table, const Polar& polar, Lanes k, Lanes azimuth, int nearest) {
    Lanes entry = all(1);
    for (int w = 0; w < polar.levels && nearest < polar.widen[w]; w++)
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

// Set bytes to zero where the mask has a value.
template <bool VALUE> inline void clear_where(const uint8_t* __restrict mask, uint8_t* __restrict bytes, int count) {
    for (int j = 0; j < count; j++) bytes[j] &= (mask[j] == VALUE) - 1;
}

// One row of cells, so many metres along x from the sensor.
struct Row {
    const Table& table;
    const Polar& polar;
    const Settings& settings;
    const Layers& layers;
    const Changed& changed;
    int64_t first;  // place of its first cell
    float x, z;     // [m] from the sensor, and the sensor's height
    const float* y;  // [m] from the sensor
    int width;

    // Return how many cells are cleared.
    int64_t apply() const {
        const int64_t number = apply_rays();
        clear_where<true>(changed.validity + first, changed.bounded + first, width);
        clear_where<false>(changed.validity + first, changed.challenger_support + first, width);
        return number;
    }

  private:
    int64_t apply_rays() const {
        const float size = settings.resolution, reach = (table.far + 1) * size;  // a cell to spare for rounding
        const float square = reach * reach - x * x;
        if (table.far == 0 || square < 0) return 0;
        const float end = __builtin_sqrtf(square);
        const int nearest = int(__builtin_fabsf(x) / size) - 1;
        int64_t number = 0;
        for (int j = 0; j < width; j += LANES) {
            const int count = std::min(LANES, width - j);
            if (y[j] > end || y[j + count - 1] < -end) continue;
            if (count == LANES)
                number += apply_at(j, nearest, std::integral_constant<int, LANES>());
            else
                number += apply_at(j, nearest, count);
        }
        return number;
    }

    // `clear_and_bound`, of the cells from column j on; none lies in a range bin below `nearest`.
    template <class Count> int apply_at(int j, int nearest, Count count) const {
        const Lanes xs = all(x), ys = load(y + j, count);
        const Lanes rho = root(larger(xs * xs + ys * ys, all(1e-12f)));
        const Lanes k = smaller(floor_of(rho / settings.resolution), all(float(polar.ranges)));
        const Lanes azimuth = azimuth_fraction(xs, ys) * float(polar.azimuths);
        const Lanes slope = lowest_slope(table, polar, k, azimuth, nearest);
        const Flags found = slope < NO_RAY;
        if (!any(found)) return 0;
        const int64_t n = first + j;
        const Lanes height = z + slope * rho;
        Flags known = load_bytes(changed.validity + n, count) > 0;
        int number = 0;
        if (any(found & known)) {
            const Flags cleared = gone(n, count, found & known, ys, rho, slope, height);
            number = count_set(cleared), known &= ~cleared;
            store_bytes(changed.validity + n, -known, count);
        }
        refute_challengers(n, count, found, known, slope, height);
        lower_upper_bound(n, count, found, known, height);
        return number;
    }

    // Eq. 3 and 4, of known cells with a ray over them.
    template <class Count>
    Flags gone(int64_t n, Count count, Flags cells, Lanes ys, Lanes rho, Lanes slope, Lanes height) const {
        const Lanes depth = load(layers.elevation + n, count) - height, variance = load(layers.variance + n, count);
        const Flags may = cells & (depth > root(variance)) & (load(layers.time + n, count) > settings.min_time);
        if (!any(may)) return may;
        const Lanes gx = load(layers.gradient_x + n, count), gy = load(layers.gradient_y + n, count);
        const Lanes along = absolute(slope - (gx * x + gy * ys) / rho);
        const Lanes incidence = along / root((1 + slope * slope) * (1 + gx * gx + gy * gy));
        return may & ((incidence > settings.min_incidence) | passes_far_below(depth, variance, gx, gy));
    }

    Flags passes_far_below(Lanes depth, Lanes variance, Lanes gx, Lanes gy) const {
        const float half = 0.5f * settings.resolution;
        const Lanes margin = smaller(settings.gate * root(variance + half * half), all(NOWHERE));
        return depth > margin + root(gx * gx + gy * gy) * half;
    }

    template <class Count>
    void refute_challengers(int64_t n, Count count, Flags found, Flags known, Lanes slope, Lanes height) const {
        const Flags support = load_bytes(changed.challenger_support + n, count);
        if (!any(support > 0)) return;
        const Lanes fall = absolute(slope) * settings.resolution;
        const Flags passes_below = found & (height < load(layers.challenger + n, count) + 0.70710678f * fall);
        store_bytes(changed.challenger_support + n, ~passes_below & known & support, count);
    }

    template <class Count>
    void lower_upper_bound(int64_t n, Count count, Flags found, Flags known, Lanes height) const {
        const Flags bounds = found & ~known, bounded = load_bytes(changed.bounded + n, count) > 0;
        const Lanes upper_bound = load(changed.upper_bound + n, count);
        const Lanes lower = pick(bounded, smaller(upper_bound, height), height);
        store(changed.upper_bound + n, pick(bounds, lower, upper_bound), count);
        store_bytes(changed.bounded + n, -(bounds | (bounded & ~known)), count);
    }
};
