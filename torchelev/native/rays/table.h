// The lowest ray at or beyond each range and near each azimuth: `polar_minimum` in ops/operators.py, without the
// entries that no ray reaches.
#pragma once

#include <algorithm>
#include <cstddef>
#include <stdexcept>
#include <utility>
#include <vector>

#include "kernels/simd.h"
#include "native/minima.h"
#include "kernels/threads.h"

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
};

template <int SHIFT, size_t... I> inline Lanes shifted(Lanes a, Lanes next, std::index_sequence<I...>) {
#ifdef __clang__
    return __builtin_shufflevector(a, next, int(SHIFT + I)...);
#else
    return __builtin_shuffle(a, next, Flags{int(SHIFT + I)...});
#endif
}

// Return the numbers from place SHIFT on, of two vectors one after the other.
template <int SHIFT> inline Lanes shifted(Lanes a, Lanes next) {
    return shifted<SHIFT>(a, next, std::make_index_sequence<LANES>());
}

template <int SHIFT> inline void widen_once(Lanes& a, Lanes& next) {
    a = smaller(a, shifted<SHIFT>(a, next));
    next = smaller(next, shifted<SHIFT>(next, next));  // what it has at its end, `a` never takes in
}

// Return the minimum of each entry and the 2^level - 1 that follow it.
inline Lanes widened(Lanes a, Lanes next, int level) {
    if (level > 0) widen_once<1>(a, next);
    if (level > 1) widen_once<2>(a, next);
    if constexpr (LANES > 4)
        if (level > 2) widen_once<4>(a, next);
    if constexpr (LANES > 8)
        if (level > 3) widen_once<8>(a, next);
    return a;
}

// Its rows are ranges. Each block of LANES azimuths has rows as far as its rays and those of the next block reach, and
// a blank row after that. Rows near the sensor, whose entries look at more azimuths than a block and the next one have,
// are stored whole.
class Table {
    // 2^4 azimuths of 16 lanes: from any of a block to the last but one of the next
    static constexpr int NEAR_LEVEL = LANES == 16 ? 4 : LANES == 8 ? 3 : 2;
    const Polar& polar;
    std::vector<float> blocks, whole;
    std::vector<int32_t> rows, first;  // of each block: rows that rays reach, and where its row 0 is
    int near;                          // rows that are stored whole

  public:
    int far = 0;  // rows that any ray reaches

    Table(const Polar& polar, const Rays& rays, int num_threads) : polar(polar) {
        measure(rays);
        place_blocks();
        fill(rays);
        const int count = int(rows.size()), parts = num_threads == 1 ? 1 : 4 * num_threads;
        auto begin = [&](int part) { return int(int64_t(part) * count / parts); };
        std::vector<std::vector<float>> next;  // the blocks that follow each part, unchanged
        for (int k = 1; k <= parts; k++) next.push_back(copy_of(begin(k)));
        for_each(parts, num_threads, [&](int turn) {
            const int k = parts - 1 - turn;  // from the last one on, or tests on one core would not miss the copies
            for (int b = begin(k); b < begin(k + 1); b++)
                scan_block(b, b + 1 == begin(k + 1) ? next[k].data() : blocks.data() + first[b + 1]);
        });
        for_each(near, num_threads, [&](int row) { widen_whole(row); });
    }

    float at(int row, int azimuth) const {
        if (row < near) return whole[row * polar.azimuths + azimuth];
        const unsigned block = unsigned(azimuth) / LANES, lane = unsigned(azimuth) % LANES;
        return blocks[first[block] + std::min(row, rows[block]) * LANES + lane];
    }

  private:
    bool has(int range) const { return uint32_t(range) < uint32_t(polar.ranges); }

    void measure(const Rays& rays) {
        const int azimuths = polar.azimuths;
        rows.assign((azimuths + 2 * LANES - 2) / LANES, 0);  // LANES - 1 azimuths follow that repeat the first ones
        for (int64_t i = 0; i < rays.number; i++) {
            const int a = rays.azimuth[i];
            if (uint32_t(a) >= uint32_t(azimuths)) throw std::out_of_range("azimuth");
            rows[a / LANES] = std::max(rows[a / LANES], has(rays.range[i]) ? rays.range[i] + 1 : 0);
        }
        for (int a = azimuths; a < azimuths + LANES - 1; a++)
            rows[a / LANES] = std::max(rows[a / LANES], rows[(a - azimuths) / LANES]);
        far = *std::max_element(rows.begin(), rows.end());
        near = polar.levels > NEAR_LEVEL ? std::min(far, int(polar.widen[NEAR_LEVEL])) : 0;
    }

    void place_blocks() {
        first.resize(rows.size());
        int32_t size = 0;
        for (size_t b = 0; b < rows.size(); b++) {
            if (b + 1 < rows.size()) rows[b] = std::max(rows[b], rows[b + 1]);
            first[b] = size;
            size += (rows[b] + 1) * LANES;
        }
        blocks.assign(size + 1, NO_RAY);  // one more for the rays that are dropped
        whole.assign(size_t(near) * polar.azimuths, NO_RAY);
    }

    void fill(const Rays& rays) {
        float *entries = blocks.data(), *dropped = entries + blocks.size() - 1;
        auto lower = [&](unsigned a, int range, float slope) {
            float* entry = has(range) ? entries + first[a / LANES] + range * LANES + a % LANES : dropped;
            *entry = std::min(*entry, slope);
        };
        for (int64_t i = 0; i < rays.number; i++) {
            const int a = rays.azimuth[i];
            lower(a, rays.range[i], rays.slope[i]);
            if (a < LANES - 1) lower(a + polar.azimuths, rays.range[i], rays.slope[i]);
        }
    }

    std::vector<float> copy_of(size_t block) const {
        if (block >= rows.size()) return {};
        const float* begin = blocks.data() + first[block];
        return {begin, begin + rows[block] * LANES};
    }

    // Turn a block into its running minimum from far to near, and widen it by the next one, which is unchanged as yet.
    void scan_block(int b, const float* next) {
        const int rows_of_next = b + 1 < int(rows.size()) ? rows[b + 1] : 0;
        const int last = std::min(LANES, polar.azimuths - b * LANES);
        Lanes lowest = all(NO_RAY), beside = all(NO_RAY);
        float* block = blocks.data() + first[b];
        int level = 0;
        for (int r = rows[b] - 1; r >= 0; r--) {
            while (level < polar.levels && r < polar.widen[level]) level++;
            lowest = smaller(lowest, load(block + r * LANES));
            if (r < rows_of_next) beside = smaller(beside, load(next + r * LANES));
            if (r >= near)
                store(block + r * LANES, widened(lowest, beside, level));
            else if (last > 0)
                store(whole.data() + r * polar.azimuths + b * LANES, lowest, last);
        }
    }

    // Make each entry of a whole row the minimum of itself and the 2^level - 1 that follow it, all around.
    void widen_whole(int row) {
        const int width = polar.azimuths;
        std::vector<float> start(width);
        for (int w = 0; w < polar.levels && row < polar.widen[w]; w++)
            widen_row(whole.data() + row * width, width, (1 << w) % width, start.data());
    }
};
