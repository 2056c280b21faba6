// Measuring a scan: where its points lie, and what its rays saw.
#pragma once

#include "levels/kernel/map.h"

namespace levels {

struct Scan : Map {
    using Map::Map;

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

    void measure_block(int64_t begin, int64_t number, const places::Frame& of_sensor, const SightGrid& of_map) {
        const places::Frame frame = of_sensor;  // copies that nothing else can change: the loops become vectors
        const SightGrid size = of_map;
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
            rho[n] = horizontal(dx, dy), slope[n] = dz / std::max(rho[n], 1e-12f);
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
            Sight& sight = own.sights[task / 2];
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
        own.number.assign(cells, 0), own.touched.clear(), own.touched.reserve(std::min(cells, M));
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
};

}  // namespace levels
