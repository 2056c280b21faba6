// Sort the points of a scan by their cell. The time depends on the number of points alone, not on that of cells.
#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "kernels/simd.h"
#include "stages/fusion/hits.h"

namespace fusion {

class SortedHits {
    static constexpr int64_t WORTH_A_THREAD = 16384;  // points
    Buffer<Hit> half_sorted, sorted;
    std::vector<int32_t> next;  // (parts, digits) numbers of hits, then where the next one goes
    std::vector<int64_t> found;  // (parts) cells

  public:
    Buffer<int32_t> slots, starts;  // of each cell that is hit; where its hits start; then where the last cell's end
    int64_t cells = 0;

    const Hit* hits() const { return sorted.data(); }

    // Sort by the lower half of the slots' digits, then by the upper half; points of a cell keep their order.
    void sort(const Update& u) {
        const Measurement& m = u.measurement;
        const int64_t parts = std::clamp<int64_t>(m.number / WORTH_A_THREAD, 1, u.threads);
        const Parts share{parts, int(parts)};
        int bits = 1;
        while (int64_t(1) << 2 * bits < u.cells()) bits++;
        const int32_t digits = 1 << bits;
        const int32_t* slot = m.slot.data();
        auto low = [=](int64_t k) { return slot[k] < 0 ? digits : slot[k] & (digits - 1); };  // those outside come last
        auto point = [&](int64_t k) { return Hit{slot[k], int32_t(k), m.z[k], m.noise[k]}; };
        place(share, m.number, digits + 1, half_sorted.resize(m.number), low, point);
        const Hit* half = half_sorted.data();
        auto high = [=](int64_t k) { return half[k].slot >> bits; };
        place(share, m.inside, digits, sorted.resize(m.inside + 1), high, [=](int64_t k) { return half[k]; });
        sorted[m.inside] = {0, 0, 0, 1};  // read for cells without points
        list_cells(share, m.inside);
    }

  private:
    // Put the hits in the order of their digits; those of equal digits keep theirs.
    template <class Digit, class Get>
    void place(const Parts& share, int64_t number, int32_t digits, Hit* to, const Digit& digit, const Get& hit) {
        next.assign(share.number * digits, 0);
        share(number, [&](int64_t part, int64_t first, int64_t last) {
            int32_t* count = &next[part * digits];
            for (int64_t k = first; k < last; k++) count[digit(k)]++;
        });
        int32_t total = 0;
        for (int32_t value = 0; value < digits; value++)
            for (int64_t part = 0; part < share.number; part++)
                total += std::exchange(next[part * digits + value], total);
        share(number, [&](int64_t part, int64_t first, int64_t last) {
            int32_t* place = &next[part * digits];
            for (int64_t k = first; k < last; k++) to[place[digit(k)]++] = hit(k);
        });
    }

    void list_cells(const Parts& share, int64_t number) {
        const Hit* hits = sorted.data();
        slots.resize(number + LANES), starts.resize(number + LANES + 1)[0] = 0;
        auto begin = [&](int64_t k) {  // of the cell that begins at or after hit k
            while (k > 0 && k < number && hits[k].slot == hits[k - 1].slot) k++;
            return k;
        };
        found.assign(share.number, 0);
        if (share.number > 1)
            share(number, [&](int64_t part, int64_t first, int64_t last) {
                first = begin(first), last = begin(last);
                int64_t total = 0;
                for (int64_t k = first; k < last; k++) total += k == first || hits[k].slot != hits[k - 1].slot;
                found[part] = total;
            });
        share(number, [&](int64_t part, int64_t first, int64_t last) {
            int64_t n = -1, own = 0;
            for (int64_t p = 0; p < part; p++) n += found[p];
            int32_t slot = -1;
            for (int64_t k = begin(first), end = begin(last); k < end; k++) {
                const bool is_new = hits[k].slot != slot;
                n += is_new, own += is_new, slot = hits[k].slot;
                slots[n] = slot, starts[n + 1] = int32_t(k + 1);
            }
            if (share.number == 1) found[0] = own;
        });
        cells = 0;
        for (int64_t of_part : found) cells += of_part;
        for (int64_t k = cells; cells && k < cells + LANES; k++)  // cells without points, to fill the last vector
            slots[k] = slots[cells - 1], starts[k + 1] = int32_t(number);
    }
};

}  // namespace fusion
