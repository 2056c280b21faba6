// The lowest ray at or beyond each range and near each azimuth, as far as rays reach: `lowest_slopes`.
#pragma once

#include <numeric>

#include "stages/visibility/minima.h"
#include "stages/visibility/sensor.h"

namespace visibility {

constexpr int64_t ENTRIES_AT_A_TIME = 32768;  // that are worth a thread

// A ray that is accepted.
struct Entry {
    int32_t range, azimuth;  // bins
    float slope;
};

// Of vectors of entries.
struct Places {
    Flags one, other;
};

// Memory of all sensors and maps.
struct TableMemory {
    Buffer<float> blocks, whole, next;
    Buffer<int32_t> rows, top;
};

// LANES azimuths lie side by side, range after range. Each block of them has rows as far as its rays and those of
// blocks beside it reach. Near the sensor, where a cell covers more azimuths than a block
// and the next one have, rows are stored whole, and each cell looks at all of its azimuths.
class Table {
    static constexpr int NEAR_LEVEL = LANES >= 8 ? 3 : 2;
    const Update& u;
    const VisibilitySettings& s;
    TableMemory& memory;
    const int stride;          // rows of a block that there is room for
    const int real, count;     // blocks of azimuths; and those with copies of the first LANES - 1 azimuths at the end
    const int whole_width;
    const int blank;           // place of an entry without a ray
    float *blocks, *whole;
    int32_t *rows, *top;       // of each block: rows that rays reach, and those of it and the next two
    bool is_even;              // blocks have as many rows

  public:
    int far = 0;   // rows that any ray reaches
    int near = 0;  // rows that are stored whole

    Table(const Update& u, float farthest, TableMemory& memory)
        : u(u), s(u.settings.visibility), memory(memory),
          stride(int(std::clamp(std::floor(farthest / s.resolution), 1.0f, float(s.ranges))) + 1),
          real((s.azimuths + LANES - 1) / LANES), count((s.azimuths + 2 * LANES - 2) / LANES),
          whole_width(s.azimuths + int(2 * s.bins) + 4 * LANES), blank(count * stride * LANES) {
        blocks = aligned(memory.blocks, blank + 1);
        blocks[blank] = s.no_ray;
        rows = memory.rows.resize(count), top = memory.top.resize(count);
        std::fill_n(rows, count, 0);
        whole = aligned(memory.whole, size_t(near_rows(stride)) * whole_width);
    }

    void lower(const Entry* entries, int64_t number) {
        for (const Entry* entry = entries; entry < entries + number; entry++) {
            lower(entry->azimuth, entry->range, entry->slope);
            if (entry->azimuth < LANES - 1) lower(entry->azimuth + s.azimuths, entry->range, entry->slope);
        }
    }

    // Turn entries into what `lowest_slopes` returns, when all rays are in.
    void finish() {
        far = *std::max_element(rows, rows + count);
        near = near_rows(far);
        place_blocks();
        const int64_t most = u.threads == 1 ? 1 : 4 * u.threads;
        const int64_t parts = int64_t(count) * far * LANES < ENTRIES_AT_A_TIME ? 1 : most;
        auto begin = [&](int64_t part) { return int(part * real / parts); };
        float* next = memory.next.resize(most * stride * LANES);  // the blocks that follow each part, unchanged
        for (int64_t k = 1; k < parts; k++) std::copy_n(block(begin(k)), far * LANES, next + (k - 1) * far * LANES);
        for_each(int(parts), parts == 1 ? 1 : u.threads, [&](int turn) {
            const int64_t k = parts - 1 - turn;  // from the last one on, or tests on one core would not miss the copies
            for (int b = begin(k); b < begin(k + 1); b++)
                scan_block(b, k + 1 < parts && b + 1 == begin(k + 1) ? next + k * far * LANES : block(b + 1));
        });
        for (int row = 0; row < near; row++) {
            float* values = whole + row * whole_width;
            std::copy_n(values, int(s.bins / std::max(float(row), 0.5f)) + LANES, values + s.azimuths);
        }
    }

    // Return where the first and the last entry of windows at ranges k are found; blank ones in rows near the sensor.
    Places places(Lanes k, const Window<Lanes>& window) const {
        const float azimuths = float(s.azimuths);
        const Lanes b = window.first + window.further;
        const Flags first = integers(window.first), last = integers(pick(b < azimuths, b, b - azimuths));
        const Flags block = first >> LANE_BITS, row = integers(k);
        const Flags exists = (row >= near) & (row < (is_even ? Flags{} + far : gather(top, block)));
        const Flags one = (block * stride + row) * LANES + (first & (LANES - 1));
        const Flags other = ((last >> LANE_BITS) * stride + row) * LANES + (last & (LANES - 1));
        return {pick_int(exists, one, Flags{} + blank), pick_int(exists, other, Flags{} + blank)};
    }

    Lanes lowest(const Places& places) const {
        return smaller(gather(blocks, places.one), gather(blocks, places.other));
    }

    // Return the lowest entry of so many from an azimuth on, in a row that is stored whole.
    float lowest_near(int row, int azimuth, int number) const {
        const float* values = whole + row * whole_width + azimuth;
        Lanes lowest = splat(s.no_ray);
        for (int k = 0; k < number; k += LANES) lowest = smaller(lowest, load(values + std::min(k, number - LANES)));
        return lowest_lane(lowest);
    }

  private:
    int near_rows(int rows) const { return s.levels > NEAR_LEVEL ? std::min(rows, int(s.widen[NEAR_LEVEL])) : 0; }
    float* block(int b) const { return blocks + size_t(b) * stride * LANES; }

    void lower(unsigned azimuth, int range, float slope) {
        const unsigned b = azimuth / LANES;
        if (range >= rows[b]) {
            std::fill(block(b) + rows[b] * LANES, block(b) + (range + 1) * LANES, s.no_ray);
            rows[b] = range + 1;
        }
        float& entry = block(b)[range * LANES + azimuth % LANES];
        entry = std::min(entry, slope);
    }

    // Find how far blocks and those beside them reach, and blank their ends.
    void place_blocks() {
        const int64_t used = std::accumulate(rows, rows + real, int64_t(0));
        is_even = 2 * used > int64_t(far) * real;  // then looking up how far they reach takes longer than to blank all
        auto highest = [&](int b, int from, int to) {
            int32_t number = is_even ? far : 0;
            for (int k = b + from; k <= b + to; k++) number = std::max(number, rows[(k + 2 * real) % real]);
            return number;
        };
        for (int b = 0; b < real; b++) {
            top[b] = highest(b, 0, 2);
            std::fill(block(b) + rows[b] * LANES, block(b) + highest(b, -2, 2) * LANES, s.no_ray);
        }
    }

    // Turn a block into its running minimum from far to near, and widen it by the next one, which is unchanged as yet.
    void scan_block(int b, const float* next) {
        Scan scan{*this, b, block(b), next, rows[b], b + 1 < count ? rows[b + 1] : 0, splat(s.no_ray), splat(s.no_ray)};
        int end = std::max(scan.rows, scan.rows_of_next);
        for (int row = near - 1; row >= end; row--) store(whole + row * whole_width + b * LANES, splat(s.no_ray));
        end = scan.rows_down_to<0>(first_row(0), end);
        end = scan.rows_down_to<1>(first_row(1), end);
        end = scan.rows_down_to<2>(first_row(2), end);
        end = scan.rows_down_to<3>(near, end);
        scan.near_rows_from(end);
    }

    // From which row on entries are the minimum of no more than 2^level.
    int first_row(int level) const { return std::max(near, level < s.levels ? int(s.widen[level]) : 0); }

    struct Scan {
        const Table& table;
        const int b;
        float* block;
        const float* next;
        const int rows, rows_of_next;
        Lanes lowest, beside;

        // Take the entries of a row in.
        void look(int row) {
            if (row < rows) lowest = smaller(lowest, load(block + row * LANES));
            if (row < rows_of_next) beside = smaller(beside, load(next + row * LANES));
        }
        // Scan rows whose entries are the minimum of 2^LEVEL, down to row `first`; return the last one that is scanned.
        template <int LEVEL> int rows_down_to(int first, int end) {
            for (int row = end - 1; row >= first; row--) {
                look(row);
                store(block + row * LANES, widened<LEVEL>(lowest, beside));
            }
            return std::min(first, end);
        }
        void near_rows_from(int end) {
            for (int row = end - 1; row >= 0; row--) {
                look(row);
                store(table.whole + row * table.whole_width + b * LANES, lowest);
            }
        }
    };
};

}  // namespace visibility
