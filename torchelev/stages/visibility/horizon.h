// The steepest fall that rays may have before they pass below recently hit ground: horizon.py, with the same names.
#pragma once

#include "stages/visibility/ground.h"

namespace visibility {

constexpr int64_t BINS_AT_A_TIME = 4096;  // that are worth a thread

// Memory of all sensors and maps.
struct HorizonMemory {
    Buffer<float> cosines, sines, steepest;
    Buffer<int32_t> rows;
    int azimuths = 0;  // of which there are cosines and sines
};

// A table of bins that are two cells long, and as wide; LANES azimuths lie side by side, range after range.
class Horizon {
    const Sensor& sensor;
    const Ground& ground;
    const VisibilitySettings& s;
    const float step;      // [m]
    const int azimuths, blocks;
    const int32_t ranges;  // that a ray needs, of any azimuth
    const float *cosines, *sines;
    float* steepest;
    int32_t* rows;         // that rays need, of each block of azimuths

  public:
    Horizon(const Sensor& sensor, const Ground& ground, float farthest, HorizonMemory& memory)
        : sensor(sensor), ground(ground), s(sensor.s), step(2 * s.resolution), azimuths(s.azimuths / 2),
          blocks((azimuths + LANES - 1) / LANES),
          ranges(int32_t(std::min(std::floor(farthest / step), float(s.horizon_ranges)))) {
        point(memory);
        steepest = aligned(memory.steepest, size_t(blocks) * (ranges + 1) * LANES);
        steepest[blocks * ranges * LANES] = s.no_fall;  // for rays that end in the first bins
        rows = memory.rows.resize(blocks);
        measure();
        sensor.u.each(blocks, std::max(int64_t(1), BINS_AT_A_TIME / (LANES * (ranges + 1))),
                      [&](int64_t, int64_t first, int64_t last) {
                          for (int64_t block = first; block < last; block++) march(block);
                      });
    }

    // Return where the steepest fall that rays which cast may have is found.
    Flags place(const Ray<Lanes>& ray, Flags casts) const {
        const Bins at = bins(ray);
        const Flags place = ((at.azimuth >> LANE_BITS) * ranges + at.range) * LANES + (at.azimuth & (LANES - 1));
        return pick_int(casts & (at.range >= 0), place, Flags{} + blocks * ranges * LANES);
    }

    Lanes limit(Flags place) const { return gather(steepest, place); }

  private:
    struct Bins {
        Flags range, azimuth;  // the last bin that limits a ray, negative if none
    };

    Bins bins(const Ray<Lanes>& ray) const {
        const RayBins<Lanes> at = horizon_bins_of(ray, s);
        return {integers(at.range), integers(at.azimuth)};
    }

    // Compute the azimuths' directions, once for all maps.
    void point(HorizonMemory& memory) {
        float* x = memory.cosines.resize(blocks * LANES);
        float* y = memory.sines.resize(blocks * LANES);
        cosines = x, sines = y;
        if (memory.azimuths == azimuths) return;
        for (int a = 0; a < blocks * LANES; a++) {
            const float angle = direction(a, azimuths);
            x[a] = std::cos(angle), y[a] = std::sin(angle);
        }
        memory.azimuths = azimuths;
    }

    // Find how many rows rays need, where that is less work than to fill all.
    void measure() {
        std::fill_n(rows, blocks, ranges);
        if (8 * sensor.number > int64_t(azimuths) * ranges) return;
        std::fill_n(rows, blocks, 0);
        each_vector(0, sensor.number, sensor.number, [&](int64_t n, auto count) {
            const Flags casts = sensor.casts(n, count);
            const Bins at = bins(sensor.ray(n, count));
            for (int l = 0; l < count; l++) {
                int32_t& reached = rows[at.azimuth[l] >> LANE_BITS];
                if (casts[l]) reached = std::max(reached, at.range[l] + 1);
            }
        });
    }

    // Write the running minimum of the falls -dz/dr along a block's azimuths.
    void march(int64_t block) const {
        const Lanes cosine = load(cosines + block * LANES), sine = load(sines + block * LANES);
        const float beyond = s.no_fall * step;
        float* entries = steepest + block * ranges * LANES;
        Lanes lowest = splat(std::numeric_limits<float>::infinity());
        for (int k = 0; k < rows[block]; k++) {
            const float rho = (float(k) + 0.5f) * step;
            const Lanes i = cell_of(sensor.view.origin[0] + rho * cosine, 0, sensor.view, s);
            const Lanes j = cell_of(sensor.view.origin[1] + rho * sine, 1, sensor.view, s);
            lowest = smaller(lowest, ground.below_sensor(i, j, beyond) / rho);
            store(entries + k * LANES, lowest);
        }
    }
};

}  // namespace visibility
