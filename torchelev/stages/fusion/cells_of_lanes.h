// What layers hold of as many cells as a vector has numbers.
#pragma once

#include <algorithm>

#include "kernels/simd.h"

namespace fusion {

// The cells of a vector, in ascending order.
struct CellsOfLanes {
    const int32_t* slots;
    int number;    // that exist
    bool are_run;  // they lie side by side

    CellsOfLanes(const int32_t* slots, int64_t number)
        : slots(slots), number(int(std::min<int64_t>(number, LANES))),
          are_run(number >= LANES && slots[LANES - 1] - slots[0] == LANES - 1) {}

    Flags index() const {
        Flags lanes;
        std::memcpy(&lanes, slots, sizeof lanes);
        return lanes;
    }
    Lanes read(const float* layer) const { return are_run ? load(layer + *slots) : gather(layer, index()); }
    Flags read(const uint8_t* layer) const {
        return are_run ? load_bytes(layer + *slots, std::integral_constant<int, LANES>()) : gather(layer, index());
    }
    void write(float* layer, Lanes values) const {
        if (are_run) return store(layer + *slots, values);
        float each[LANES];
        store(each, values);
        for (int l = 0; l < number; l++) layer[slots[l]] = each[l];
    }
    // Write one value where flags are set.
    template <class Value> void set(Value* layer, Flags flags, Value value) const {
        int32_t each[LANES];
        std::memcpy(each, &flags, sizeof each);
        for (int l = 0; l < number; l++)
            if (each[l]) layer[slots[l]] = value;
    }
};

}  // namespace fusion
