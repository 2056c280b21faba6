// The height update on a CPU: stage.py, for as many cells at a time as a vector has numbers.

#include <algorithm>
#include <atomic>

#include "kernels/simd.h"
#include "kernels/update.h"
#include "stages/cells.h"
#include "stages/fusion/cells_of_lanes.h"
#include "stages/fusion/points_of_lanes.h"
#include "stages/fusion/points_of_thread.h"
#include "stages/fusion/sort.h"
#include "stages/fusion/steps.h"

namespace {

using namespace fusion;

constexpr int64_t WORTH_A_THREAD = 256;  // vectors of cells

// What a thread keeps from map to map: the scan's points, and of each cell that they hit:
struct Scratch {
    SortedHits sorted;
    Buffer<float> mean, height, variance;  // [m], [m], [m^2] of the consensus
    Buffer<uint8_t> marks, challengers;    // bits as above; support of the challenger after the scan

    void resize(int64_t cells) {
        for (Buffer<float>* values : {&mean, &height, &variance}) values->resize(cells);
        marks.resize(cells), challengers.resize(cells);
    }
};

// Numbers of points.
struct Counts {
    Flags used, ignored;
};

class Fusion {
    const Update& u;
    const FusionSettings& s = u.settings.fusion;
    const MapState& map = u.state;
    Scratch& scratch = u.memory.get<Scratch>();
    const SortedHits& sorted = scratch.sorted;
    const Scan scan;
    std::atomic<int64_t> used{0}, ignored{0};

  public:
    explicit Fusion(const Update& u)
        : u(u), scan{sort(), u.measurement, s, u.measurement.has_covariance ? u.state.pose_covariance[8] : 0} {}

    void run() {
        scratch.resize(sorted.cells + LANES);
        each_vector([&](int64_t first, Counts&) { find_consensus(first); });
        each_vector([&](int64_t first, Counts&) { resolve_special(first); });  // reads what the next changes
        each_vector([&](int64_t first, Counts& counts) { update(first, counts); });
        const Statistics& to = map.statistics;
        *to.points_used = used, *to.rejected_edge = ignored, *to.rejected_outside = u.measurement.outside;
        *to.rejected_outlier = u.measurement.inside - ignored - used;
    }

  private:
    const Hit* sort() {
        scratch.sorted.sort(u);
        return sorted.hits();
    }

    // Call `work(first, counts)` for the first cell of each vector, and add up the counts.
    template <class Work> void each_vector(const Work& work) {
        u.each((sorted.cells + LANES - 1) / LANES, WORTH_A_THREAD, [&](int64_t, int64_t first, int64_t last) {
            Counts counts{};
            for (int64_t k = first; k < last; k++) work(k * LANES, counts);
            used += sum(counts.used), ignored += sum(counts.ignored);
        });
    }

    static int64_t sum(Flags values) {
        int64_t total = 0;
        for (int l = 0; l < LANES; l++) total += values[l];
        return total;
    }

    CellsOfLanes cells(int64_t first) const { return CellsOfLanes(&sorted.slots[first], sorted.cells - first); }

    PointsOfLanes points(int64_t first) const {
        Flags begin, end;
        std::memcpy(&begin, &sorted.starts[first], sizeof begin);
        std::memcpy(&end, &sorted.starts[first + 1], sizeof end);
        const Flags count = end - begin;
        int32_t longest = 0;
        for (int l = 0; l < LANES; l++) longest = std::max(longest, count[l]);
        return {scan, begin, count, longest, numbers(count)};
    }

    Prior<Lanes> prior(const CellsOfLanes& cells) const {
        return {cells.read(map.elevation), cells.read(map.variance), cells.read(map.support),
                cells.read(map.validity) > 0};
    }

    // Compare the points with the elevations, and find the robust mean of those that do not agree.
    void find_consensus(int64_t first) {
        const CellsOfLanes own = cells(first);
        const PointsOfLanes hits = points(first);
        const Prior<Lanes> before = prior(own);
        const Consensus<Lanes> found = estimate_consensus(hits, before, s);
        const Resolved<Lanes> settled = settle_height(hits, before, found, s);
        const Flags support = own.read(map.challenger_support), challenged = is_challenged(before, found, support > 0);
        const Flags marks =
            (found.trusted & TRUSTED) | (settled.is_step & STEP) | (challenged & (s.has_rays ? CHALLENGED : 0));
        store(&scratch.mean[first], found.mean), store(&scratch.height[first], settled.height);
        store(&scratch.variance[first], found.variance);
        constexpr std::integral_constant<int, LANES> whole;
        store_bytes(&scratch.marks[first], marks, whole), store_bytes(&scratch.challengers[first], support, whole);
    }

    // The mean of a cell's points [m]; `k` is the number of a cell with points nearby.
    float mean_near(int64_t k, int64_t slot) const {
        const int32_t* slots = sorted.slots.data();
        const int64_t steps = std::abs(slot - slots[k]);  // each cell that is hit between the two is one
        const int32_t* first = slots + std::max<int64_t>(k - steps, 0);
        const int32_t* last = slots + std::min<int64_t>(k + steps + 1, sorted.cells);
        const int32_t* found = std::lower_bound(first, last, int32_t(slot));
        return found < last && *found == slot ? scratch.mean[found - slots] : NO_HEIGHT;
    }

    // Decide what counts in cells with a step, and in those that a challenger contradicts.
    void resolve_special(int64_t first) {
        for (int64_t k = first; k < std::min(first + LANES, sorted.cells); k++)
            if (scratch.marks[k] & (STEP | CHALLENGED)) resolve_special_cell(k);
    }

    void resolve_special_cell(int64_t k) {
        uint8_t& marks = scratch.marks[k];
        const int32_t slot = sorted.slots[k], first = sorted.starts[k], last = sorted.starts[k + 1];
        auto in_scan = [&](int64_t other) { return mean_near(k, other); };
        const Around<decltype(in_scan)> around{int32_t(u.sizes.H), int32_t(u.sizes.W), map.elevation,         map.support,
                                               map.validity,       map.challenger_support, in_scan};
        if (marks & STEP) {
            const PointsOfThread points{scan, first, last, float(last - first)};
            const Side side = side_of_step(points, scratch.mean[k], slot, around, s);
            scratch.height[k] = scratch.mean[k] + side.height, marks |= side.side > 0 ? TOP : GROUND;
        }
        if (!(marks & CHALLENGED)) return;
        const Prior<float> before{map.elevation[slot], map.variance[slot], map.support[slot], map.validity[slot] > 0};
        const Consensus<float> consensus{float(last - first), scratch.mean[k], scratch.variance[k],
                                         (marks & TRUSTED) > 0, (marks & STEP) > 0};
        const Challenge challenger{map.challenger[slot], scratch.challengers[k], false};
        const Challenge after = challenge_from_above(before, challenger, look_around(around, slot, s), consensus,
                                                     scratch.height[k], s);
        map.challenger[slot] = after.height, scratch.challengers[k] = uint8_t(after.support);
        if (after.won) marks |= WON;
    }

    void update(int64_t first, Counts& counts) {
        const CellsOfLanes own = cells(first);
        const Prior<Lanes> before = prior(own);
        constexpr std::integral_constant<int, LANES> whole;
        const Flags marks = load_bytes(&scratch.marks[first], whole), won = (marks & WON) > 0;
        const Lanes side = pick((marks & TOP) > 0, splat(1), pick((marks & GROUND) > 0, splat(-1), splat(0)));
        const Measured<Lanes> measured =
            measure_cell(points(first), before, load(&scratch.height[first]), (marks & TRUSTED) > 0, side, s);
        const Decision<Lanes> decision = decide_by_vote(before, measured, won, s);
        const Prior<Lanes> after = update_cell(before, measured, won, decision, s);
        own.write(map.elevation, after.elevation), own.write(map.variance, after.variance);
        own.write(map.support, after.support);
        own.set(map.time, decision.takes, 0.0f);
        if (any(decision.takes & ~before.known)) own.set(map.validity, decision.takes, uint8_t(1));
        if (any(decision.founds | ((marks & CHALLENGED) > 0)))
            for (int l = 0; l < own.number; l++)
                map.challenger_support[own.slots[l]] = decision.founds[l] ? 0 : scratch.challengers[first + l];
        counts.used += integers(pick(decision.takes, measured.kept, splat(0)));
        counts.ignored += integers(measured.ignored);
    }
};

}  // namespace

// Fuse the scan into the map. Only cells with points change: `age` keeps the variance of the others within its limit.
extern "C" void run_fuse(Update& u) {
    locate(u, u.settings.fusion.resolution);
    Fusion(u).run();
}
