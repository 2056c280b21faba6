// A walk over the cells of a mask. Large maps are mostly unknown, and to read a mask costs less than to write layers.
#pragma once

#include "kernels/simd.h"
#include "kernels/update.h"

// Call `work(k, chosen, count)` for the vectors of cells some of which the mask has.
template <class Work> void for_chosen(const Update& u, const uint8_t* mask, const Work& work) {
    constexpr int64_t BLOCK = 256;
    u.each(u.cells(), 65536, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t begin = first; begin < last; begin += BLOCK) {
            const int64_t end = std::min(begin + BLOCK, last);
            if (!any_set(mask + begin, end - begin)) continue;
            for_vectors(begin, end, [&](int64_t k, auto count) { work(k, load_bytes(mask + k, count) > 0, count); });
        }
    });
}
