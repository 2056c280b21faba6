// One robot's height scan at a time: scan/reading.py.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "kernels/threads.h"
#include "observations/kernel/scan.h"
#include "observations/kernel/scan_fill.h"

namespace scans {

enum Fill : int32_t { NONE, GROUND, LOWEST, UPPER_BOUND, INPAINT };  // of scan/kernel.py

constexpr int64_t FEW = 4096;  // points, which one thread reads before another one wakes up

// As `Scan` of scan/kernel.py.
struct Scan {
    const double *pose, *feet;  // (B, 4, 4); (B, K, 3), null around the base
    const int64_t* corner;      // (B, 2)
    const float *pattern, *elevation;
    const uint8_t* validity;
    const float* upper_bound;
    const uint8_t* bounded;
    const float* draws;  // null without noise
    float* values;       // (B, K P)
    uint8_t* valid;
    double resolution;
    int64_t environments, origins, points, height, width;
    int64_t top, left;  // rows and columns at either border that "ground" and "inpaint" leave out
    int32_t mode, alignment, fill, is_single, num_near, rings, noise_after_clip;
    float nominal_height, missing, clip, scale, noise;

    Cells<uint8_t> cells(const float* layer, const uint8_t* known, int64_t b) const {
        const int64_t first = b * height * width;
        return {layer + first, known + first, float(height), float(width), int(width)};
    }
};

// The points of one robot at a time, and what is read there; of a thread.
struct Robot {
    const Scan& scan;
    std::vector<float> offset_x, offset_y;  // [cells]
    std::vector<float> u, v, z, ground, is_valid, has_ground;
    Blocks blocks;
    Inpainted inpainted;
    int64_t b = 0, M;

    explicit Robot(const Scan& scan) : scan(scan), M(scan.origins * scan.points) {
        for (auto* values : {&u, &v, &z, &ground, &is_valid, &has_ground}) values->resize(M + LANES);
        offset_x.resize(scan.points + LANES), offset_y.resize(scan.points + LANES);
        const float resolution = float(scan.resolution);
        for (int64_t k = 0; k < scan.points; k++) {
            offset_x[k] = scan.pattern[2 * k] / resolution;
            offset_y[k] = scan.pattern[2 * k + 1] / resolution;
        }
    }

    const double* pose() const { return scan.pose + 16 * b; }

    void find_start(const double* place, int step, float (&start)[2]) const {
        for (int axis = 0; axis < 2; axis++)
            start[axis] = to_cells(place[axis * step], scan.corner[2 * b + axis], scan.resolution);
    }

    void place() {
        float x[2], y[2], start[2];
        (scan.is_single ? find_axes<float> : find_axes<double>)(pose(), scan.alignment, x, y);
        const int step = scan.feet ? 1 : 4;
        for (int64_t k = 0; k < scan.origins; k++) {
            const double* origin = scan.feet ? scan.feet + 3 * (b * scan.origins + k) : pose() + 3;
            find_start(origin, step, start);
            place_pattern(k * scan.points, start, x, y);
            std::fill_n(&z[k * scan.points], scan.points, float(origin[2 * step]));
        }
        std::fill_n(&u[M], int(LANES), std::numeric_limits<float>::quiet_NaN());
    }

    void place_pattern(int64_t first, const float (&start)[2], const float (&x)[2], const float (&y)[2]) {
        const bool is_world = scan.alignment == WORLD;
        for (int64_t k = 0; k < scan.points; k++) {
            const float along = offset_x[k], across = offset_y[k];
            u[first + k] = start[0] + (is_world ? along : turn(along, across, x[0], y[0]));
            v[first + k] = start[1] + (is_world ? across : turn(along, across, x[1], y[1]));
        }
    }

    void read_elevation() {
        const auto cells = scan.cells(scan.elevation, scan.validity, b);
        for (int64_t k = 0; k < M; k += LANES) {
            const Read found = read(cells, load(&u[k]), load(&v[k]), scan.mode);
            store(&ground[k], found.value);
            store(&is_valid[k], one_if(found.known & are_finite(load(&z[k]))));
        }
        has_ground = is_valid;
    }

    bool is_complete() const {
        return std::all_of(is_valid.begin(), is_valid.begin() + M, [](float valid) { return valid > 0; });
    }

    // Take heights from `find(u, v)` where none is known.
    template <class Find> void fill_by(const Find& find) {
        for (int64_t k = 0; k < M; k += LANES) {
            const Flags valid = load(&is_valid[k]) > 0;
            if (!any(~valid)) continue;
            const Read found = find(load(&u[k]), load(&v[k]));
            store(&ground[k], pick(valid, load(&ground[k]), found.value));
            store(&has_ground[k], one_if(valid | found.known));
        }
    }

    void fill() {
        const auto map = scan.cells(scan.elevation, scan.validity, b);
        if (scan.fill == GROUND) continue_ground(map);
        if (scan.fill == LOWEST) fill_with_lowest();
        if (scan.fill == INPAINT) inpaint(map);
        const Either either{map, scan.cells(scan.upper_bound, scan.bounded, b)};
        if (scan.fill == UPPER_BOUND) fill_by([&](Lanes u, Lanes v) { return read(either, u, v, scan.mode); });
    }

    void continue_ground(const Cells<uint8_t>& map) {
        float base[2];
        find_start(pose() + 3, 4, base);
        const float height = float(pose()[11]), z = std::isfinite(height) ? height : 0;
        const float top = float(scan.top), left = float(scan.left);
        blocks.average(map, int(scan.top), int(scan.left), z);
        const Read under = blocks.find(splat(base[0] - top), splat(base[1] - left), 0, SIZE_MAX, true);
        const size_t first = scan.mode == BILINEAR;  // as single cells the points were read before
        fill_by([&](Lanes u, Lanes v) {
            const Read near = blocks.find(u - top, v - left, first, scan.num_near, false);
            return Read{pick(near.known, near.value, under.value) + z, near.known | under.known};
        });
    }

    void fill_with_lowest() {
        float low = UNKNOWN;
        for (int64_t k = 0; k < M; k++) low = is_valid[k] > 0 ? std::min(low, ground[k]) : low;
        const Read lowest{splat(low < UNKNOWN ? low : 0), splat(low) < UNKNOWN};
        fill_by([&](Lanes, Lanes) { return lowest; });
    }

    void inpaint(const Cells<uint8_t>& map) {
        const Box limit{int(scan.top), int(scan.left), int(scan.height - scan.top), int(scan.width - scan.left)};
        const Box box = box_around(u, v, is_valid, M).grown(0, limit);
        if (box.is_empty()) return;
        inpainted.fill(map, box, limit, scan.rings);
        fill_by([&](Lanes u, Lanes v) { return read(inpainted.now, u, v, scan.mode); });
    }

    void finish() const {
        for (int64_t k = 0; k < M; k += LANES) {
            const int count = int(std::min<int64_t>(LANES, M - k));
            const Lanes z = load(&this->z[k]);
            Lanes value = z - load(&ground[k]) - scan.nominal_height;
            value = pick((load(&has_ground[k]) > 0) & are_finite(z), value, splat(scan.missing));
            const float* draws = scan.draws ? scan.draws + b * M + k : nullptr;
            const Lanes error = draws ? (2 * load(draws, count) - 1) * scan.noise : splat(0);
            value = scan.noise_after_clip ? clamp(value, -scan.clip, scan.clip) + error
                                          : clamp(value + error, -scan.clip, scan.clip);
            store(scan.values + b * M + k, value * scan.scale, count);
            store_bytes(scan.valid + b * M + k, (load(&is_valid[k]) > 0) & 1, count);
        }
    }

    void read_all() {
        place();
        read_elevation();
        if (scan.fill != NONE && !is_complete()) fill();
        finish();
    }
};

}  // namespace scans
