// Cells of other floors than the robot's: stages/overlap/clear.py.
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF  // rounded as in torch, so that the same cells are near
#else
#pragma GCC optimize("fp-contract=off")
#endif

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>

#include "kernels/simd.h"
#include "kernels/threads.h"
#include "floor.h"

namespace {

constexpr float STANCE_SQUARE = STANCE * STANCE;

// Maps (B, H, W), of which the bytes change: masks and a count.
struct Layers {
    const float *elevation, *upper_bound, *time;
    uint8_t *validity, *bounded, *challenger_support;
};

// One map: its cells' places as seen from the base, and the base's height [m].
struct Map {
    const Layers& layers;
    const Settings& s;
    int64_t first;  // place of its first cell
    int64_t columns;
    const float *x, *y;
    float z;

    // Call `look(place, count, square, near)` for vectors of cells some of which are near; `count` of them exist, and
    // `square` [m^2] is that of their distance.
    template <class Look> void each(const Look& look) const {
        for (int64_t i = s.first_row; i < s.end_row; i++)
            for (int64_t j = s.first_column; j < s.end_column; j += LANES) {
                const int64_t place = first + i * columns + j;
                const int count = int(std::min<int64_t>(LANES, s.end_column - j));
                if (count == LANES)
                    look_at(look, place, std::integral_constant<int, LANES>(), x[i], load(y + j));
                else
                    look_at(look, place, count, x[i], load(y + j, count));
            }
    }

    template <class Count> Flags known(int64_t place, Count count) const {
        return load_bytes(layers.validity + place, count) > 0;
    }
    template <class Count> Flags hit(int64_t place, Count count) const {
        return load(layers.time + place, count) == 0;
    }
    template <class Count> Lanes height(int64_t place, Count count) const {
        return load(layers.elevation + place, count) - z;
    }

  private:
    template <class Look, class Count>
    void look_at(const Look& look, int64_t place, Count count, float x, Lanes y) const {
        const Lanes square = x * x + y * y;
        const Flags near = square <= s.radius_square;
        if (any(near)) look(place, count, square, near);
    }
};

// `Total` of vectors.
struct Totals {
    Lanes weights{}, moments{};

    void add(Flags cells, Lanes weight, Lanes height) {
        weights += pick(cells, weight, all(0)), moments += pick(cells, weight * height, all(0));
    }
    Total total() const { return {sum(weights), sum(moments)}; }

  private:
    static float sum(Lanes values) {
        float total = 0;
        for (int l = 0; l < LANES; l++) total += values[l];
        return total;
    }
};

// The height of the ground on which the robot stands [m], from the base's: `ground_below`.
float ground_below(const Map& map) {
    Totals all, within, hit;
    map.each([&](int64_t place, auto count, Lanes square, Flags near) {
        const Lanes height = map.height(place, count);
        const Flags below = near & map.known(place, count) & (height <= 0);
        if (!any(below)) return;
        const Lanes spread = square + STANCE_SQUARE, weight = 1 / (spread * spread);
        all.add(below, weight, height);
        within.add(below & (height >= -map.s.max_base_height), weight, height);
        hit.add(below & map.hit(place, count), weight, height);
    });
    return ground_of(all.total().weight, within.total(), hit.total(), map.s);
}

// Clear the cells and bounds of other floors, and return the number of cells.
int64_t clear(const Map& map, const Floor& floor) {
    const Layers& l = map.layers;
    int64_t number = 0;
    map.each([&](int64_t place, auto count, Lanes square, Flags near) {
        const Flags known = map.known(place, count), bounded = load_bytes(l.bounded + place, count) > 0;
        const Lanes allowance = pick(known & map.hit(place, count), root(square) * map.s.slope, all(0));
        const Flags other = near & known & floor.is_outside(map.height(place, count), allowance);
        const Lanes bound = load(l.upper_bound + place, count) - map.z;
        const Flags other_bound = other | (near & bounded & floor.is_outside(bound, all(0)));
        if (!any(other_bound)) return;
        const Flags support = load_bytes(l.challenger_support + place, count);
        store_bytes(l.validity + place, -(known & ~other), count);
        store_bytes(l.bounded + place, -(bounded & ~other_bound), count);
        store_bytes(l.challenger_support + place, support & ~other, count);
        number += count_set(other);
    });
    return number;
}

}  // namespace

// Clear other floors than their robots' in maps (B, H, W). `x` (B, H) and `y` (B, W) are the cells' places as seen from
// the bases, `z` (B) the bases' heights [m]; `numbers` (B) of the cells cleared.
extern "C" int clear_other_floors(const float* x, const float* y, const float* z, const float* elevation,
                                  const float* upper_bound, const float* time, uint8_t* validity, uint8_t* bounded,
                                  uint8_t* challenger_support, int64_t* numbers, int64_t B, int64_t H, int64_t W,
                                  const Settings* settings, int num_threads) {
    const Layers layers{elevation, upper_bound, time, validity, bounded, challenger_support};
    auto work = [&](int64_t b) {
        const Map map{layers, *settings, b * H * W, W, x + b * H, y + b * W, z[b]};
        numbers[b] = clear(map, Floor(ground_below(map), *settings));
    };
    return code_of([&] { for_each(int(B), num_threads, work); });
}
