// Other floors than the robot's: stage.py.

#include <algorithm>
#include <type_traits>

#include "kernels/simd.h"
#include "kernels/update.h"
#include "stages/cells.h"
#include "stages/overlap/equation.h"

namespace {

using overlap::Floor;
using overlap::Total;

// Heights and bounds that lie in a row near the base [m].
struct Range {
    float lowest, highest;

    // Whether a floor may leave some of them out. Most rows have one floor only, and need no second look.
    bool exceeds(const Floor& floor) const { return lowest < floor.lower || highest > floor.upper; }
};

struct Places {
    Buffer<float> y_square;  // [m^2] of the distance to each column along y
    Buffer<Range> ranges;    // of each row
};

// The cells around the base of one map.
class Around {
    const Update& u;
    const OverlapSettings& s;
    const MapState& map;
    const float base_x, base_z;
    float* y_square;

    // Call `look(cell, square, near, count)` if some of these cells are near.
    template <class Look, class Count>
    void look_at(const Look& look, int64_t i, int64_t j, float x, Count count) const {
        const Lanes square = x * x + load(y_square + j, count);
        const Flags near = square <= s.radius_square;
        if (any(near)) look(i * u.sizes.W + j, square, near, count);
    }

  public:
    explicit Around(Update& u)
        : u(u), s(u.settings.overlap), map(u.state), base_x(u.measurement.base[0]), base_z(u.measurement.base[2]),
          y_square(u.memory.get<Places>().y_square.resize(u.sizes.W)) {
        for (int64_t j = s.first_column; j < s.end_column; j++)
            y_square[j] = square(center_offset(u, 1, j, s.resolution) - u.measurement.base[1]);
    }

    // Call `look(cell, square, near, count)` for vectors of a row some of whose cells are near, `square` [m^2] being
    // that of their distance; `count` of them exist.
    template <class Look> void row(int64_t i, const Look& look) const {
        const float x = center_offset(u, 0, i, s.resolution) - base_x;
        int64_t j = s.first_column;
        for (; j + LANES <= s.end_column; j += LANES)
            look_at(look, i, j, x, std::integral_constant<int, LANES>());
        if (j < s.end_column) look_at(look, i, j, x, int(s.end_column - j));
    }

    template <class Count> Flags is_known(int64_t cell, Count count) const {
        return load_bytes(map.validity + cell, count) > 0;
    }
    template <class Count> Flags is_bounded(int64_t cell, Count count) const {
        return load_bytes(map.bounded + cell, count) > 0;
    }
    template <class Count> Flags is_hit(int64_t cell, Count count) const { return load(map.time + cell, count) == 0; }
    template <class Count> Lanes height(int64_t cell, Count count) const {
        return load(map.elevation + cell, count) - base_z;
    }
    template <class Count> Lanes bound(int64_t cell, Count count) const {
        return load(map.upper_bound + cell, count) - base_z;
    }
};

// `Total` of vectors.
struct Totals {
    PartialSums weights, moments;

    void add(int64_t column, Flags cells, Lanes weight, Lanes moment) {
        weights.add(column, zero_unless(cells, weight)), moments.add(column, zero_unless(cells, moment));
    }
    Total total() const { return {weights.total<float>(), moments.total<float>()}; }
};

// `Range` of vectors.
struct Ranges {
    Lanes lowest = splat(HUGE_VALF), highest = splat(-HUGE_VALF);

    void add(Flags cells, Lanes height) {
        lowest = smaller(pick(cells, height, lowest), lowest), highest = larger(pick(cells, height, highest), highest);
    }
    Range range() const {
        Range all{HUGE_VALF, -HUGE_VALF};
        for (int l = 0; l < LANES; l++) all = {smaller(lowest[l], all.lowest), larger(highest[l], all.highest)};
        return all;
    }
};

// Return the height of the ground on which the robot stands [m], and find the range of each row.
float ground_below(const Update& u, const Around& around, Range* ranges) {
    const OverlapSettings& s = u.settings.overlap;
    Totals below_base, within, hit;
    for (int64_t i = s.first_row; i < s.end_row; i++) {
        Ranges row;
        around.row(i, [&](int64_t cell, Lanes square, Flags near, auto count) {
            const Lanes height = around.height(cell, count);
            const Flags known = near & around.is_known(cell, count), below = known & (height <= 0);
            const Flags bounded = near & around.is_bounded(cell, count);
            row.add(known, height);
            if (any(bounded)) row.add(bounded, around.bound(cell, count));
            if (!any(below)) return;
            const int64_t column = cell - i * u.sizes.W - s.first_column;
            const Lanes weight = overlap::weight_of(square, s), moment = weight * height;
            below_base.add(column, below, weight, moment);
            within.add(column, below & (height >= -s.max_base_height), weight, moment);
            hit.add(column, below & around.is_hit(cell, count), weight, moment);
        });
        ranges[i] = row.range();
    }
    return overlap::ground_below(below_base.total().weight, within.total(), hit.total(), s);
}

// Clear the cells and bounds of other floors in a row, and return the number of cells.
int64_t clear_row(const Around& around, int64_t i, const Floor& floor, const OverlapSettings& s, const MapState& map) {
    int64_t number = 0;
    around.row(i, [&](int64_t cell, Lanes square, Flags near, auto count) {
        const Flags known = around.is_known(cell, count), bounded = around.is_bounded(cell, count);
        const Lanes allowance = pick(known & around.is_hit(cell, count), overlap::allowance(square, s), splat(0));
        const Flags other = near & known & overlap::is_outside(around.height(cell, count), floor, allowance);
        const Flags no_bound = near & bounded & overlap::is_outside(around.bound(cell, count), floor, splat(0));
        if (!any(other | no_bound)) return;
        const Flags support = load_bytes(map.challenger_support + cell, count);
        store_bytes(map.validity + cell, -(known & ~other), count);
        store_bytes(map.bounded + cell, -(bounded & ~(other | no_bound)), count);
        store_bytes(map.challenger_support + cell, support & ~other, count);
        number += count_set(other);
    });
    return number;
}

// Clear the cells and bounds of other floors around the base, and return the number of cells.
int64_t clear_near(Update& u) {
    const OverlapSettings& s = u.settings.overlap;
    const Around around(u);
    Range* ranges = u.memory.get<Places>().ranges.resize(u.sizes.H);
    const Floor floor = overlap::own_floor(ground_below(u, around, ranges), s);
    int64_t number = 0;
    for (int64_t i = s.first_row; i < s.end_row; i++)
        if (ranges[i].exceeds(floor)) number += clear_row(around, i, floor, s, u.state);
    return number;
}

}  // namespace

extern "C" void run_clear_other_floors(Update& u) {
    if (!u.settings.overlap.has_overlap || !u.measurement.has_base) return;
    *u.state.statistics.cleared_other_floors = u.measurement.moves ? clear_near(u) : 0;  // no sound pose: no base
}
