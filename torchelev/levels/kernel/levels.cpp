// What an update does to levels: step.py, for float32 maps on a CPU.

#include "kernels/threads.h"
#include "levels/kernel/rays.h"
#include "levels/kernel/surfaces.h"
#include "levels/kernel/update.h"
#include "levels/kernel/ground.h"

namespace {

using levels::Cell, levels::Found, levels::INFINITE, levels::Points, levels::Update, places::TINY;
constexpr int64_t BLOCK = 64, FEW = 32;  // points that are measured at a time; points that insertion sorts fastest
constexpr float SAME = 0.1f;

// What a scan will found the ground of a cell with, where that is not known.
struct Waiting {
    float height, number;  // [m], of points; 0: nothing
};

// Memory of a thread, kept between updates.
struct Scratch {
    Points points;
    std::vector<levels::Sight> sights;
    std::vector<float> x, y, highest, lowest;  // centres of the cells [m], rays over them [m]
    std::vector<float> bottom, top;            // (H W) [m] of the scan's points
    std::vector<int32_t> number, list;         // (H W) of the scan's points; place in `complex`, -1 for none
    std::vector<uint8_t> all_above, changed;   // (H W)
    std::vector<uint8_t> had_levels;           // (H W) of the ring, before the scan
    std::vector<uint8_t> simple;               // of `touched`
    std::vector<int32_t> touched, complex, first, sorted;
    std::vector<Waiting> waiting;              // of `complex`
    std::vector<std::vector<int32_t>> with_levels;  // cells, of each part of the window
    levels::Search search;
};

// A cluster of points: clusters.py.
struct Cluster {
    float lower, upper, weight = 0, lift = 0, number = 0;
    bool above = true;
    int64_t begin, end;  // among the sorted points

    Found found(float variance_floor) const {
        const float mean = lower + lift / (weight > 0 ? weight : 1.0f);
        return {lower, upper, mean, std::max(1 / weight, variance_floor), number / weight, number};
    }
};

// The levels of one map in an update.
struct Map {
    const Update& u;
    int64_t b;
    Parts parts;
    Scratch& own;
    int64_t cells, M;
    float g2;  // [m^2] what the disagreement of scans adds to the variance of the ground
    levels::Sights sights;
    float base[3] = {};
    bool has_base = false;
    std::vector<int32_t> row, column;  // places of the window's cells in the ring
    int64_t statistics[levels::STATISTICS] = {};

    Map(const Update& u, int64_t b, int num_threads, Scratch& own)
        : u(u), b(b), parts{num_threads, num_threads}, own(own), cells(u.H * u.W), M(u.S * u.N),
          g2(u.disagreement[b] * u.disagreement[b]), sights{levels::SightGrid(u), own.sights, u.min_gap} {}

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

    // Places in the ring -------------------------------------------------------------------------------------------

    static int64_t ring(int64_t k, int64_t size) { return ((k % size) + size) % size; }
    int64_t place(int64_t c) const { return row[int32_t(c) / int32_t(u.W)] + column[int32_t(c) % int32_t(u.W)]; }

    Cell cell_at(int64_t p) const {
        const int64_t first = b * u.L * cells + p;
        return {u.lower + first, u.upper + first, u.level_variance + first, u.support + first, u.time + first, u.L, cells};
    }
    float& free_top(int64_t p) const { return u.free_top[b * cells + p]; }
    uint8_t& is_open(int64_t p) const { return u.is_open[b * cells + p]; }
    void forget_space(int64_t p) const { free_top(p) = -INFINITE, is_open(p) = 0; }

    struct Range {
        int64_t begin, end;
    };
    // Which rows or columns of a window were in it before.
    static Range staying(int64_t now, int64_t before, int64_t size) {
        const int64_t begin = std::clamp<int64_t>(before - now, 0, size), end = std::clamp<int64_t>(before - now + size, 0, size);
        return {begin, std::max(begin, end)};
    }

    // Call `work(j, p, number)` for the two stretches of a row whose cells lie side by side in the ring, too: from column
    // j of the window and place p.
    template <class Work> void for_stretches(int64_t i, const Work& work) const {
        const int64_t first = column[0], number = u.W - first;
        work(int64_t(0), row[i] + first, number);
        if (first > 0) work(number, int64_t(row[i]), first);
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
                           float dt, float added, float most) {
        for (int64_t first = 0; first < number; first += BLOCK) {
            const int64_t end = std::min(first + BLOCK, number);
            int32_t any = 0;
            for (int64_t p = first; p < end; p++) any |= support[p] > 0;
            for (int64_t p = first; any && p < end; p++) {  // mostly none
                const bool is_there = support[p] > 0;
                const float older = std::min(variance[p] + added, most);
                time[p] = time[p] + (is_there ? dt : 0.0f), variance[p] = is_there ? older : variance[p];
            }
        }
    }

    static void note_levels(const float* support, uint8_t* __restrict had, int64_t number) {
        for (int64_t p = 0; p < number; p++) had[p] |= support[p] > 0;
    }

    void blank(int64_t p) const {
        for (int64_t l = 0; l < u.L; l++) cell_at(p).remove(l);
        forget_space(p);
    }

    // The scan ---------------------------------------------------------------------------------------------------

    void measure(const places::Origin& origin) {
        own.points.resize(M);
        bool is_sound = origin.is_sound;
        for (int64_t k = 0; k < 12 * u.S; k++) is_sound &= std::isfinite(u.T_map_sensor[16 * (b * u.S + k / 12) + k % 12]);
        has_base = origin.has_base && is_sound;
        std::copy_n(origin.base, 3, base);
        for (int64_t s = 0; s < u.S; s++) {
            const places::Frame frame(u, b, u.T_map_sensor + 16 * (b * u.S + s), origin);
            std::copy_n(frame.t, 3, own.sights[s].origin);
            if (!is_sound) {
                std::fill_n(own.points.cell.begin() + s * u.N, u.N, -1), std::fill_n(own.points.casts.begin() + s * u.N, u.N, 0);
                continue;
            }
            const int64_t blocks = (u.N + BLOCK - 1) / BLOCK;
            parts(blocks, [&](int64_t, int64_t begin, int64_t end) {
                for (int64_t k = begin; k < end; k++)
                    measure_block(s * u.N + k * BLOCK, std::min(BLOCK, u.N - k * BLOCK), frame, sights.size);
            });
        }
        const int64_t* anchor = origin.anchor;
        own.x.resize(u.H), own.y.resize(u.W);
        const int64_t sizes[] = {u.H, u.W};
        for (int axis = 0; axis < 2; axis++) {
            const int64_t away = std::clamp(u.corner[2 * b + axis] - anchor[axis], -places::FAR, places::FAR);
            std::vector<float>& centers = axis ? own.y : own.x;
            for (int64_t k = 0; k < sizes[axis]; k++)
                centers[k] = (float(k) + (float(away) + 0.5f)) * float(u.resolution);
        }
    }

    void measure_block(int64_t begin, int64_t number, const places::Frame& of_sensor, const levels::SightGrid& of_map) {
        const places::Frame frame = of_sensor;  // copies that nothing else can change: the loops become vectors
        const levels::SightGrid size = of_map;
        const int64_t first = b * M + begin;
        const float *p = u.points + 3 * first, *variance = u.variance ? u.variance + first : nullptr;
        const uint8_t* is_own = u.own ? u.own + first : nullptr;
        float x[BLOCK] = {}, y[BLOCK] = {}, z[BLOCK] = {}, ax[BLOCK], ay[BLOCK], az[BLOCK], noise[BLOCK];
        float rho[BLOCK], slope[BLOCK];
        int32_t cell[BLOCK], direction[BLOCK], reach[BLOCK];
        uint8_t casts[BLOCK], above[BLOCK] = {};
        for (int64_t n = 0; n < number; n++) x[n] = p[3 * n], y[n] = p[3 * n + 1], z[n] = p[3 * n + 2];
        for (int64_t n = 0; n < BLOCK; n++) {
            const float d2 = x[n] * x[n] + y[n] * y[n] + z[n] * z[n];
            casts[n] = (d2 >= frame.nearest2) & (d2 <= frame.farthest2);
            frame.place(x[n], y[n], z[n], ax[n], ay[n], az[n], cell[n], noise[n]);
        }
        for (int64_t n = 0; variance && n < number; n++) {
            casts[n] &= (variance[n] >= TINY) & (variance[n] < INFINITE);
            noise[n] = casts[n] ? variance[n] : 1.0f;
        }
        for (int64_t n = 0; !u.own && u.has_box && u.T_map_base && n < BLOCK; n++)
            casts[n] &= !frame.is_inside(ax[n], ay[n], az[n], u.box);
        for (int64_t n = 0; is_own && n < number; n++) casts[n] &= !is_own[n];
        for (int64_t n = 0; u.has_ramp && n < BLOCK; n++) above[n] = frame.is_above(ax[n], ay[n], az[n], u.ramp);
        for (int64_t n = 0; n < BLOCK; n++) {
            const float dx = casts[n] ? ax[n] - frame.t[0] : 0, dy = casts[n] ? ay[n] - frame.t[1] : 0;
            const float dz = casts[n] ? az[n] - frame.t[2] : 0;
            const int32_t azimuth = size.azimuth_bin(dx, dy);
            rho[n] = levels::horizontal(dx, dy), slope[n] = dz / std::max(rho[n], 1e-12f);
            direction[n] = size.elevation_bin(rho[n], dz) * size.azimuths + azimuth;
            reach[n] = size.range_bin(rho[n]) * size.azimuths + azimuth;
        }
        Points& to = own.points;
        for (int64_t n = 0; n < number; n++) {
            const int64_t m = begin + n;
            to.z[m] = az[n], to.noise[m] = noise[n], to.rho[m] = rho[n], to.slope[m] = slope[n];
            to.direction[m] = direction[n], to.reach[m] = reach[n];
            to.cell[m] = casts[n] ? cell[n] : -1, to.casts[m] = casts[n], to.above[m] = above[n];
        }
    }

    // Make the tables of the rays, and the extremes of the points of each cell.
    void look() {
        for_each(int(2 * u.S + 1), parts.num_threads, [&](int task) {
            if (task == 2 * u.S) return span_cells();
            levels::Sight& sight = own.sights[task / 2];
            const int64_t begin = (task / 2) * u.N, end = begin + u.N;
            if (task % 2) sight.look_for_nearest(own.points, begin, end, sights.size);
            else sight.look_for_slopes(own.points, begin, end, sights.size);
        });
        own.highest.resize(cells), own.lowest.resize(cells);
        parts(u.H, [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t i = begin; i < end; i++)
                sights.heights(own.x[i], own.y.data(), u.W, &own.highest[i * u.W], &own.lowest[i * u.W]);
        });
    }

    void span_cells() {
        own.bottom.resize(cells), own.top.resize(cells), own.all_above.resize(cells);
        own.number.assign(cells, 0), own.touched.clear();
        for (int64_t m = 0; m < M; m++) {
            const int32_t c = own.points.cell[m];
            if (c < 0) continue;
            const float z = own.points.z[m];
            if (own.number[c]++ == 0) {
                own.touched.push_back(c), own.bottom[c] = own.top[c] = z, own.all_above[c] = own.points.above[m];
            } else {
                own.bottom[c] = std::min(own.bottom[c], z), own.top[c] = std::max(own.top[c], z);
                own.all_above[c] &= own.points.above[m];
            }
        }
    }

    // Sorting points into surfaces -------------------------------------------------------------------------------

    // Whether rays passed below a surface at height `top` over a cell: it hangs free.
    bool floats(int64_t c, float top) const {
        if (!(own.lowest[c] < top - levels::HEIGHTS[0] * u.min_gap)) return false;  // mostly
        return sights.are_free_below(own.x[c / u.W], own.y[c % u.W], top);
    }

    bool has_levels(int64_t p) const {
        bool any = false;
        for (int64_t l = 0; l < u.L; l++) any |= u.support[(b * u.L + l) * cells + p] > 0;
        return any;
    }

    // Whether all points of a cell are its ground's, or could become it: most are.
    bool is_simple(int64_t c) const {
        if (own.had_levels[place(c)]) return false;
        const float low = own.bottom[c], high = own.top[c];
        if (!u.validity[b * cells + c]) return high - low <= u.min_gap && !own.all_above[c] && !floats(c, low);
        const float g = u.elevation[b * cells + c];
        return g - low <= u.min_gap && high - g <= u.min_gap && !floats(c, g);
    }

    void sort_points() {
        std::fill_n(u.aside + b * M, M, 0);
        own.list.assign(cells, -1), own.complex.clear(), own.first.assign(1, 0);
        own.simple.resize(own.touched.size());
        parts(int64_t(own.touched.size()), [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t k = begin; k < end; k++) own.simple[k] = is_simple(own.touched[k]);
        });
        for (size_t k = 0; k < own.touched.size(); k++) {
            const int32_t c = own.touched[k];
            if (own.simple[k]) continue;
            own.list[c] = int32_t(own.complex.size()), own.complex.push_back(c);
            own.first.push_back(own.first.back() + own.number[c]);
        }
        own.waiting.assign(own.complex.size(), {0, 0});
        if (own.complex.empty()) return;
        own.sorted.resize(own.first.back());
        std::vector<int32_t> next(own.first.begin(), own.first.end() - 1);
        for (int64_t m = 0; m < M; m++) {
            const int32_t c = own.points.cell[m];
            if (c >= 0 && own.list[c] >= 0) own.sorted[next[own.list[c]]++] = int32_t(m);
        }
        std::atomic<int64_t> opened{0}, dropped{0};
        parts(int64_t(own.complex.size()), [&](int64_t, int64_t begin, int64_t end) {
            int64_t of_part[levels::STATISTICS] = {};
            for (int64_t k = begin; k < end; k++)
                sort_cell(own.complex[k], own.first[k], own.first[k + 1], own.waiting[k], of_part);
            opened += of_part[levels::OPENED], dropped += of_part[levels::DROPPED];
        });
        statistics[levels::OPENED] += opened, statistics[levels::DROPPED] += dropped;
    }

    // The clusters of a cell from below: `find_clusters`.
    void find_clusters(int64_t begin, int64_t end, std::vector<Cluster>& clusters) {
        const std::vector<float>& z = own.points.z;
        const auto is_lower = [&](int32_t a, int32_t c) { return z[a] < z[c]; };
        int32_t* const order = own.sorted.data();
        if (end - begin > FEW) {
            std::stable_sort(order + begin, order + end, is_lower);
        } else {
            for (int64_t k = begin + 1; k < end; k++) {
                const int32_t m = order[k];
                int64_t to = k;
                for (; to > begin && is_lower(m, order[to - 1]); to--) order[to] = order[to - 1];
                order[to] = m;
            }
        }
        clusters.clear();
        for (int64_t k = begin; k < end; k++) {
            const int32_t m = own.sorted[k];
            if (k == begin || z[m] - z[own.sorted[k - 1]] > u.min_gap) {
                clusters.emplace_back();
                clusters.back().lower = z[m], clusters.back().begin = k;
            }
            Cluster& last = clusters.back();
            const float w = 1 / own.points.noise[m];
            last.upper = z[m], last.end = k + 1, last.weight += w, last.lift += w * (z[m] - last.lower), last.number++;
            last.above &= own.points.above[m];
        }
    }

    // `_shows_ground`
    bool shows_ground(const std::vector<Cluster>& clusters, float g) const {
        const float part = 0.25f * u.min_gap;
        bool shows = false, solid = false;
        for (const Cluster& k : clusters) {
            shows |= k.lower <= g + SAME && k.upper >= g - SAME && k.lower >= g - part;
            shows |= k.upper < g - u.min_gap;
            solid |= k.lower < g - part && k.upper >= g - u.min_gap;
        }
        return shows && !solid;
    }

    // The ground as a surface: `_as_found`.
    Found ground_of(int64_t c) const {
        const int64_t n = b * cells + c;
        const float g = u.elevation[n], variance = std::max(u.ground_variance[n] - g2, u.variance_floor);
        return {g, g, g, variance, variance, std::max(u.ground_support[n], u.min_support)};
    }

    // Make a level the ground of a cell that has none.
    void found_ground(int64_t c, int64_t l) const {
        const int64_t n = b * cells + c, p = place(c), q = l * cells;
        const Cell cell = cell_at(p);
        u.elevation[n] = cell.upper[q], u.ground_variance[n] = cell.variance[q] + g2;
        u.ground_support[n] = cell.support[q], u.ground_time[n] = cell.time[q];
        u.validity[n] = 1, u.bounded[n] = 0, u.challenger_support[n] = 0;
        cell.remove(l);
    }

    void forget_ground(int64_t c) const { u.validity[b * cells + c] = 0, u.challenger_support[b * cells + c] = 0; }

    // Sort the points of a cell, by their places in `sorted`: `_sort_points`.
    void sort_cell(int64_t c, int64_t begin, int64_t end, Waiting& waiting, int64_t* numbers) {
        static thread_local std::vector<Cluster> clusters;
        find_clusters(begin, end, clusters);
        const int64_t p = place(c);
        const Cell cell = cell_at(p);
        float g = u.elevation[b * cells + c];
        bool known = u.validity[b * cells + c];
        const bool ground_floats = known && floats(c, g);
        if (ground_floats && shows_ground(clusters, g)) {
            numbers[levels::DROPPED] += cell.insert(ground_of(c), u.ground_time[b * cells + c]);
            numbers[levels::OPENED]++, known = false, forget_ground(c), is_open(p) = 0;
        }
        for (size_t rank = 0; rank < clusters.size() && rank < size_t(2 * (u.L + 1)); rank++) {
            const Found found = clusters[rank].found(u.variance_floor);
            const float to_ground = known ? levels::distance(found.lower, found.upper, g, g) : INFINITE;
            int64_t nearest = 0;
            float to_level = INFINITE;
            for (int64_t l = 0; l < u.L; l++) {
                const int64_t q = l * cells;
                if (!(cell.support[q] > 0)) continue;
                const float away = levels::distance(found.lower, found.upper, cell.lower[q], cell.upper[q]);
                if (cell.support[q] < levels::SETTLED && away > SAME) continue;
                if (away < to_level) to_level = away, nearest = l;
            }
            if (to_ground <= u.min_gap && to_ground <= to_level) continue;
            if (to_level <= u.min_gap) {
                const bool stands = !known && found.lower < cell.lower[nearest * cells] && !floats(c, found.lower);
                cell.fuse(nearest, found, u.max_support);
                if (stands) found_ground(c, nearest), known = true, g = u.elevation[b * cells + c];
            } else {
                const bool above = known && found.lower > g;
                bool shown = known && !above ? ground_floats : (above && is_open(p)) || floats(c, found.lower);
                shown |= (!known && clusters[rank].above) || (u.by_gap && (known || rank > 0));
                if (!shown) {
                    if (!known && !(waiting.number > 0)) waiting = {found.mean, found.number};
                    continue;
                }
                numbers[levels::DROPPED] += cell.insert(found, 0), numbers[levels::OPENED]++;
            }
            for (int64_t k = clusters[rank].begin; k < clusters[rank].end; k++) u.aside[b * M + own.sorted[k]] = 1;
        }
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

    bool any_levels(int64_t p, int64_t number) const {
        int32_t any = 0;
        for (int64_t l = 0; l < u.L; l++) {
            const float* support = u.support + (b * u.L + l) * cells + p;
            for (int64_t n = 0; n < number; n++) any |= support[n] > 0;
        }
        return any;
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
            const float floor = space.ground[n];
            if (!space.known[n] || !(space.high[n] > std::max(top[n], floor) + step)) continue;  // mostly
            const int64_t c = first + n;
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

    // Choosing the ground ----------------------------------------------------------------------------------------

    // Whether heights differ as those of two floors do.
    bool has_floors() const {
        constexpr int64_t LANES = 16;  // side by side: the compiler may not reorder extremes of numbers
        float highest[LANES], lowest[LANES];
        std::fill_n(highest, LANES, -INFINITE), std::fill_n(lowest, LANES, INFINITE);
        const float* elevation = u.elevation + b * cells;
        const uint8_t* known = u.validity + b * cells;
        for (int64_t c = 0; c < cells; c += LANES) {
            for (int64_t n = 0; n < std::min(LANES, cells - c); n++) {
                highest[n] = std::max(highest[n], known[c + n] ? elevation[c + n] : -INFINITE);
                lowest[n] = std::min(lowest[n], known[c + n] ? elevation[c + n] : INFINITE);
            }
        }
        const float height = *std::max_element(highest, highest + LANES) - *std::min_element(lowest, lowest + LANES);
        return u.overlap_radius > 0 && height > u.overlap_height;
    }

    void choose() {
        bool any = false;
        for (const std::vector<int32_t>& part : own.with_levels) any |= !part.empty();
        if (!any && !has_floors()) return;
        levels::Search& search = own.search;
        begin_search();
        const levels::Standing standing = search.find_standing(base, own.x.data(), own.y.data());
        const bool strange = has_strange(standing);
        if (!search.enter(standing) && !strange) return;
        search.run(standing, strange);
        own.changed.assign(cells, 0);
        for (const levels::Several& several : search.several) {
            if (several.first <= 0) continue;
            const int64_t c = (several.cell / search.pitch - 1) * u.W + several.cell % search.pitch - 1;
            swap(c, several.first - 1), own.changed[c] = 1, statistics[levels::CHOSEN]++;
        }
        if (strange) demote_strange(standing);
    }

    // Give the search the surfaces of the window.
    void begin_search() {
        levels::Search& search = own.search;
        search.max_step = u.max_step, search.rise = float(levels::SLOPE * u.resolution), search.max_blind = u.max_blind;
        search.support = u.ground_support + b * cells;
        search.start(u.H, u.W, int(u.L) + 1);
        for (int64_t i = 0; i < u.H; i++) {
            const uint8_t* known = u.validity + b * cells + i * u.W;
            const float* elevation = u.elevation + b * cells + i * u.W;
            float* __restrict to = &search.height[search.at(i, 0)];
            const int64_t W = u.W;
            for (int64_t j = 0; j < W; j++) to[j] = known[j] ? elevation[j] : NAN;
        }
        for (const std::vector<int32_t>& part : own.with_levels)
            for (const int32_t c : part) add_levels(c);
    }

    void add_levels(int64_t c) {
        levels::Search& search = own.search;
        levels::Several& to = search.add(search.at(c / u.W, c % u.W));
        const bool waits = own.list[c] >= 0 && own.waiting[own.list[c]].number > 0;  // points will found its ground
        if (waits) search.height[to.cell] = own.waiting[own.list[c]].height;
        else to.firm = u.ground_support[b * cells + c] >= levels::SETTLED;
        const float ground = to.height[0] = search.height[to.cell];
        const float number = waits ? own.waiting[own.list[c]].number : u.ground_support[b * cells + c];
        const Cell cell = cell_at(place(c));
        for (int64_t l = 0; l < u.L; l++) {
            const int64_t q = l * cells;
            const bool is_dust = waits || u.ground_time[b * cells + c] <= cell.time[q] || cell.lower[q] > ground;
            const float rival = ground == ground && is_dust ? std::min(number, levels::SETTLED) : 0;
            const bool is_there = cell.support[q] >= std::max({u.min_support, 0.5f, rival});
            to.height[l + 1] = is_there ? cell.upper[q] : NAN;
            to.firm |= uint16_t((cell.support[q] >= levels::SETTLED) << (l + 1));
        }
    }

    // Call `work(c, i, j)` for the cells near the robot whose height is of another floor, until it returns true.
    template <class Work> bool for_strange(const levels::Standing& standing, const Work& work) const {
        if (!standing.found || u.overlap_radius <= 0) return false;
        const float square = u.overlap_radius * u.overlap_radius;
        for (int64_t i = 0; i < u.H; i++) {
            const float x = own.x[i] - base[0];
            if (x * x > square) continue;
            for (int64_t j = 0; j < u.W; j++) {
                const int64_t n = b * cells + i * u.W + j;
                if (!(std::fabs(u.elevation[n] - standing.height) > u.overlap_height) || !u.validity[n]) continue;
                const float y = own.y[j] - base[1];
                if (u.ground_time[n] > 0 && x * x + y * y <= square && work(i * u.W + j, i, j)) return true;
            }
        }
        return false;
    }

    bool has_strange(const levels::Standing& standing) const {
        return for_strange(standing, [](int64_t, int64_t, int64_t) { return true; });
    }

    void demote_strange(const levels::Standing& standing) {
        for_strange(standing, [&](int64_t c, int64_t i, int64_t j) {
            if (own.changed[c] || own.search.is_reached(own.search.at(i, j))) return false;
            cell_at(row[i] + column[j]).insert(ground_of(c), u.ground_time[b * cells + c]);
            forget_ground(c), forget_space(row[i] + column[j]);
            return false;
        });
    }

    // Exchange the ground of a cell with a level.
    void swap(int64_t c, int64_t l) {
        const int64_t n = b * cells + c, p = place(c), q = l * cells;
        const Cell cell = cell_at(p);
        const bool known = u.validity[n];
        const Found old = ground_of(c);
        const float time = u.ground_time[n], support = std::max(u.ground_support[n], 1.0f);
        found_ground(c, l);
        if (known) {
            cell.lower[q] = cell.upper[q] = old.mean, cell.variance[q] = old.variance;
            cell.support[q] = support, cell.time[q] = time;
        }
        forget_space(p);
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
            static thread_local Scratch own;  // kept: pages that are new each time would take as long as the points
            Map(*u, b, threads, own).run();
        });
    });
}
