// Which work is a thread's: `number` pieces in each of some rows, a whole number of blocks for each row.
#pragma once

struct Place {
    int64_t row, k;
};

inline Place place(int64_t number) {
    const int64_t blocks = (number + blockDim.x - 1) / blockDim.x;
    return {blockIdx.x / blocks, blockIdx.x % blocks * blockDim.x + threadIdx.x};
}

// Add the values of a warp's threads, all of which must call this, to one number.
inline void add_of_warp(int64_t* total, int32_t value) {
    for (int step = warpSize / 2; step > 0; step /= 2) value += __shfl_down_sync(0xffffffff, value, step);
    if (threadIdx.x % warpSize == 0 && value) atomicAdd(reinterpret_cast<unsigned long long*>(total), value);
}
