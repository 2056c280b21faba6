// Which rays are accepted, and the lowest slope by range and azimuth: accepted_rays.py, clean_up.py.
#pragma once

#include "map.h"

struct Entries {
    Flags row, column;  // of the table; the row below its last one drops a ray
    Lanes slope;
};

// The places of LANES points from the n-th one.
inline Entries read_rays(const Map& map, int n) {
    const Sensor& s = map.sensor;
    const int count = std::min(LANES, s.N - n);
    float at_x[LANES] = {}, at_y[LANES] = {}, at_z[LANES] = {};
    int32_t is_cast[LANES] = {}, is_used[LANES] = {};
    for (int l = 0; l < count; l++) {
        at_x[l] = s.points[3 * (n + l)], at_y[l] = s.points[3 * (n + l) + 1], at_z[l] = s.points[3 * (n + l) + 2];
        is_cast[l] = -int32_t(s.casts[n + l]), is_used[l] = -int32_t(s.used[n + l]);
    }
    const Lanes px = load(at_x), py = load(at_y), pz = load(at_z);
    Flags casts, used;
    std::memcpy(&casts, is_cast, sizeof casts), std::memcpy(&used, is_used, sizeof used);
    const Lanes x = px - s.x, y = py - s.y, z = pz - s.z;
    const Lanes r = root(larger(x * x + y * y, all(1e-12f))), slope = z / r, azimuth = azimuth_fraction(x, y);
    const Flags overhang = casts & ~used;

    // Where they end, or leave the window.
    const float start_x = s.x + s.offset_x, start_y = s.y + s.offset_y;
    const float size_x = float(map.H * map.cfg.resolution), size_y = float(map.W * map.cfg.resolution);
    const Flags ahead_x = x > 0, ahead_y = y > 0;
    const Lanes room_x = pick(ahead_x, all(size_x - map.half - start_x), all(map.half - start_x));
    const Lanes room_y = pick(ahead_y, all(size_y - map.half - start_y), all(map.half - start_y));
    const Lanes share_x = room_x / pick(ahead_x, larger(x, all(1e-9f)), smaller(x, all(-1e-9f)));
    const Lanes share_y = room_y / pick(ahead_y, larger(y, all(1e-9f)), smaller(y, all(-1e-9f)));
    const Lanes end_x = start_x + x, end_y = start_y + y;
    const Flags leaves = (end_x < 0) | (end_x >= size_x) | (end_y < 0) | (end_y >= size_y);
    const Lanes share = pick(leaves, clamp(smaller(share_x, share_y), 0, 1), all(1));
    const Slots at = map.locate(s.x + share * x, s.y + share * y);
    const Flags through_x = share_x <= share_y, row = at.slot / map.W;
    const Flags side = through_x ? -ahead_x : 2 - ahead_y;
    const Flags border = side * map.border_length() + (through_x ? at.slot - row * map.W : row);

    // Whether they end credibly.
    const Lanes near = gather(map.borders.data(), border), reach = share * r;
    const Lanes height = s.z + reach * slope, deepest = s.z + r * smaller(slope, all(0));
    const Flags over = (gather(map.ground.data(), at.slot) < 0.5f * NOWHERE) &
                       (height >= gather(map.lowest.data(), at.slot));
    const Flags low = leaves & ~over & (deepest >= near - CLEARANCE);
    const Lanes raised = larger(slope, (near + CLEARANCE - s.z) / larger(reach, all(1e-6f)));
    const Flags well = (at.inside & (over | low)) | overhang;

    // Whether they pass below ground that was just hit.
    const Polar& p = map.polar;
    const float step = float(2 * map.cfg.resolution);
    const Lanes k = smaller(floor(r / step) - 1, all(float(p.near_ranges - 1)));
    const Lanes a = smaller(floor(azimuth * float(p.near_azimuths)), all(float(p.near_azimuths - 1)));
    const Flags place = __builtin_convertvector(larger(k, all(0)), Flags) * p.near_azimuths +
                        __builtin_convertvector(a, Flags);
    const Lanes limit = pick(k >= 0, gather(map.falls.data(), place), all(NO_FALL));
    const Flags accepted = casts & well & (limit + slope >= 0);

    const Lanes noise = root(load(s.variance + n, count));
    const Lanes last = smaller(floor((r - noise) / map.resolution), all(float(p.ranges + 1))) - 2;
    const Lanes column = smaller(floor(azimuth * float(p.azimuths)), all(float(p.azimuths - 1)));
    const Lanes kept = pick(accepted & (last >= 0), smaller(last, all(float(p.ranges))), all(float(p.ranges)));
    return {__builtin_convertvector(kept, Flags), __builtin_convertvector(column, Flags),
            pick(low & ~overhang, raised, slope)};
}
