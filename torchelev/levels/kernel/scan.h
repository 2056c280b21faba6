// Where the points of a scan lie, and what its rays saw.
#pragma once

#include "levels/kernel/map.h"
#include "stages/window.h"

namespace levels {

struct Scan : Map {
    using Map::Map;

    void find_points() {
        find_centers();
        if (own.sights.size() < sights.number) own.sights.resize(sights.number);
        for (int64_t k = 0; k < S; k++) {
            std::copy_n(&measured.origin[3 * k], 3, own.sights[k].origin);
            own.sights[k].slopes.reserve(int64_t(s.ranges) * s.azimuths);
        }
        sights.size.ranges = std::min(sights.size.ranges, reach());
        own.points.resize(M), own.points.casts = measured.casts.data(), own.points.used = measured.used.data();
        const Window window(ground.corner, measured.anchor, u.sizes, float(s.resolution));
        const int64_t blocks = (N + BLOCK - 1) / BLOCK;
        for (int64_t sensor = 0; sensor < S; sensor++) {
            const float* const origin = own.sights[sensor].origin;
            parts(blocks, [&](int64_t, int64_t begin, int64_t end) {
                for (int64_t k = begin; k < end; k++)
                    find_block(sensor * N + k * BLOCK, std::min(BLOCK, N - k * BLOCK), origin, window, sights.size);
            });
        }
    }

    void find_centers() {
        const int64_t sizes[] = {H, W};
        for (int axis = 0; axis < 2; axis++) {
            std::vector<float>& centers = axis ? own.y : own.x;
            centers.resize(sizes[axis]);
            for (int64_t k = 0; k < sizes[axis]; k++)
                centers[k] = center_offset(ground.corner, measured.anchor, axis, k, float(s.resolution));
        }
    }

    // How many rows of the table of slopes the cells ask for: `row_behind`, and one that stays blank.
    int32_t reach() const {
        float farthest = 0;
        for (const Sight& sight : sights)
            for (const float x : {own.x.front(), own.x.back()})
                for (const float y : {own.y.front(), own.y.back()})
                    farthest = std::max(farthest, horizontal(x - sight.origin[0], y - sight.origin[1]));
        return sights.size.row_behind(farthest) + 2;
    }

    void find_block(int64_t begin, int64_t number, const float* origin, const Window& of_map, const SightGrid& of_rays) {
        const Window window = of_map;  // copies that nothing else can change: the loops become vectors
        const SightGrid size = of_rays;
        const float from[] = {origin[0], origin[1], origin[2]};
        float x[BLOCK] = {}, y[BLOCK] = {}, z[BLOCK] = {}, rho[BLOCK], slope[BLOCK];
        int32_t cell[BLOCK], direction[BLOCK], reach[BLOCK];
        uint8_t casts[BLOCK] = {};
        std::copy_n(&measured.x[begin], number, x), std::copy_n(&measured.y[begin], number, y);
        std::copy_n(&measured.z[begin], number, z), std::copy_n(&measured.casts[begin], number, casts);
        for (int64_t n = 0; n < BLOCK; n++) {
            const int32_t slot = window.slot(x[n], y[n]);
            cell[n] = casts[n] ? slot : -1;
            const float dx = casts[n] ? x[n] - from[0] : 0, dy = casts[n] ? y[n] - from[1] : 0;
            const float dz = casts[n] ? z[n] - from[2] : 0;
            const int32_t azimuth = size.azimuth_bin(dx, dy);
            rho[n] = horizontal(dx, dy), slope[n] = dz / std::max(rho[n], 1e-12f);
            direction[n] = size.elevation_bin(rho[n], dz) * size.azimuths + azimuth;
            reach[n] = size.range_bin(rho[n]) * size.azimuths + azimuth;
        }
        Points& to = own.points;
        std::copy_n(rho, number, &to.rho[begin]), std::copy_n(slope, number, &to.slope[begin]);
        std::copy_n(direction, number, &to.direction[begin]), std::copy_n(reach, number, &to.reach[begin]);
        std::copy_n(cell, number, &to.cell[begin]);
    }

    // Make the tables of the rays, and the extremes of the points of each cell.
    void look() {
        for_each(int(2 * S + 1), parts.num_threads, [&](int task) {
            if (task == 2 * S) return span_cells();
            Sight& sight = own.sights[task / 2];
            const int64_t begin = (task / 2) * N, end = begin + N;
            if (task % 2) sight.look_for_nearest(own.points, begin, end, sights.size);
            else sight.look_for_slopes(own.points, begin, end, sights.size);
        });
        own.highest.resize(cells), own.lowest.resize(cells);
        parts(H, [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t i = begin; i < end; i++)
                sights.heights(own.x[i], own.y.data(), W, &own.highest[i * W], &own.lowest[i * W]);
        });
    }

    void span_cells() {
        own.bottom.resize(cells), own.top.resize(cells), own.all_above.resize(cells);
        own.number.assign(cells, 0), own.touched.resize(cells + 1);
        for (int64_t m = 0; m < M; m++) {
            const int32_t c = own.points.cell[m];
            if (c < 0) continue;
            const float z = measured.z[m];
            const uint8_t above = !own.points.used[m];
            if (own.number[c]++ == 0) {
                own.bottom[c] = own.top[c] = z, own.all_above[c] = above;
            } else {
                own.bottom[c] = std::min(own.bottom[c], z), own.top[c] = std::max(own.top[c], z);
                own.all_above[c] &= above;
            }
        }
        int32_t* const touched = own.touched.data();
        const int32_t* const number = own.number.data();
        int64_t count = 0;
        for (int32_t c = 0; c < int32_t(cells); c++) touched[count] = c, count += number[c] > 0;
        own.num_touched = count;
    }
};

}  // namespace levels
