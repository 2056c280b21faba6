// Normals and the analytic head's rating of maps: traversability/planes.py.

#include "kernels/threads.h"
#include "planes.h"

namespace {

constexpr int ROWS = 64, COLUMNS = 128;  // of a tile: the sums of its last rows stay in the nearest cache

// The first of `_Settings` in planes.py.
struct Settings {
    float per_cell;       // [1/m]
    float min_spread[2];  // [cells^2] of the normals' windows and of the head's
    float per_slope, per_step, per_roughness;  // 1 / critical values
};

// Layers of a map (H, W), from some cell on.
struct Layers {
    float *gradient_x, *gradient_y;
    uint8_t* has_normal;
    float* traversability;
    uint8_t* rated;

    Layers from(size_t cell) const {
        const bool has_head = traversability;
        return {gradient_x + cell, gradient_y + cell, has_normal + cell,
                has_head ? traversability + cell : nullptr, has_head ? rated + cell : nullptr};
    }
};

void put(float* layer, Lanes values, int count) {
    count == LANES ? store(layer, values) : store(layer, values, count);
}

void put(uint8_t* layer, Flags flags, int count) {
    count == LANES ? store_bytes(layer, flags & 1, LANES) : store_bytes(layer, flags & 1, count);
}

// What is kept of a tile's last rows.
struct Scratch {
    Row row;
    Lines lines[2];
};

// Normals and ratings of tiles, row by row.
class Rater {
public:
    Rater(const Settings& settings, int radius, int cells, int steps, Scratch& scratch)
        : settings_(settings), cells_(cells), steps_(steps), rim_(std::max(radius, cells)), row_(scratch.row),
          normals_(scratch.lines[0]), head_(scratch.lines[cells != 0 && cells != radius]) {
        normals_.radius = radius, head_.radius = cells ? cells : radius;
    }

    void rate(const Map& map, const Extent& extent, const Layers& layers) {
        const bool is_known = row_.choose(map, extent, rim_);
        for (Lines* lines : {&normals_, &head_}) lines->resize(lines->radius, extent.columns, 2 * rim_ + 1);
        if (is_known)
            cells_ ? rate_rows<true>(map, extent, layers) : rate_rows<false>(map, extent, layers);
        else
            for (int row = 0; row < extent.rows; row++) clear(row_of(layers, map, extent, row), 0, extent.columns);
    }

private:
    const Settings& settings_;
    int cells_, steps_, rim_;
    Row& row_;
    Lines &normals_, &head_;  // the same if their windows are, or without a head

    static Layers row_of(const Layers& layers, const Map& map, const Extent& extent, int row) {
        return layers.from(size_t(extent.first_row + row) * map.W + extent.first_column);
    }

    static void clear(const Layers& out, int begin, int end) {
        const int count = end - begin;
        std::fill_n(out.gradient_x + begin, count, 0.0f), std::fill_n(out.gradient_y + begin, count, 0.0f);
        std::fill_n(out.has_normal + begin, count, uint8_t(0));
        if (!out.traversability) return;
        std::fill_n(out.traversability + begin, count, 0.0f), std::fill_n(out.rated + begin, count, uint8_t(0));
    }

    template <bool HAS_HEAD> void rate_rows(const Map& map, const Extent& extent, const Layers& layers) {
        for (int row = -rim_; row < extent.rows + rim_; row++) {
            row_.read(row);
            if (head_.radius > normals_.radius)
                sum_along<false, HAS_HEAD>(row_, row, extent.columns, steps_, normals_, head_);
            else
                sum_along<HAS_HEAD, false>(row_, row, extent.columns, steps_, head_, normals_);
            const int middle = row - rim_;  // of the windows that this row completes
            if (middle >= 0) rate_row<HAS_HEAD>(middle, extent.columns, row_of(layers, map, extent, middle));
        }
    }

    bool is_known(int row, int column) const {
        return any(load(normals_.row(row) + normals_.at(Lines::KNOWN, column)) > 0);
    }

    // Rate the runs of known cells, which are all that has a normal or a rating.
    template <bool HAS_HEAD> void rate_row(int row, int columns, const Layers& out) {
        for (int begin = 0, end; begin < columns; begin = end) {
            const bool known = is_known(row, begin);
            for (end = begin + LANES; end < columns && is_known(row, end) == known;) end += LANES;
            end = std::min(end, columns);
            known ? rate_run<HAS_HEAD>(row, begin, end, out) : clear(out, begin, end);
        }
    }

    template <bool HAS_HEAD> void rate_run(int row, int begin, int end, const Layers& out) {
        const bool is_shared = HAS_HEAD && &head_ == &normals_;
        with_radius(normals_.radius, [&](auto radius) {
            const Window<radius> window(normals_, row);
            for_planes(window, begin, end, settings_.min_spread[0], [&](auto&&... at) {
                put_normals(out, at...);
                if (is_shared) put_ratings(out, window, at...);
            });
        });
        if (!HAS_HEAD || is_shared) return;
        with_radius(head_.radius, [&](auto radius) {
            const Window<radius> window(head_, row);
            for_planes(window, begin, end, settings_.min_spread[1],
                       [&](auto&&... at) { put_ratings(out, window, at...); });
        });
    }

    // Call `use` with the planes of the cells begin to end of a row, and with where they are known.
    template <int RADIUS, class Use>
    static void for_planes(const Window<RADIUS>& window, int begin, int end, float min_spread, const Use& use) {
        for (int column = begin; column < end; column += LANES) {
            const Flags known = window.at(0, Lines::KNOWN, column) > 0;
            use(column, std::min(LANES, end - column), known, Planes::of(window, column, min_spread));
        }
    }

    [[gnu::always_inline]] void put_normals(const Layers& out, int column, int count, Flags known, const Planes& planes) const {
        const float per_cell = settings_.per_cell;
        const Flags has_normal = known & planes.spans;
        put(out.gradient_x + column, pick(has_normal, planes.gradient_u * per_cell, all(0)), count);
        put(out.gradient_y + column, pick(has_normal, planes.gradient_v * per_cell, all(0)), count);
        put(out.has_normal + column, has_normal, count);
    }

    template <int RADIUS>
    [[gnu::always_inline]] void put_ratings(const Layers& out, const Window<RADIUS>& window, int column, int count, Flags known,
                     const Planes& planes) const {
        const Flags rated = known & planes.spans;
        const Lanes height = window.at(0, Lines::HEIGHT, column);  // `find_steps`
        const Lanes rise = window.largest(Lines::HIGHEST, column, steps_) - height;
        const Lanes fall = window.largest(Lines::MINUS_LOWEST, column, steps_) + height;
        put(out.traversability + column, pick(rated, rating(planes, larger(rise, fall)), all(0)), count);
        put(out.rated + column, rated, count);
    }

    // `traversability` in heads.py, given the steps [m].
    [[gnu::always_inline]] Lanes rating(const Planes& planes, Lanes step) const {
        const float per_cell = settings_.per_cell;
        const Lanes x = planes.gradient_u * per_cell, y = planes.gradient_v * per_cell;
        const Lanes slope = arctan(root(larger(x * x + y * y, all(1e-12f))));
        const Lanes roughness = root(larger(planes.residual, all(1e-12f)));
        const Lanes worst = larger(slope * settings_.per_slope, step * settings_.per_step);
        return larger(1 - larger(worst, roughness * settings_.per_roughness), all(0));
    }
};

int parts(int length, int size) { return (length + size - 1) / size; }

}  // namespace

// Layers of (B, H, W) as in planes.py; without the head, `cells` is 0, and so are `traversability` and `rated`. `steps`
// is the radius of `find_steps` in heads.py.
// Returns what `code_of` does.
extern "C" int rate_surface(const float* elevation, const uint8_t* validity, float* gradient_x, float* gradient_y,
                            uint8_t* has_normal, float* traversability, uint8_t* rated, int64_t B, int64_t H, int64_t W,
                            int64_t radius, int64_t cells, int64_t steps, const float* settings, int num_threads) {
    Settings numbers;
    std::memcpy(&numbers, settings, sizeof numbers);
    const Layers layers{gradient_x, gradient_y, has_normal, traversability, rated};
    const int bands = parts(H, ROWS), strips = parts(W, COLUMNS);
    auto rate = [&](int task) {
        Scratch scratch;
        const size_t first = size_t(task / (bands * strips)) * H * W;
        const int band = task / strips % bands, strip = task % strips;
        const int row = band * H / bands, column = strip * W / strips;
        const Extent extent{row, int((band + 1) * H / bands) - row, column, int((strip + 1) * W / strips) - column};
        const Map map{elevation + first, validity + first, int(H), int(W)};
        Rater(numbers, radius, cells, steps, scratch).rate(map, extent, layers.from(first));
    };
    return code_of([&] { for_each(B * bands * strips, num_threads, rate); });
}
