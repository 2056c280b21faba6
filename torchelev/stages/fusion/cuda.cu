// The height update on a GPU: stage.py. Points are sorted by cell; then a thread, or a team of threads where a cell has
// many points, works on each cell that is hit.
//
// Cells look at their neighbours as they were before the scan, so only the last kernel changes the layers they look at.

#include "kernels/cuda/update.h"
#include "stages/fusion/points_of_warp.h"
#include "stages/fusion/steps.h"

using namespace fusion;

constexpr int32_t FEW = 8;  // points of a cell up to which one thread takes it, as few cells have more

enum Number { POINTS, LIGHT, HEAVY };  // what a map's `hit_numbers` count: sorted points, and cells by their points

// Set the numbers of points to zero. A thread for each cell.
extern "C" __global__ void clear_hits(Update u) {
    const Place at = place(u.cells());
    if (at.k >= u.cells()) return;
    const Scratch scan = u.scratch.at(at.row, u.sizes);
    scan.hit_count[at.k] = 0;
    if (at.k) return;
    const Statistics to = u.state.statistics.at(at.row, u.sizes);
    for (int k = 0; k < 3; k++) scan.hit_numbers[k] = 0;
    *to.points_used = *to.rejected_edge = 0;
    *to.rejected_outlier = scan.located[0], *to.rejected_outside = scan.located[1];
}

// Count the points of each cell, and number them. A thread for each point, as below.
extern "C" __global__ void count_hits(Update u) {
    const Place at = place(u.sizes.M);
    const Scratch scan = u.scratch.at(at.row, u.sizes);
    if (at.k >= u.sizes.M || scan.slot[at.k] < 0) return;
    scan.hit_rank[at.k] = atomicAdd(&scan.hit_count[scan.slot[at.k]], 1);
}

// Find where the points of each cell go, and list the cells: light ones from the first place on, heavy ones from the
// last. The first point of a cell does it.
extern "C" __global__ void list_hit_cells(Update u) {
    const Place at = place(u.sizes.M);
    const Scratch scan = u.scratch.at(at.row, u.sizes);
    const int32_t cell = at.k < u.sizes.M ? scan.slot[at.k] : -1;
    const bool is_first = cell >= 0 && scan.hit_rank[at.k] == 0;
    const int32_t count = is_first ? scan.hit_count[cell] : 0;
    const int32_t start = take_places(scan.hit_numbers + POINTS, count);
    const int32_t light = take_places(scan.hit_numbers + LIGHT, count > 0 && count <= FEW);
    const int32_t heavy = take_places(scan.hit_numbers + HEAVY, count > FEW);
    if (!is_first) return;
    scan.hit_start[cell] = start;
    scan.hit_cell[count > FEW ? u.sizes.M - 1 - heavy : light] = cell;
}

// Put each point beside those of its cell.
extern "C" __global__ void sort_hits(Update u) {
    const Place at = place(u.sizes.M);
    const Scratch scan = u.scratch.at(at.row, u.sizes);
    const int32_t cell = at.k < u.sizes.M ? scan.slot[at.k] : -1;
    if (cell < 0) return;
    const int64_t k = at.k;
    const float* origin = scan.origin + 3 * (int32_t(k) / int32_t(u.sizes.N));
    const float ray_x = scan.x[k] - origin[0], ray_y = scan.y[k] - origin[1], noise = scan.noise[k];
    const float of_map = u.state.pose_covariance[9 * at.row + 8];
    const float shared = u.inputs.pose_covariance ? relative_variance(noise, scan.of_pose[k], of_map) : 0.0f;
    const bool passed = passed_center(scan.x[k], scan.y[k], ray_x, ray_y, u.settings.fusion.resolution);
    SortedPoint* points = reinterpret_cast<SortedPoint*>(scan.hits);
    points[scan.hit_start[cell] + scan.hit_rank[k]] = {scan.z[k], noise, shared, ray_x, ray_y, passed, {0, 0}};
}

// A map and its scan.
struct Hits {
    const Update& u;
    const FusionSettings& s;
    const Place at;
    const MapState map;
    const Scratch scan;

    explicit Hits(const Update& u)
        : u(u), s(u.settings.fusion), at(place(smaller_of(u.sizes.M, u.cells()))), map(u.state.at(at.row, u.sizes)),
          scan(u.scratch.at(at.row, u.sizes)) {}

    static int64_t smaller_of(int64_t a, int64_t b) { return a < b ? a : b; }

    // Call `work(k, cell, points)` for each hit cell, listed as number k: a thread for a light one, then a team for each
    // heavy one.
    template <class Work> void each_cell(const Work& work) const {
        if (at.k < scan.hit_numbers[LIGHT]) visit(int32_t(at.k), 1, work);
        const int32_t team = u.sizes.B * u.sizes.M > s.many_points ? 8 : warpSize, heavy = scan.hit_numbers[HEAVY];
        const int32_t teams = int32_t(gridDim.x / unsigned(u.sizes.B) * blockDim.x) / team;
        for (int32_t n = int32_t(at.k) / team; n < heavy; n += teams) visit(int32_t(u.sizes.M) - 1 - n, team, work);
    }
    Prior<float> prior(int32_t cell) const {
        return {map.elevation[cell], map.variance[cell], map.support[cell], map.validity[cell] != 0};
    }

  private:
    template <class Work> void visit(int32_t k, int stride, const Work& work) const {
        const int32_t cell = scan.hit_cell[k], count = scan.hit_count[cell];
        const SortedPoint* first = reinterpret_cast<const SortedPoint*>(scan.hits) + scan.hit_start[cell];
        work(k, cell, PointsOfWarp{first, first + count, float(count), stride, s});
    }
};

// Compare the points with the elevations, and find the robust mean of those that do not agree. A thread for each point
// or cell, whichever are fewer, as below.
extern "C" __global__ void find_consensus(Update u) {
    const Hits hits(u);
    const Scratch& scan = hits.scan;
    hits.each_cell([&](int32_t k, int32_t cell, const PointsOfWarp& points) {
        const Prior<float> before = hits.prior(cell);
        const Consensus<float> found = estimate_consensus(points, before, hits.s);
        const Resolved<float> settled = settle_height(points, before, found, hits.s);
        if (!points.is_first()) return;
        const uint8_t support = hits.map.challenger_support[cell];
        const bool challenged = hits.s.has_rays && is_challenged(before, found, support > 0);
        scan.hit_mean[cell] = found.mean, scan.hit_height[k] = settled.height, scan.hit_variance[k] = found.variance;
        scan.hit_support[k] = support;
        scan.hit_marks[k] = (found.trusted ? TRUSTED : 0) | (settled.is_step ? STEP : 0) | (challenged ? CHALLENGED : 0);
    });
}

// Decide what counts in cells with a step, and in those that a challenger contradicts.
extern "C" __global__ void resolve_special(Update u) {
    const Hits hits(u);
    const MapState& map = hits.map;
    const Scratch& scan = hits.scan;
    auto in_scan = [&](int64_t other) { return scan.hit_count[other] ? scan.hit_mean[other] : NO_HEIGHT; };
    const Around<decltype(in_scan)> around{int32_t(u.sizes.H), int32_t(u.sizes.W), map.elevation, map.support,
                                           map.validity, map.challenger_support, in_scan};
    hits.each_cell([&](int32_t k, int32_t cell, const PointsOfWarp& points) {
        int marks = scan.hit_marks[k];
        if (!(marks & (STEP | CHALLENGED))) return;
        const float mean = scan.hit_mean[cell];
        float height = scan.hit_height[k];
        if (marks & STEP) {
            const Side side = side_of_step(points, mean, cell, around, hits.s);
            height = mean + side.height, marks |= side.side > 0 ? TOP : GROUND;
        }
        if (!points.is_first()) return;
        if (marks & CHALLENGED) {
            const Consensus<float> consensus{points.number, mean, scan.hit_variance[k], (marks & TRUSTED) > 0,
                                             (marks & STEP) > 0};
            const Challenge after =
                challenge_from_above(hits.prior(cell), {map.challenger[cell], scan.hit_support[k], false},
                                     look_around(around, cell, hits.s), consensus, height, hits.s);
            map.challenger[cell] = after.height, scan.hit_support[k] = uint8_t(after.support);
            marks |= after.won ? WON : 0;
        }
        scan.hit_height[k] = height, scan.hit_marks[k] = uint8_t(marks);
    });
}

// Update the cells.
extern "C" __global__ void update_cells(Update u) {
    const Hits hits(u);
    const MapState& map = hits.map;
    const Scratch& scan = hits.scan;
    int32_t used = 0, ignored = 0;
    hits.each_cell([&](int32_t k, int32_t cell, const PointsOfWarp& points) {
        const int marks = scan.hit_marks[k];
        const bool won = marks & WON;
        const float side = marks & TOP ? 1.0f : marks & GROUND ? -1.0f : 0.0f;
        const Prior<float> before = hits.prior(cell);
        const Measured<float> measured =
            measure_cell(points, before, scan.hit_height[k], bool(marks & TRUSTED), side, hits.s);
        if (!points.is_first()) return;  // others of the team may still read what they need no more
        const Decision<float> decision = decide_by_vote(before, measured, won, hits.s);
        const Prior<float> after = update_cell(before, measured, won, decision, hits.s);
        map.elevation[cell] = after.elevation, map.variance[cell] = after.variance, map.support[cell] = after.support;
        if (decision.takes) map.time[cell] = 0, map.validity[cell] = 1;
        if (decision.founds || (marks & CHALLENGED))
            map.challenger_support[cell] = decision.founds ? 0 : scan.hit_support[k];
        used += decision.takes ? int32_t(measured.kept) : 0, ignored += int32_t(measured.ignored);
    });
    const Statistics& to = map.statistics;
    add_of_warp(to.points_used, used), add_of_warp(to.rejected_edge, ignored);
    add_of_warp(to.rejected_outlier, -used - ignored);
}
