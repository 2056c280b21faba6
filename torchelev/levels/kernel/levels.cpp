// What an update does to levels: step.py, for float32 maps on a CPU.

#include "levels/kernel/choice.h"

namespace {

using levels::Cell, levels::Update, levels::BLOCK, levels::INFINITE;

struct MapUpdate : levels::Choice {
    using Choice::Choice;

    void run() {
        follow();
        const places::Origin origin(u, b);
        own.sights.resize(u.S);
        measure(origin);
        look();
        sort_points();
        tidy();
        if (has_base) choose();
        put_aside();
        std::copy_n(statistics, levels::STATISTICS, u.statistics + levels::STATISTICS * b);
    }

    struct Range {
        int64_t begin, end;
    };
    // Which rows or columns of a window were in it before.
    static Range staying(int64_t now, int64_t before, int64_t size) {
        const int64_t begin = std::clamp<int64_t>(before - now, 0, size), end = std::clamp<int64_t>(before - now + size, 0, size);
        return {begin, std::max(begin, end)};
    }

    // Move to the window of the map, and age: `move`, `age`.
    void follow() {
        const int64_t *now = u.corner + 2 * b, size[] = {u.H, u.W};
        int64_t* before = u.before + 2 * b;
        row.resize(u.H), column.resize(u.W);
        for (int64_t i = 0; i < u.H; i++) row[i] = int32_t(ring(now[0] + i, u.H) * u.W);
        for (int64_t j = 0; j < u.W; j++) column[j] = int32_t(ring(now[1] + j, u.W));
        const Range rows = staying(now[0], before[0], u.H), columns = staying(now[1], before[1], u.W);
        for (int64_t i = 0; i < u.H; i++) {
            const bool stays = i >= rows.begin && i < rows.end;
            for (int64_t j = 0; j < (stays ? columns.begin : u.W); j++) blank(row[i] + column[j]);
            for (int64_t j = columns.end; stays && j < u.W; j++) blank(row[i] + column[j]);
        }
        for (int axis = 0; axis < 2; axis++) before[axis] = now[axis];
        const float dt = u.dt[b] > 0 && u.dt[b] < INFINITE ? u.dt[b] : 0, added = u.variance_rate * dt;
        const int64_t first = b * u.L * cells, number = u.L * cells;
        grow_older(u.support + first, u.time + first, u.level_variance + first, number, dt, added, u.max_variance);
        own.had_levels.assign(cells, 0);
        for (int64_t l = 0; l < u.L; l++) note_levels(u.support + first + l * cells, own.had_levels.data(), cells);
    }

    static void grow_older(const float* support, float* __restrict time, float* __restrict variance, int64_t number,
                           float dt, float added, float max_variance) {
        for (int64_t first = 0; first < number; first += BLOCK) {
            const int64_t end = std::min(first + BLOCK, number);
            int32_t any = 0;
            for (int64_t p = first; p < end; p++) any |= support[p] > 0;
            for (int64_t p = first; any && p < end; p++) {  // mostly none
                const bool is_there = support[p] > 0;
                const float older = std::min(variance[p] + added, max_variance);
                time[p] = time[p] + (is_there ? dt : 0.0f), variance[p] = is_there ? older : variance[p];
            }
        }
    }

    static void note_levels(const float* support, uint8_t* __restrict had, int64_t number) {
        for (int64_t p = 0; p < number; p++) had[p] |= support[p] > 0;
    }

    // Merge surfaces that meet, and clear those that rays passed through; note what space is free.
    void tidy() {
        std::atomic<int64_t> merged{0}, cleared{0};
        own.with_levels.resize(parts.number);
        parts(u.H, [&](int64_t part, int64_t begin, int64_t end) {
            int64_t of_part[levels::STATISTICS] = {};
            std::vector<int32_t>& found = own.with_levels[part];
            found.clear();
            for (int64_t i = begin; i < end; i++)
                for_stretches(i, [&](int64_t j, int64_t p, int64_t n) { tidy_stretch(i * u.W + j, p, n, of_part, found); });
            merged += of_part[levels::MERGED], cleared += of_part[levels::CLEARED];
        });
        statistics[levels::MERGED] += merged, statistics[levels::CLEARED] += cleared;
    }

    void tidy_stretch(int64_t first, int64_t p, int64_t number, int64_t* numbers, std::vector<int32_t>& found) const {
        const int64_t n = b * cells + first;
        const Space space{u.elevation + n, &own.highest[first], &own.lowest[first], u.ground_support + n, u.validity + n};
        note_open(space, &is_open(p), number, u.min_gap, std::max(u.min_support, 0.5f));
        raise_free_top(space, first, &free_top(p), number);
        for (int64_t begin = 0; begin < number; begin += BLOCK) {
            const int64_t size = std::min(BLOCK, number - begin);
            if (!any_levels(p + begin, size)) continue;  // mostly
            for (int64_t k = begin; k < begin + size; k++) {
                if (!has_levels(p + k)) continue;
                tidy_cell(first + k, p + k, numbers);
                if (has_levels(p + k)) found.push_back(int32_t(first + k));
            }
        }
    }

    // What is known of the space over a row of cells.
    struct Space {
        const float *ground, *high, *low, *support;  // the ground, and the highest and lowest ray [m]; points of the ground
        const uint8_t* known;
    };

    static void note_open(const Space& space, uint8_t* __restrict open, int64_t number, float gap, float least) {
        const float *g = space.ground, *high = space.high, *low = space.low, *support = space.support;
        const uint8_t* known = space.known;
        for (int64_t n = 0; n < number; n++)
            open[n] |= known[n] & uint8_t((support[n] >= least) & (low[n] < g[n] + 0.5f * gap) & (high[n] >= g[n] + gap));
    }

    void raise_free_top(const Space& space, int64_t first, float* top, int64_t number) const {
        const float step = levels::RISE * float(u.resolution);
        for (int64_t n = 0; n < number; n++) {
            if (!(space.high[n] > top[n] + step)) continue;  // mostly
            const int64_t c = first + n;
            const float lowest = own.number[c] ? std::min(own.bottom[c], space.low[n]) : space.low[n];
            const float floor = space.known[n] ? space.ground[n] : lowest;
            if (!(space.high[n] > floor + step)) continue;
            for (const levels::Sight& sight : own.sights)
                top[n] = sight.raise_free_top(top[n], floor, own.x[c / u.W], own.y[c % u.W], u.min_gap, sights.size);
        }
    }

    void tidy_cell(int64_t c, int64_t p, int64_t* numbers) const {
        const Cell cell = cell_at(p);
        numbers[levels::MERGED] += cell.merge();
        const float g = u.elevation[b * cells + c];
        for (int64_t l = 0; l < u.L; l++) {
            const int64_t q = l * cells;
            if (!(cell.support[q] > 0)) continue;
            if (u.validity[b * cells + c] && levels::distance(cell.lower[q], cell.upper[q], g, g) < 0.5f * u.min_gap) {
                cell.remove(l), numbers[levels::MERGED]++;
            } else if (cell.time[q] > u.min_time) {
                for (const levels::Sight& sight : own.sights)
                    if (sight.passes(own.x[c / u.W], own.y[c % u.W], cell.lower[q], cell.upper[q], cell.variance[q], sights.size)) {
                        cell.remove(l), numbers[levels::CLEARED]++;
                        break;
                    }
            }
        }
    }

    void put_aside() const {
        if (!statistics[levels::CHOSEN]) return;
        for (int64_t m = 0; m < M; m++) {
            const int32_t c = own.points.cell[m];
            if (c >= 0 && own.changed[c]) u.aside[b * M + m] = 1;
        }
    }
};

}  // namespace

extern "C" int update_levels(const Update* u, int num_threads) {
    return code_of([&] {
        for_environments(u->B, num_threads, [&](int64_t b, int threads) {
            static thread_local levels::Scratch own;  // kept: pages that are new each time would take as long as the points
            MapUpdate(*u, b, threads, own).run();
        });
    });
}
