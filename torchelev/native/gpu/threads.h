// Which work is a thread's: `number` pieces in each of some rows, a whole number of blocks for each row.
#pragma once

struct Place {
    int64_t row, k;
};

inline Place place(int64_t number) {
    const unsigned blocks = unsigned((number + blockDim.x - 1) / blockDim.x);  // divisions of 64 bits are slow
    const unsigned block = unsigned(blockIdx.x);
    return {block / blocks, int64_t(block % blocks) * blockDim.x + threadIdx.x};
}

// Add the values of a warp's threads, all of which must call this, to one number.
inline void add_of_warp(int64_t* total, int32_t value) {
    for (int step = warpSize / 2; step > 0; step /= 2) value += __shfl_xor_sync(0xffffffff, value, step);
    if (threadIdx.x % warpSize == 0 && value) atomicAdd(reinterpret_cast<unsigned long long*>(total), value);
}
