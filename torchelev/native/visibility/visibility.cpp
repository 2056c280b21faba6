// Visibility clean-up and upper bounds on a CPU: what torchelev/stages/visibility computes with tensors, the
// same to rounding. Names, units and equations are there; constants in capitals come from there.

#include "rays.h"

namespace {

// Apply the lowest rays to the cells of a row: clean_up.py.
void clear_row(Map& map, int i) {
    const Layers& s = map.layers;
    const Polar& polar = map.polar;
    const float sqrt_half = float(SQRT_HALF), min_time = float(map.cfg.min_time);
    const float x = (float(i) + map.sensor.center_x) * map.resolution - map.sensor.x;
    for (int j = 0; j < map.W; j += LANES) {
        const int count = std::min(LANES, map.W - j), c = i * map.W + j;
        float place[LANES];
        for (int l = 0; l < LANES; l++) place[l] = float(j + l);
        const Lanes columns = load(place);
        const Lanes y = (columns + map.sensor.center_y) * map.resolution - map.sensor.y;
        const Lanes rho = root(larger(all(x * x) + y * y, all(1e-12f)));
        const Lanes k = smaller(floor(rho / map.resolution), all(float(polar.ranges)));
        const Flags row = __builtin_convertvector(k, Flags);
        const Lanes azimuth = azimuth_fraction(all(x), y) * float(polar.azimuths);
        const Lanes width = gather(polar.width, row), entry = gather(polar.entry, row);
        Lanes a = floor(azimuth - 0.5f * width);
        const Lanes further = larger(floor(azimuth + 0.5f * width) - a + 1 - entry, all(0));
        const float azimuths = float(polar.azimuths);
        a = smaller(pick(a < 0, a + azimuths, a), all(azimuths - 1));
        Lanes b = a + further;
        b = pick(b < azimuths, b, b - azimuths);
        const Flags line = row * polar.azimuths;
        const Lanes lowest = smaller(gather(map.table.data(), line + __builtin_convertvector(a, Flags)),
                                     gather(map.table.data(), line + __builtin_convertvector(b, Flags)));
        const Flags found = lowest < NO_RAY;
        const Lanes slope = pick(found, lowest, all(0));
        const Lanes gx = load(s.gradient_x + c, count), gy = load(s.gradient_y + c, count);
        const Lanes along = absolute(slope - (gx * x + gy * y) / rho);
        const Lanes incidence = along / root((1 + slope * slope) * (1 + gx * gx + gy * gy));
        const Lanes height = map.sensor.z + slope * rho, fall = absolute(slope) * map.resolution;

        const Lanes depth = load(s.elevation + c, count) - height, variance = load(s.variance + c, count);
        const Lanes relief = root(variance + float(0.5 * map.cfg.resolution * (0.5 * map.cfg.resolution)));
        const Lanes margin = smaller(float(map.cfg.gate) * relief, all(NOWHERE));
        const Lanes rise = root(gx * gx + gy * gy) * map.half;
        const Flags gone = found & (depth > root(variance)) & (load(s.time + c, count) > min_time) &
                           ((incidence > float(map.cfg.min_incidence)) | (depth > margin + rise));
        const Flags refuted = found & (height < load(s.challenger + c, count) + sqrt_half * fall);
        float heights[LANES];
        int32_t is_gone[LANES], is_found[LANES], is_refuted[LANES];
        store(heights, height);
        std::memcpy(is_gone, &gone, sizeof gone), std::memcpy(is_found, &found, sizeof found);
        std::memcpy(is_refuted, &refuted, sizeof refuted);
        for (int l = 0; l < count; l++) {
            const bool is_valid = s.validity[c + l] && !is_gone[l], bounds = is_found[l] && !is_valid;
            const float bound = s.upper_bound[c + l];
            if (bounds) s.upper_bound[c + l] = s.bounded[c + l] && bound < heights[l] ? bound : heights[l];
            s.bounded[c + l] = bounds || (s.bounded[c + l] && !is_valid);
            if (is_refuted[l] || !is_valid) s.challenger_support[c + l] = 0;
            s.validity[c + l] = is_valid;
        }
    }
}

void cast_rays(Map& map, int num_threads) {
    const Polar& polar = map.polar;
    const int A = polar.azimuths, blocks = (map.sensor.N + LANES - 1) / LANES;
    const size_t cells = size_t(map.H) * map.W;
    map.lowest.resize(cells), map.ground.resize(cells), map.below.resize(cells);
    map.borders.resize(4 * map.border_length());
    map.falls.resize(size_t(polar.near_ranges) * polar.near_azimuths);
    map.table.assign(size_t(polar.ranges + 1) * A, NO_RAY);
    const int parts = num_threads;
    auto share = [&](int size, int part) { return int(int64_t(size) * part / parts); };

    for_each(parts, num_threads, [&](int part) {
        for (int i = share(map.H, part); i < share(map.H, part + 1); i++) map.read_row(i);
    });
    for_each(parts + 1, num_threads, [&](int part) {
        if (part == parts) map.read_borders();
        else map.read_falls(share(polar.near_azimuths, part), share(polar.near_azimuths, part + 1));
    });
    std::vector<Entries> entries(blocks);
    for_each(parts, num_threads, [&](int part) {
        for (int k = share(blocks, part); k < share(blocks, part + 1); k++) entries[k] = read_rays(map, k * LANES);
    });
    for_each(parts, num_threads, [&](int part) {  // each thread fills its own azimuths
        const int first = share(A, part), last = share(A, part + 1);
        for (const Entries& ray : entries)
            for (int l = 0; l < LANES; l++) {
                if (ray.row[l] >= polar.ranges || ray.column[l] < first || ray.column[l] >= last) continue;
                float& slope = map.table[size_t(ray.row[l]) * A + ray.column[l]];
                slope = std::min(slope, ray.slope[l]);
            }
        scan(map.table.data(), polar.ranges, A, first, last, true);
    });
    std::vector<float> copy;
    for (int k = 0; polar.num_levels && k < std::min(polar.widen[0], polar.ranges); k++)
        widen(&map.table[size_t(k) * A], k, polar, copy);
    for_each(parts, num_threads, [&](int part) {
        for (int i = share(map.H, part); i < share(map.H, part + 1); i++) clear_row(map, i);
    });
}

}  // namespace

// False without memory. Layers (B, H, W), of which the last four are changed; points (B, S, N, ...), origin (B, S, 3), offset and center (B, 2).
extern "C" bool clear_seen_through(const float* elevation, const float* variance, const float* support,
                                   const float* challenger, const float* time, const float* gradient_x,
                                   const float* gradient_y, bool* validity, uint8_t* challenger_support,
                                   float* upper_bound, bool* bounded, const float* points, const float* point_variance,
                                   const bool* used, const bool* casts, const float* origin, const float* offset,
                                   const float* center, const Polar* polar, const Settings* cfg, int B, int S, int N) {
    const int num_threads = cfg->num_threads;
    auto run = [&](int b, int threads) {
        const size_t c = size_t(b) * cfg->H * cfg->W;
        const Layers layers{elevation + c, variance + c, support + c, challenger + c, time + c, gradient_x + c,
                            gradient_y + c, validity + c, challenger_support + c, upper_bound + c, bounded + c};
        for (int s = 0; s < S; s++) {
            const size_t k = size_t(b) * S + s, n = k * N;
            const Sensor sensor{points + 3 * n, point_variance + n, used + n, casts + n, N, origin[3 * k],
                                origin[3 * k + 1], origin[3 * k + 2], offset[2 * b], offset[2 * b + 1],
                                center[2 * b], center[2 * b + 1]};
            Map map{*cfg, *polar, layers, sensor};
            cast_rays(map, threads);
        }
    };
    return succeeds([&] {
        if (B >= num_threads) for_each(B, num_threads, [&](int b) { run(b, 1); });
        else
            for (int b = 0; b < B; b++) run(b, num_threads);
    });
}
