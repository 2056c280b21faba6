// Which rays are accepted, and their places in the polar table: `accepted_rays` and `bins_of`.
#pragma once

#include "stages/visibility/horizon.h"
#include "stages/visibility/table.h"

namespace visibility {

struct AcceptedRays {
    const Sensor& sensor;
    const Ground& ground;
    const Horizon& horizon;

    // Put the accepted ones of the rays `begin` to `end` into a table. Their order does not matter.
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
    int64_t find(int64_t begin, int64_t end, Entry* entries) const {
        int64_t number = 0;
        each_vector(begin, end, sensor.number, [&](int64_t n, auto count) { number += find_at(n, count, entries + number); });
        return number;
    }

    // Write the entries of rays that are accepted; return how many. There is room for all.
    template <class Count> int find_at(int64_t n, Count count, Entry* entries) const {
        const VisibilitySettings& s = sensor.s;
        Flags casts = sensor.casts(n, count);
        if (!any(casts)) return 0;
        Ray<Lanes> ray = sensor.ray(n, count);
        casts &= horizon.limit(ray, casts) + ray.slope >= 0;
        const RayEnds<Lanes> end = find_ends(ray, sensor.view, s);
        const Lanes near = any(end.leaves) ? ground.near(end, casts & end.leaves) : all(s.nowhere);
        const CredibleEnd<Lanes> credible = has_credible_end(ray, end, ground.floor_at(end, casts), near,
                                                             !sensor.used(n, count), sensor.view, s);
        const RayBins<Lanes> bins = bins_of(ray, sensor.noise(n, count), s);
        return pack(casts & credible.well & (bins.range >= 0), bins, credible.slope, entries);
    }

    static int pack(Flags accepted, const RayBins<Lanes>& bins, Lanes slope, Entry* entries) {
        const Flags range = integers(bins.range), azimuth = integers(bins.azimuth);
        int number = 0;
        for (int l = 0; l < LANES; l++) {
            entries[number] = {range[l], azimuth[l], slope[l]};
            number -= accepted[l];
        }
        return number;
    }
};

}  // namespace visibility
