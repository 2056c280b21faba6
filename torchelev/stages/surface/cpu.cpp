// Normals and the analytic head's rating: stage.py.

#include <vector>

#include "kernels/simd.h"
#include "kernels/update.h"
#include "stages/surface/equation.h"
#include "stages/surface/windows.h"

namespace {

using namespace surface;

// What is kept of a tile's last rows.
struct Scratch {
    Rows rows;
    Line lines[2];
};

// Rates a tile row by row.
template <class Windows> class Rater {
    const SurfaceSettings& s;
    const MapState map;
    const int64_t W;
    const Extent extent;
    const Windows windows;
    const int rim;
    Rows& rows;
    Line &normals, &head;  // the same if their windows are

    int64_t first_cell(int row) const { return (extent.row + row) * W + extent.column; }

    // Clear cells. Where none has a normal or a rating their layers hold zeros already, and to read costs less.
    template <class Count> void clear(int64_t cell, Count count) const {
        const bool is_rated = windows.cells && any_set(map.rated + cell, count);
        if (!is_rated && !any_set(map.has_normal + cell, count)) return;
        std::fill_n(map.gradient_x + cell, count, 0.0f), std::fill_n(map.gradient_y + cell, count, 0.0f);
        std::fill_n(map.has_normal + cell, count, uint8_t(0));
        if (!windows.cells) return;
        std::fill_n(map.traversability + cell, count, 0.0f), std::fill_n(map.rated + cell, count, uint8_t(0));
    }

    void clear_row(int row) const { clear(first_cell(row), extent.columns); }

    void sum_columns(int row) const {
        const int outer = std::max(windows.radius, windows.cells), pitch = windows.pitch;
        for (int column = 0; column < pitch; column += LANES) {
            ColumnSums sums(rows, row, column);
#pragma GCC unroll 4
            for (int k = 1; k <= outer; k++) {
                if (k > 1) sums.add(rows, row, column, k);
                if (k <= windows.steps) sums.add_range(rows, row, column, k);
                if (k == windows.radius) normals.put(column, pitch, sums, k == windows.cells);
                if (k == windows.cells && k != windows.radius) head.put(column, pitch, sums, true);
            }
        }
    }

    template <class Count> ALWAYS_INLINE void find_normals(int64_t cell, int column, Flags known, Count count) const {
        const auto moments = normals.moments(column, windows.pitch, windows.radius);
        const Plane<Lanes> plane = fit_plane(moments, s.min_spread[0], s);
        const Flags has_normal = known & plane.spans;
        store(map.gradient_x + cell, zero_unless(has_normal, plane.gradient_u * s.per_cell), count);
        store(map.gradient_y + cell, zero_unless(has_normal, plane.gradient_v * s.per_cell), count);
        store_bytes(map.has_normal + cell, has_normal & 1, count);
    }

    template <class Count>
    ALWAYS_INLINE void find_rating(int64_t cell, int column, Flags known, Lanes height, Count count) const {
        const Plane<Lanes> plane = fit_plane(head.moments(column, windows.pitch, windows.cells), s.min_spread[1], s);
        const Lanes step = head.step(column, windows.pitch, height, windows.steps);
        const Flags rated = known & plane.spans;
        store(map.traversability + cell, zero_unless(rated, traversability(plane, step, s)), count);
        store_bytes(map.rated + cell, rated & 1, count);
    }

    void rate_row(int row) const {
        if (!rows.has_known(row)) return clear_row(row);
        sum_columns(row);
        const int64_t first = first_cell(row);
        const float *is_known = rows.known(row) + rim, *height = rows.height(row) + rim;
        for_lanes(0, extent.columns, [&](int k, auto count) __attribute__((always_inline)) {
            const Flags known = load(is_known + k) > 0;
            if (!any(known)) return clear(first + k, count);
            find_normals(first + k, k + rim, known, count);
            if (windows.cells) find_rating(first + k, k + rim, known, load(height + k), count);
        });
    }

  public:
    Rater(const Update& u, const Extent& extent, Windows windows, Scratch& scratch)
        : s(u.settings.surface), map(u.state), W(u.sizes.W), extent(extent), windows(windows),
          rim(std::max(windows.radius, windows.cells)), rows(scratch.rows), normals(scratch.lines[0]),
          head(scratch.lines[windows.radius == windows.cells ? 0 : 1]) {
        for (Line& line : scratch.lines) line.resize(windows.pitch);
    }

    void rate(const Update& u) const {
        if (!rows.choose(u, extent, rim, s.nowhere)) {
            for (int row = 0; row < extent.rows; row++) clear_row(row);
            return;
        }
        for (int row = -rim; row < extent.rows + rim; row++) {
            rows.read(row);
            if (row >= rim) rate_row(row - rim);  // whose windows this row completes
        }
    }
};

template <class Windows> void rate(const Update& u, const Extent& extent, Scratch& scratch, Windows windows) {
    Rater<Windows>(u, extent, windows, scratch).rate(u);
}

void rate_tile(const Update& u, const Extent& extent, Scratch& scratch) {
    const SurfaceSettings& s = u.settings.surface;
    const bool is_usual = s.radius == 1 && s.steps == s.cells;
    if (is_usual && s.cells == 0) return rate(u, extent, scratch, FixedWindows<1, 0>());
    if (is_usual && s.cells == 1) return rate(u, extent, scratch, FixedWindows<1, 1>());
    if (is_usual && s.cells == 2) return rate(u, extent, scratch, FixedWindows<1, 2>());
    rate(u, extent, scratch, Windows{s.radius, s.cells, s.steps});
}

// Which tiles have something to rate or to clear; large maps are mostly unknown.
class Tiles {
    Buffer<uint8_t> used;

    // Look at a row of tiles, row by row, as memory is read fastest.
    void look(const Update& u, int band) {
        const int H = int(u.sizes.H), W = int(u.sizes.W);
        std::fill_n(&used[band * across], across, uint8_t(0));
        for (int row = band * TILE; row < std::min(H, (band + 1) * TILE); row++)
            for (int k = 0; k < across; k++) {
                const int64_t first = int64_t(row) * W + k * TILE, count = std::min(TILE, W - k * TILE);
                uint8_t& own = used[band * across + k];
                own |= any_set(u.state.validity + first, count) | any_set(u.state.has_normal + first, count);
                own |= u.settings.surface.cells && any_set(u.state.rated + first, count);
            }
    }

  public:
    int down, across;

    void find(const Update& u) {
        down = (int(u.sizes.H) + TILE - 1) / TILE, across = (int(u.sizes.W) + TILE - 1) / TILE;
        used.resize(down * across);
        u.each(down, 4, [&](int64_t, int64_t first, int64_t last) {
            for (int band = int(first); band < last; band++) look(u, band);
        });
    }

    bool are_used(int tile) const { return used[tile]; }
};

}  // namespace

extern "C" void run_rate_surface(Update& u) {
    const int H = int(u.sizes.H), W = int(u.sizes.W);
    auto& scratch = u.memory.get<std::vector<Scratch>>();
    if (scratch.size() < size_t(4 * u.threads)) scratch.resize(4 * u.threads);  // as many parts as `each` makes
    Tiles& tiles = u.memory.get<Tiles>();
    tiles.find(u);
    u.each(tiles.down * tiles.across, 1, [&](int64_t part, int64_t first, int64_t last) {
        for (int tile = int(first); tile < last; tile++) {
            if (!tiles.are_used(tile)) continue;
            const int row = tile / tiles.across * TILE, column = tile % tiles.across * TILE;
            rate_tile(u, {row, std::min(TILE, H - row), column, std::min(TILE, W - column)}, scratch[part]);
        }
    });
}
