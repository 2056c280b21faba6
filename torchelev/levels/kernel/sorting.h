// Sorting the points of a scan into the ground and other surfaces: `sort_points`.
#pragma once

#include "levels/kernel/scan.h"

namespace levels {

constexpr int64_t FEW = 32;  // points that insertion sorts fastest
constexpr float SAME = 0.1f;

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

struct Sorting : Scan {
    using Scan::Scan;

    // Whether all points of a cell are its ground's, or could become it: most are.
    bool is_simple(int64_t c) const {
        if (own.had_levels[c]) return false;
        const float low = own.bottom[c], high = own.top[c];
        if (!ground.validity[c]) return high - low <= s.min_gap && !own.all_above[c] && !floats(c, low);
        const float g = ground.elevation[c];
        return g - low <= s.min_gap && high - g <= s.min_gap && !floats(c, g);
    }

    void sort_points() {
        own.is_aside.assign(M, 0);
        own.list.assign(cells, -1), own.complex.clear(), own.first.assign(1, 0);
        const int64_t most = std::min(cells, M);  // reserved at once: later updates allocate for more surfaces alone
        for (std::vector<int32_t>* values : {&own.complex, &own.first, &own.next}) values->reserve(most + 1);
        own.simple.resize(most), own.waiting.reserve(most), own.sorted.resize(M), own.clusters.resize(parts.number);
        parts(own.num_touched, [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t k = begin; k < end; k++) own.simple[k] = is_simple(own.touched[k]);
        });
        for (int64_t k = 0; k < own.num_touched; k++) {
            const int32_t c = own.touched[k];
            if (own.simple[k]) continue;
            own.list[c] = int32_t(own.complex.size()), own.complex.push_back(c);
            own.first.push_back(own.first.back() + own.number[c]);
        }
        own.waiting.assign(own.complex.size(), {0, 0});
        if (own.complex.empty()) return;
        own.next.assign(own.first.begin(), own.first.end() - 1);
        for (int64_t m = 0; m < M; m++) {
            const int32_t c = own.points.cell[m];
            if (c >= 0 && own.list[c] >= 0) own.sorted[own.next[own.list[c]]++] = int32_t(m);
        }
        std::atomic<int64_t> opened{0}, dropped{0};
        parts(int64_t(own.complex.size()), [&](int64_t part, int64_t begin, int64_t end) {
            int64_t of_part[STATISTICS] = {};
            for (int64_t k = begin; k < end; k++) {
                find_clusters(own.complex[k], own.first[k], own.first[k + 1], own.clusters[part]);
                sort_cell(own.complex[k], own.clusters[part], own.waiting[k], of_part);
            }
            opened += of_part[OPENED], dropped += of_part[DROPPED];
        });
        statistics[OPENED] += opened, statistics[DROPPED] += dropped;
    }

    // Sort points of a cell by height.
    void sort(int64_t begin, int64_t end) {
        const float* const z = measured.z.data();
        const auto is_lower = [&](int32_t a, int32_t c) { return z[a] < z[c]; };
        int32_t* const order = own.sorted.data();
        if (end - begin > FEW) {
            const auto comes_before = [&](int32_t a, int32_t c) { return z[a] == z[c] ? a < c : is_lower(a, c); };
            std::sort(order + begin, order + end, comes_before);  // stable, and without the memory of `std::stable_sort`
        } else {
            for (int64_t k = begin + 1; k < end; k++) {
                const int32_t m = order[k];
                int64_t to = k;
                for (; to > begin && is_lower(m, order[to - 1]); to--) order[to] = order[to - 1];
                order[to] = m;
            }
        }
    }

    // The clusters of a cell from below: `find_clusters`.
    void find_clusters(int32_t c, int64_t begin, int64_t end, std::vector<Cluster>& clusters) {
        const float* const z = measured.z.data();
        const bool has_gaps = own.top[c] - own.bottom[c] > s.min_gap;  // there may be some
        if (has_gaps) sort(begin, end);
        clusters.clear();
        for (int64_t k = begin; k < end; k++) {
            const int32_t m = own.sorted[k];
            if (k == begin || (has_gaps && z[m] - z[own.sorted[k - 1]] > s.min_gap)) {
                clusters.emplace_back();
                clusters.back().lower = has_gaps ? z[m] : own.bottom[c], clusters.back().upper = z[m];
                clusters.back().begin = k;
            }
            Cluster& last = clusters.back();
            const float w = 1 / measured.noise[m];
            last.upper = std::max(last.upper, z[m]), last.end = k + 1, last.number++;
            last.weight += w, last.lift += w * (z[m] - last.lower);
            last.above &= !own.points.used[m];
        }
    }

    // `_shows_ground`
    bool shows_ground(const std::vector<Cluster>& clusters, float g) const {
        const float part = 0.25f * s.min_gap;
        bool shows = false, solid = false;
        for (const Cluster& k : clusters) {
            shows |= k.lower <= g + SAME && k.upper >= g - SAME && k.lower >= g - part;
            shows |= k.upper < g - s.min_gap;
            solid |= k.lower < g - part && k.upper >= g - s.min_gap;
        }
        return shows && !solid;
    }

    // Sort the points of a cell, by their places in `sorted`: `sort_points`.
    void sort_cell(int64_t c, const std::vector<Cluster>& clusters, Waiting& waiting, int64_t* numbers) {
        const int64_t p = place(c);
        const Cell cell = cell_at(p);
        float g = ground.elevation[c];
        bool known = ground.validity[c];
        const bool ground_floats = known && floats(c, g);
        if (ground_floats && shows_ground(clusters, g)) {
            numbers[DROPPED] += cell.insert(ground_of(c), ground.time[c]);
            numbers[OPENED]++, known = false, forget_ground(c), is_open(p) = 0;
        }
        for (size_t rank = 0; rank < clusters.size() && rank < size_t(2 * (L + 1)); rank++) {
            const Found found = clusters[rank].found(s.variance_floor);
            const float to_ground = known ? distance(found.lower, found.upper, g, g) : INFINITE;
            int64_t nearest = 0;
            float to_level = INFINITE;
            for (int64_t l = 0; l < L; l++) {
                const int64_t q = l * cells;
                if (!(cell.support[q] > 0)) continue;
                const float away = distance(found.lower, found.upper, cell.lower[q], cell.upper[q]);
                if (cell.support[q] < SETTLED && away > SAME) continue;
                if (away < to_level) to_level = away, nearest = l;
            }
            if (to_ground <= s.min_gap && to_ground <= to_level) continue;
            if (to_level <= s.min_gap) {
                const bool is_below = !clusters[rank].above && found.lower < cell.lower[nearest * cells];
                const bool stands = !known && is_below && !floats(c, found.lower);
                cell.fuse(nearest, found, s.max_support);
                if (stands) found_ground(c, nearest), known = true, g = ground.elevation[c];
            } else {
                const bool above = known && found.lower > g;
                bool shown = known && !above ? ground_floats : (above && is_open(p)) || floats(c, found.lower);
                shown |= (!known && clusters[rank].above) || (s.by_gap && (known || rank > 0));
                if (!shown) {
                    if (!known && !(waiting.number > 0)) waiting = {found.mean, found.number};
                    continue;
                }
                numbers[DROPPED] += cell.insert(found, 0), numbers[OPENED]++;
            }
            for (int64_t k = clusters[rank].begin; k < clusters[rank].end; k++) own.is_aside[own.sorted[k]] = 1;
        }
    }
};

}  // namespace levels
