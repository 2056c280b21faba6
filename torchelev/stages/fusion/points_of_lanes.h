// The points of as many cells as a vector has numbers, one of each at a time.
#pragma once

#include "kernels/simd.h"
#include "stages/fusion/hits.h"

namespace fusion {

struct PointsOfLanes {
    typedef Lanes V;
    const Scan& scan;
    Flags first, count;  // places among the sorted hits
    int32_t longest;     // highest count
    Lanes number;

    template <class Use> void each(const Use& use) const {
        for (int32_t k = 0; k < longest; k++) {
            const Flags used = count > k, place = first + pick_int(used, k, Flags{});
            float z[LANES], noise[LANES], shared[LANES]{};
            for (int l = 0; l < LANES; l++) z[l] = scan.hits[place[l]].z, noise[l] = scan.hits[place[l]].noise;
            if (scan.has_shared())
                for (int l = 0; l < LANES; l++) shared[l] = scan.shared(scan.hits[place[l]].index);
            use(make_point(load(z), load(noise), load(shared), used, scan.s));
        }
    }
    template <class... Values> void add_up(Values&...) const {}
};

}  // namespace fusion
