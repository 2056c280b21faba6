// Other floors than the robot's, on a GPU: stage.py. A warp for each row of cells near a base, but where it says
// otherwise.

#include "kernels/cuda/update.h"
#include "stages/overlap/equation.h"
#include "stages/window.h"

using overlap::Floor;
using overlap::Total;

constexpr float INFINITE = std::numeric_limits<float>::infinity();

// What a row near the base holds, as `ground_below` takes it; and the range of its heights and bounds [m].
struct RowSums {
    float weight;  // of all below the base
    Total within, hit;
    float lowest, highest;
};
static_assert(sizeof(RowSums) == 7 * sizeof(float), "as in kernel.py");

inline RowSums* rows_of(const Scratch& scan) { return reinterpret_cast<RowSums*>(scan.near_rows); }

inline bool has_base(const Update& u) { return u.settings.overlap.has_overlap && u.inputs.T_map_base; }

// A row of cells near the base, as a warp sees it.
struct Row {
    const OverlapSettings& s;
    const Place at;
    const MapState map;
    const Scratch scan;
    const int64_t columns;
    const int64_t i;
    const float base_z;

    explicit Row(const Update& u)
        : s(u.settings.overlap), at(place(warpSize * u.sizes.H)), map(u.state.at(at.row, u.sizes)),
          scan(u.scratch.at(at.row, u.sizes)), columns(u.sizes.W), i(s.first_row + at.k / warpSize),
          base_z(scan.base[2]) {}

    // Whether there is such a row, and a sound base.
    bool exists() const { return i < s.end_row && *scan.sound; }

    // Call `look(cell, square)` with this thread's cells, `square` [m^2] being that of their distance.
    template <class Look> void each(const Look& look) const {
        const int64_t corner[2] = {map.corner[0], map.corner[1]}, anchor[2] = {scan.anchor[0], scan.anchor[1]};
        const float x = center_offset(corner, anchor, 0, i, s.resolution) - scan.base[0], base_y = scan.base[1];
        for (int64_t j = s.first_column + at.k % warpSize; j < s.end_column; j += warpSize) {
            const float y = center_offset(corner, anchor, 1, j, s.resolution) - base_y, distance2 = x * x + y * y;
            if (distance2 <= s.radius_square) look(i * columns + j, distance2);
        }
    }
    float height(int64_t cell) const { return map.elevation[cell] - base_z; }
    float bound(int64_t cell) const { return map.upper_bound[cell] - base_z; }
};

inline void add(Total& total, float weight, float height) { total.weight += weight, total.moment += weight * height; }

inline void widen(RowSums& sums, float height) {
    sums.lowest = smaller(sums.lowest, height), sums.highest = larger(sums.highest, height);
}

inline float sum_of_warp(float value) {
    return of_warp(value, [](float a, float b) { return a + b; });
}

inline Total sum_of_warp(const Total& own) { return {sum_of_warp(own.weight), sum_of_warp(own.moment)}; }

inline Total sum_of_block(const Total& own, float* memory) {
    return {sum_of_block(own.weight, memory), sum_of_block(own.moment, memory)};
}

// Sum up what lies below the base, and find the range of heights and bounds.
extern "C" __global__ void sum_rows_below(Update u) {
    const Row row(u);
    if (!has_base(u) || !row.exists()) return;
    RowSums own{0, {0, 0}, {0, 0}, INFINITE, -INFINITE};
    row.each([&](int64_t cell, float square) {
        if (row.map.bounded[cell]) widen(own, row.bound(cell));
        if (!row.map.validity[cell]) return;
        const float height = row.height(cell);
        widen(own, height);
        if (!(height <= 0)) return;
        const float weight = overlap::weight_of(square, row.s);
        own.weight += weight;
        if (height >= -row.s.max_base_height) add(own.within, weight, height);
        if (row.map.time[cell] == 0) add(own.hit, weight, height);
    });
    own = {sum_of_warp(own.weight), sum_of_warp(own.within), sum_of_warp(own.hit),
           of_warp(own.lowest, [](float a, float b) { return smaller(a, b); }),
           of_warp(own.highest, [](float a, float b) { return larger(a, b); })};
    if (threadIdx.x % warpSize == 0) rows_of(row.scan)[row.i] = own;
}

// Find the robot's floor. A block for each map.
extern "C" __global__ void find_floor(Update u) {
    if (!has_base(u)) return;
    const OverlapSettings& s = u.settings.overlap;
    const Scratch scan = u.scratch.at(blockIdx.x, u.sizes);
    if (threadIdx.x == 0) *u.state.statistics.at(blockIdx.x, u.sizes).cleared_other_floors = 0;
    if (!*scan.sound) return;
    RowSums own{};
    for (int64_t i = s.first_row + threadIdx.x; i < s.end_row; i += blockDim.x) {
        const RowSums row = rows_of(scan)[i];
        own.weight += row.weight;
        own.within.weight += row.within.weight, own.within.moment += row.within.moment;
        own.hit.weight += row.hit.weight, own.hit.moment += row.hit.moment;
    }
    float* memory = reinterpret_cast<float*>(block_memory());
    own.weight = sum_of_block(own.weight, memory);
    own.within = sum_of_block(own.within, memory), own.hit = sum_of_block(own.hit, memory);
    if (threadIdx.x) return;
    const Floor floor = overlap::own_floor(overlap::ground_below(own.weight, own.within, own.hit, s), s);
    scan.floor[0] = floor.lower, scan.floor[1] = floor.upper;
}

// Clear the cells and bounds of other floors. Most rows have one floor only, and need no second look.
extern "C" __global__ void clear_other_floors(Update u) {
    const Row row(u);
    if (!has_base(u) || !row.exists()) return;
    const Floor floor{row.scan.floor[0], row.scan.floor[1]};
    const RowSums& found = rows_of(row.scan)[row.i];
    if (found.lowest >= floor.lower && found.highest <= floor.upper) return;
    int32_t number = 0;
    row.each([&](int64_t cell, float square) {
        const MapState& map = row.map;
        const bool known = map.validity[cell], bounded = map.bounded[cell];
        const float allowance = known && map.time[cell] == 0 ? overlap::allowance(square, row.s) : 0.0f;
        const bool other = known && overlap::is_outside(row.height(cell), floor, allowance);
        const bool no_bound = bounded && overlap::is_outside(row.bound(cell), floor, 0.0f);
        if (other) map.validity[cell] = 0, map.challenger_support[cell] = 0;
        if (bounded && (other || no_bound)) map.bounded[cell] = 0;
        number += other;
    });
    add_of_warp(row.map.statistics.cleared_other_floors, number);
}
