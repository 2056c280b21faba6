// Places around a sensor by range and azimuth: polar_table.py.
#pragma once

#include <algorithm>
#include <vector>

#include "../lanes.h"

// Chosen in Python: `PolarGrid`.
struct Polar {
    int ranges, azimuths, num_levels;
    const int* widen;     // (num_levels,) rows of an entry that is the minimum of 2, 4, 8, ... azimuth bins
    const float* width;   // (ranges + 1,) azimuth bins that a cell covers at a range
    const float* entry;   // (ranges + 1,) azimuth bins that an entry there is the minimum of
    int near_ranges, near_azimuths;        // of the table of falls
    const float *near_cosine, *near_sine;  // (near_azimuths,)
};

inline Lanes mirrored(Lanes angle, float full, Lanes side) {
    const Lanes half = copy_sign(all(full / 2), side);
    return absolute(angle + (half - full / 2));
}

inline Lanes azimuth_fraction(Lanes x, Lanes y) {
    const Lanes ax = absolute(x), ay = absolute(y);
    const Lanes t = smaller(ax, ay) / larger(larger(ax, ay), all(1e-30f));
    const Lanes eighth = t * (0.125f + 0.0434f * (1 - t));
    return mirrored(mirrored(mirrored(eighth, 0.25f, ax - ay), 0.5f, x), 1.0f, y);
}

// The running minimum of a table's rows, upwards or downwards, of some of its columns.
inline void scan(float* table, int rows, int columns, int first, int last, bool from_end) {
    for (int k = 1; k < rows; k++) {
        float* row = table + size_t(from_end ? rows - 1 - k : k) * columns;
        const float* before = from_end ? row + columns : row - columns;
        for (int a = first; a < last; a++) row[a] = before[a] < row[a] ? before[a] : row[a];
    }
}

// Make each entry of a row the minimum of itself and the entry 2^w on, level by level.
inline void widen(float* row, int k, const Polar& polar, std::vector<float>& copy) {
    for (int level = 0; level < polar.num_levels && k < polar.widen[level]; level++) {
        const int ahead = (1 << level) % polar.azimuths;
        copy.assign(row, row + polar.azimuths);
        copy.insert(copy.end(), row, row + ahead);
        for (int a = 0; a < polar.azimuths; a++) row[a] = copy[a + ahead] < row[a] ? copy[a + ahead] : row[a];
    }
}
