// Which rays are accepted, and their places in the polar table: `accepted_rays` and `bins_of`.
#pragma once

#include "stages/visibility/horizon.h"
#include "stages/visibility/table.h"

namespace visibility {

class AcceptedRays {
    static constexpr int TOGETHER = 16;  // vectors that are looked up one after the other, so that memory is read ahead
    const Sensor& sensor;
    const Ground& ground;
    const Horizon& horizon;

    // Rays, and where what limits them is found.
    struct Seen {
        Ray<Lanes> ray;
        RayEnds<Lanes> end;
        Flags casts, overhang, limit, floor;
        Lanes noise, limit_found, floor_found;
    };

  public:
    AcceptedRays(const Sensor& sensor, const Ground& ground, const Horizon& horizon)
        : sensor(sensor), ground(ground), horizon(horizon) {}

    // Put the accepted rays into a table. Their order does not matter.
    void put_into(Table& table) const {
        std::mutex mutex;
        sensor.u.each(sensor.number, RAYS_AT_A_TIME, [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t n = begin; n < end; n += RAYS_AT_A_TIME) {
                Entry entries[RAYS_AT_A_TIME + LANES];
                const int64_t number = find(n, std::min(end, n + RAYS_AT_A_TIME), entries);
                const std::lock_guard<std::mutex> lock(mutex);
                table.lower(entries, number);
            }
        });
    }

  private:
    // Write the entries of rays that are accepted; return how many. There is room for all, and a vector.
    int64_t find(int64_t begin, int64_t end, Entry* entries) const {
        int64_t number = 0;
        Seen seen[TOGETHER];
        for (int64_t n = begin; n < end; n += TOGETHER * LANES) {
            int count = 0;
            each_vector(n, std::min(end, n + TOGETHER * LANES), sensor.number,
                        [&](int64_t k, auto size) { count += see(k, size, seen[count]); });
            for (int k = 0; k < count; k++) {
                seen[k].limit_found = horizon.limit(seen[k].limit);
                seen[k].floor_found = ground.floor_at(seen[k].floor);
            }
            for (int k = 0; k < count; k++) number += accept(seen[k], entries + number);
        }
        return number;
    }

    template <class Count> bool see(int64_t n, Count count, Seen& seen) const {
        seen.casts = sensor.casts(n, count);
        if (!any(seen.casts)) return false;
        seen.ray = sensor.ray(n, count);
        seen.end = find_ends(seen.ray, sensor.view, sensor.s);
        seen.limit = horizon.place(seen.ray, seen.casts);
        seen.floor = ground.place(seen.end, seen.casts);
        seen.overhang = !sensor.used(n, count);
        seen.noise = sensor.noise(n, count);
        return true;
    }

    int accept(const Seen& seen, Entry* entries) const {
        const VisibilitySettings& s = sensor.s;
        const Flags casts = seen.casts & (seen.limit_found + seen.ray.slope >= 0);
        const Lanes near = any(seen.end.leaves) ? ground.near(seen.end, casts & seen.end.leaves) : splat(s.nowhere);
        const CredibleEnd<Lanes> credible =
            has_credible_end(seen.ray, seen.end, seen.floor_found, near, seen.overhang, sensor.view, s);
        const RayBins<Lanes> bins = bins_of(seen.ray, seen.noise, s);
        return pack(casts & credible.well & (bins.range >= 0), bins, credible.slope, entries);
    }

    static int pack(Flags accepted, const RayBins<Lanes>& bins, Lanes slope, Entry* entries) {
        const Flags ranges = integers(bins.range), azimuths = integers(bins.azimuth);
        int32_t flag[LANES], range[LANES], azimuth[LANES];
        float slopes[LANES];
        std::memcpy(flag, &accepted, sizeof flag), std::memcpy(slopes, &slope, sizeof slopes);
        std::memcpy(range, &ranges, sizeof range), std::memcpy(azimuth, &azimuths, sizeof azimuth);
        int number = 0;
        for (int l = 0; l < LANES; l++) entries[number] = {range[l], azimuth[l], slopes[l]}, number -= flag[l];
        return number;
    }
};

}  // namespace visibility
