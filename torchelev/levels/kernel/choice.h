// Making the surface that the robot reaches first the ground: `choose_surfaces`.
#pragma once

#include "levels/kernel/tidy.h"

namespace levels {

struct Choice : Tidying {
    using Tidying::Tidying;

    // Whether heights differ as those of two floors do.
    bool has_floors() const {
        constexpr int64_t LANES = 16;  // side by side: the compiler may not reorder extremes of numbers
        float highest[LANES], lowest[LANES];
        std::fill_n(highest, LANES, -INFINITE), std::fill_n(lowest, LANES, INFINITE);
        const float* elevation = ground.elevation;
        const uint8_t* known = ground.validity;
        for (int64_t c = 0; c < cells; c += LANES) {
            for (int64_t n = 0; n < std::min(LANES, cells - c); n++) {
                highest[n] = std::max(highest[n], known[c + n] ? elevation[c + n] : -INFINITE);
                lowest[n] = std::min(lowest[n], known[c + n] ? elevation[c + n] : INFINITE);
            }
        }
        const float height = *std::max_element(highest, highest + LANES) - *std::min_element(lowest, lowest + LANES);
        return s.overlap_radius > 0 && height > s.overlap_height;
    }

    void choose() {
        bool any = false;
        for (const std::vector<int32_t>& part : own.with_levels) any |= !part.empty();
        if (!any && !has_floors()) return;
        Search& search = own.search;
        begin_search();
        const Standing standing = search.find_standing(measured.base, own.x.data(), own.y.data());
        const bool strange = has_strange(standing);
        if (!search.enter(standing) && !strange) return;
        search.run(standing, strange);
        own.changed.assign(cells, 0);
        for (const Several& several : search.several) {
            if (several.first <= 0) continue;
            const int64_t c = (several.cell / search.pitch - 1) * W + several.cell % search.pitch - 1;
            swap(c, several.first - 1), own.changed[c] = 1, statistics[CHOSEN]++;
        }
        if (strange) demote_strange(standing);
    }

    // Give the search the surfaces of the window.
    void begin_search() {
        Search& search = own.search;
        search.max_step = s.max_step, search.rise = float(SLOPE * s.resolution), search.max_blind = s.max_blind;
        search.support = ground.support;
        search.start(H, W, int(L) + 1);
        for (int64_t i = 0; i < H; i++) {
            const uint8_t* known = ground.validity + i * W;
            const float* elevation = ground.elevation + i * W;
            float* __restrict to = &search.height[search.at(i, 0)];
            for (int64_t j = 0, size = W; j < size; j++) to[j] = known[j] ? elevation[j] : NAN;
        }
        for (const std::vector<int32_t>& part : own.with_levels)
            for (const int32_t c : part) add_levels(c);
    }

    void add_levels(int64_t c) {
        Search& search = own.search;
        Several& to = search.add(search.at(c / W, c % W));
        const bool waits = own.list[c] >= 0 && own.waiting[own.list[c]].number > 0;  // points will found its ground
        if (waits) search.height[to.cell] = own.waiting[own.list[c]].height;
        else to.firm = ground.support[c] >= SETTLED;
        const float height = to.height[0] = search.height[to.cell];
        const float number = waits ? own.waiting[own.list[c]].number : ground.support[c];
        const Cell cell = cell_at(place(c));
        for (int64_t l = 0; l < L; l++) {
            const int64_t q = l * cells;
            const bool is_dust = waits || ground.time[c] <= cell.time[q] || cell.lower[q] > height;
            const float rival = height == height && is_dust ? std::min(number, SETTLED) : 0;
            const bool is_there = cell.support[q] >= std::max(s.least_support, rival);
            to.height[l + 1] = is_there ? cell.upper[q] : NAN;
            to.firm |= uint16_t((cell.support[q] >= SETTLED) << (l + 1));
        }
    }

    // Call `work(c, i, j)` for the cells near the robot whose height is of another floor, until it returns true.
    template <class Work> bool for_strange(const Standing& standing, const Work& work) const {
        if (!standing.found || s.overlap_radius <= 0) return false;
        const float square = s.overlap_radius * s.overlap_radius;
        for (int64_t i = 0; i < H; i++) {
            const float x = own.x[i] - measured.base[0];
            if (x * x > square) continue;
            for (int64_t j = 0; j < W; j++) {
                const int64_t n = i * W + j;
                if (!(std::fabs(ground.elevation[n] - standing.height) > s.overlap_height) || !ground.validity[n]) continue;
                const float y = own.y[j] - measured.base[1];
                if (ground.time[n] > 0 && x * x + y * y <= square && work(i * W + j, i, j)) return true;
            }
        }
        return false;
    }

    bool has_strange(const Standing& standing) const {
        return for_strange(standing, [](int64_t, int64_t, int64_t) { return true; });
    }

    void demote_strange(const Standing& standing) {
        for_strange(standing, [&](int64_t c, int64_t i, int64_t j) {
            if (own.changed[c] || own.search.is_reached(own.search.at(i, j))) return false;
            cell_at(row[i] + column[j]).insert(ground_of(c), ground.time[c]);
            forget_ground(c), forget_space(row[i] + column[j]);
            return false;
        });
    }

    // Exchange the ground of a cell with a level.
    void swap(int64_t c, int64_t l) {
        const int64_t p = place(c), q = l * cells;
        const Cell cell = cell_at(p);
        const bool known = ground.validity[c];
        const Found old = ground_of(c);
        const float time = ground.time[c], support = std::max(ground.support[c], 1.0f);
        found_ground(c, l);
        if (known) {
            cell.lower[q] = cell.upper[q] = old.mean, cell.variance[q] = old.variance;
            cell.support[q] = support, cell.time[q] = time;
        }
        forget_space(p);
    }
};

}  // namespace levels
