// Which work is a thread's: `number` pieces in each of some rows, a whole number of blocks for each row.
#pragma once

struct Place {
    int64_t row, k;
};

inline Place place(int64_t number) {
    const unsigned blocks = (unsigned(number) + blockDim.x - 1) / blockDim.x;  // divisions of 64 bits are slow
    const unsigned block = unsigned(blockIdx.x);
    return {block / blocks, int64_t(block % blocks) * blockDim.x + threadIdx.x};
}

// Add the values of a warp's threads, all of which must call this, to one number.
inline void add_of_warp(int64_t* total, int32_t value) {
    for (int step = warpSize / 2; step > 0; step /= 2) value += __shfl_xor_sync(0xffffffff, value, step);
    if (threadIdx.x % warpSize == 0 && value) atomicAdd(reinterpret_cast<unsigned long long*>(total), value);
}

// Take places for what a warp's threads bring, all of which must call this; return where this thread's begin.
inline int32_t take_places(int32_t* next, int32_t number) {
    const int32_t lane = threadIdx.x % warpSize, last = warpSize - 1;
    int32_t sum = number;  // of this thread and those before
    for (int step = 1; step < warpSize; step *= 2) {
        const int32_t before = __shfl_up_sync(0xffffffff, sum, step);
        sum += lane >= step ? before : 0;
    }
    const int32_t first = lane == last && sum ? atomicAdd(next, sum) : 0;
    return __shfl_sync(0xffffffff, first, last) + sum - number;
}

// The values of a warp's threads, all of which must call this, put together.
template <class Value, class Combine> inline Value of_warp(Value value, const Combine& combine) {
    for (int step = warpSize / 2; step > 0; step /= 2) value = combine(value, __shfl_xor_sync(0xffffffff, value, step));
    return value;
}

// Memory that the threads of a block share: as much as the launch asks for.
inline int32_t* block_memory() {
    extern __shared__ int32_t memory[];
    return memory;
}

// The sum of what a block's threads bring, the same for all; all must call it, with memory for a number of each warp.
template <class Value> inline Value sum_of_block(Value value, Value* sums) {
    for (int step = warpSize / 2; step > 0; step /= 2) value += __shfl_xor_sync(0xffffffff, value, step);
    __syncthreads();
    if (threadIdx.x % warpSize == 0) sums[threadIdx.x / warpSize] = value;
    __syncthreads();
    Value total = 0;
    for (int32_t warp = 0; warp < blockDim.x / warpSize; warp++) total += sums[warp];
    return total;
}
