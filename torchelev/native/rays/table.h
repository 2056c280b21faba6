// The lowest ray at or beyond each range and near each azimuth: `polar_minimum` in ops/operators.py, without the entries
// that no ray reaches.
#pragma once

#include <algorithm>
#include <cstddef>
#include <stdexcept>
#include <vector>

#include "../lanes.h"

// Of rays from one sensor.
struct Rays {
    const int32_t *range, *azimuth;  // bins; a range that the table does not have drops the ray
    const float* slope;
    int64_t number;
};

// `PolarGrid`
struct Polar {
    int ranges, azimuths;
    float bins;
    const int64_t* widen;
    int levels;

    // Of how many azimuths, as a power of two, an entry of a row is the minimum.
    int level_at(int row) const {
        int level = 0;
        while (level < levels && row < widen[level]) level++;
        return level;
    }
};

// Return the numbers from place SHIFT on, of two vectors one after the other.
template <int SHIFT> inline Lanes shifted(Lanes a, Lanes next) {
    constexpr int S = SHIFT;
#ifdef __clang__
    return __builtin_shufflevector(a, next, S, S + 1, S + 2, S + 3, S + 4, S + 5, S + 6, S + 7, S + 8, S + 9, S + 10,
                                   S + 11, S + 12, S + 13, S + 14, S + 15);
#else
    return __builtin_shuffle(a, next, Flags{S, S + 1, S + 2, S + 3, S + 4, S + 5, S + 6, S + 7, S + 8, S + 9, S + 10,
                                            S + 11, S + 12, S + 13, S + 14, S + 15});
#endif
}

template <int SHIFT> inline void widen_once(Lanes& a, Lanes& next) {
    a = smaller(a, shifted<SHIFT>(a, next));
    next = smaller(next, shifted<SHIFT>(next, next));  // what it has at its end, `a` never takes in
}

// Return the minimum of each entry and the 2^level - 1 that follow it.
inline Lanes widened(Lanes a, Lanes next, int level) {
    if (level > 0) widen_once<1>(a, next);
    if (level > 1) widen_once<2>(a, next);
    if (level > 2) widen_once<4>(a, next);
    if (level > 3) widen_once<8>(a, next);
    return a;
}

// Its rows are ranges. Those near the sensor, which look at more than LANES azimuths, are stored whole; the others in
// blocks of LANES azimuths, each as far as its rays and those of the next block reach, and a blank row after that.
class Table {
    static constexpr int NEAR_LEVEL = 4;  // 2^4 azimuths: those of a block and of the next one
    const Polar& polar;
    float blank;
    std::vector<float> entries;

  public:
    int near = 0, far = 0;             // rows that are stored whole, rows that any ray reaches
    std::vector<int32_t> rows, place;  // of each block: rows that rays reach, and where row 0 would be

    Table(const Polar& polar, float blank) : polar(polar), blank(blank) {}

    float at(int row, int azimuth) const {
        if (row < near) return entries[row * polar.azimuths + azimuth];
        const unsigned block = unsigned(azimuth) / LANES, lane = unsigned(azimuth) % LANES;
        return entries[place[block] + std::min(row, rows[block]) * LANES + lane];
    }

    // `each(count, work)` calls work(k) for each k below `count`.
    template <class Each> void build(const Rays& rays, int parts, const Each& each) {
        measure(rays);
        place_blocks();
        fill(rays);
        const int blocks = int(rows.size());
        std::vector<std::vector<float>> next;  // unchanged copies of the blocks that follow each part
        for (int k = 1; k <= parts; k++) next.push_back(copy_of(int64_t(k) * blocks / parts));
        each(parts, [&](int k) {
            const int begin = int(int64_t(k) * blocks / parts), end = int(int64_t(k + 1) * blocks / parts);
            for (int b = begin; b < end; b++) {
                const bool is_last = b + 1 == end;
                const int rows_of_next = b + 1 < blocks ? rows[b + 1] : 0;
                scan_block(b, is_last ? next[k].data() : entries.data() + place[b + 1] + near * LANES, rows_of_next);
            }
        });
        for (int r = near - 2; r >= 0; r--) {
            float *row = entries.data() + int64_t(r) * polar.azimuths, *farther = row + polar.azimuths;
            for (int a = 0; a < polar.azimuths; a++) row[a] = std::min(row[a], farther[a]);
        }
        each(near, [&](int r) { widen_row(r); });
    }

  private:
    void measure(const Rays& rays) {
        const int azimuths = polar.azimuths;
        rows.assign((azimuths + 2 * LANES - 2) / LANES, 0);  // LANES - 1 azimuths follow that repeat the first ones
        for (int64_t i = 0; i < rays.number; i++) {
            const int range = rays.range[i], a = rays.azimuth[i];
            if (uint32_t(range) >= uint32_t(polar.ranges)) continue;
            if (uint32_t(a) >= uint32_t(azimuths)) throw std::out_of_range("azimuth");
            rows[a / LANES] = std::max(rows[a / LANES], range + 1);
        }
        far = *std::max_element(rows.begin(), rows.end());
        for (int a = 0; a < LANES - 1; a++)
            rows[(azimuths + a) / LANES] = std::max(rows[(azimuths + a) / LANES], rows[a / LANES]);
        near = polar.levels > NEAR_LEVEL ? std::min(far, int(polar.widen[NEAR_LEVEL])) : 0;
    }

    void place_blocks() {
        const int blocks = int(rows.size());
        place.resize(blocks);
        int64_t size = int64_t(near) * polar.azimuths;
        for (int b = 0; b < blocks; b++) {
            rows[b] = std::max({near, rows[b], b + 1 < blocks ? rows[b + 1] : 0});
            place[b] = int32_t(size - near * LANES);
            size += (rows[b] - near + 1) * LANES;
        }
        entries.assign(size, blank);
    }

    void lower(int64_t slot, float value) { entries[slot] = std::min(entries[slot], value); }

    void fill(const Rays& rays) {
        for (int64_t i = 0; i < rays.number; i++) {
            const int range = rays.range[i], a = rays.azimuth[i], again = a + polar.azimuths;
            if (uint32_t(range) >= uint32_t(polar.ranges)) continue;
            if (range < near) {
                lower(int64_t(range) * polar.azimuths + a, rays.slope[i]);
                continue;
            }
            lower(place[a / LANES] + range * LANES + a % LANES, rays.slope[i]);
            if (a < LANES - 1) lower(place[again / LANES] + range * LANES + again % LANES, rays.slope[i]);
        }
    }

    std::vector<float> copy_of(int64_t block) const {
        if (block >= int64_t(rows.size())) return {};
        const float* first = entries.data() + place[block] + near * LANES;
        return {first, first + (rows[block] - near) * LANES};
    }

    // Turn a block into its running minimum from far to near, and widen it by the next one, which is unchanged as yet.
    void scan_block(int b, const float* next, int rows_of_next) {
        Lanes lowest = all(blank), beside = all(blank);
        float* block = entries.data() + place[b];
        int level = polar.level_at(rows[b]);
        for (int r = rows[b] - 1; r >= near; r--) {
            while (level < polar.levels && r < polar.widen[level]) level++;
            lowest = smaller(lowest, load(block + r * LANES));
            if (r < rows_of_next) beside = smaller(beside, load(next + (r - near) * LANES));
            store(block + r * LANES, widened(lowest, beside, level));
        }
        if (near == 0) return;
        float* nearer = entries.data() + int64_t(near - 1) * polar.azimuths + b * LANES;
        const int count = std::min(LANES, polar.azimuths - b * LANES);
        for (int l = 0; l < count; l++) nearer[l] = std::min(nearer[l], float(lowest[l]));
    }

    // Make each entry of a row the minimum of itself and the 2^level - 1 that follow it, all around.
    void widen_row(int r) {
        const int width = polar.azimuths, level = polar.level_at(r);
        float* row = entries.data() + int64_t(r) * width;
        std::vector<float> start(width);
        for (int w = 0; w < level; w++) {
            const int shift = (1 << w) % width;
            std::copy(row, row + shift, start.begin());
            for (int a = 0; a < width - shift; a++) row[a] = std::min(row[a], row[a + shift]);
            for (int a = width - shift; a < width; a++) row[a] = std::min(row[a], start[a - (width - shift)]);
        }
    }
};
