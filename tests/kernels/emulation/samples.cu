// Kernels that show what threads share, and others that are wrong.

#include <cstdint>

struct Pair {
    float scale;
    int64_t offset;
};

extern "C" __global__ void places(int32_t* out) {
    const int block = blockIdx.x + gridDim.x * (blockIdx.y + gridDim.y * blockIdx.z);
    const int thread = threadIdx.x + blockDim.x * (threadIdx.y + blockDim.y * threadIdx.z);
    out[block * blockDim.x * blockDim.y * blockDim.z + thread] += 1000 * block + thread;
}

extern "C" __global__ void scale(const float* __restrict__ in, float* __restrict__ out, Pair pair, int64_t number) {
    const int64_t k = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (k < number) out[k] = in[k] * pair.scale + pair.offset;
}

// The sum of a block by shuffles and static memory, and its values in reverse by memory that the launch asks for.
extern "C" __global__ __launch_bounds__(512, 2) void sum_and_reverse(const float* in, float* sums, double* reversed) {
    extern __shared__ __align__(16) double values[];
    __shared__ float warps[32];
    const int own = threadIdx.x, k = blockIdx.x * blockDim.x + own;
    float sum = in[k];
    for (int step = 16; step > 0; step /= 2) sum += __shfl_down_sync(0xffffffff, sum, step);
    if (own % 32 == 0) warps[own / 32] = sum;
    values[own] = in[k];
    __syncthreads();
    reversed[k] = values[blockDim.x - 1 - own];
    if (own < 32) {
        float total = own < blockDim.x / 32 ? warps[own] : 0;
        for (int step = 16; step > 0; step /= 2) total += __shfl_xor_sync(0xffffffff, total, step);
        if (own == 0) sums[blockIdx.x] = total;
    }
}

extern "C" __global__ void lanes(int32_t* out) {
    const int own = threadIdx.x;
    int32_t* of_thread = out + 8 * own;
    of_thread[0] = __shfl_sync(0xffffffff, own, 5);
    of_thread[1] = __shfl_xor_sync(0xffffffff, own, 3, 8);
    of_thread[2] = __shfl_down_sync(0xffffffff, own, 2, 8);
    of_thread[3] = __shfl_up_sync(0xffffffff, own, 1);
    of_thread[4] = int32_t(__ballot_sync(0xffffffff, own % 3 == 0));
    of_thread[5] = __any_sync(0xffffffff, own == 40);
    of_thread[6] = __all_sync(0xffffffff, own < 32);
    if (own % 32 >= 8) return;  // lanes that have returned are not waited for
    const unsigned team = own % 32 < 4 ? 0x0f : 0xf0;
    of_thread[7] = __shfl_sync(team, 10 * own, own % 32 < 4 ? 1 : 6);
}

extern "C" __global__ void atomics(const int32_t* in, int32_t* ints, float* sum, unsigned long long* wide) {
    const int32_t value = in[blockIdx.x * blockDim.x + threadIdx.x];
    const int32_t before = atomicAdd(&ints[0], 1);
    atomicAdd(&ints[1], before);
    atomicMin(&ints[2], value), atomicMax(&ints[3], value);
    atomicAdd(sum, 0.5f);
    atomicAdd(&wide[0], 1ull << 40), atomicMin(&wide[1], value), atomicMax(&wide[2], value);
}

extern "C" __global__ void reads_before_writing(int32_t* out) {
    __shared__ int32_t values[64];
    values[threadIdx.x] = threadIdx.x;
    out[threadIdx.x] = values[63 - threadIdx.x];  // without __syncthreads()
}

extern "C" __global__ void reads_what_none_wrote(int32_t* out) {
    extern __shared__ int32_t memory[];
    __shared__ int32_t values[64];
    out[threadIdx.x] = memory[threadIdx.x];
    out[64 + threadIdx.x] = values[threadIdx.x];
    values[threadIdx.x] = memory[threadIdx.x] = 1;
}

extern "C" __global__ void writes_beyond() {
    extern __shared__ int32_t memory[];
    memory[threadIdx.x] = 1;
}

extern "C" __global__ void parts_before_a_barrier(int32_t* out) {
    if (threadIdx.x % 32 < 16)
        __syncthreads();
    else
        out[threadIdx.x] = __shfl_xor_sync(0xffffffff, out[threadIdx.x], 16);
}

extern "C" __global__ void leaves_a_lane_out(int32_t* out) {
    out[threadIdx.x] = __shfl_xor_sync(0x0000ffff, 1, 1);
}

extern "C" __global__ void reads_a_lane_that_returned(int32_t* out) {
    if (threadIdx.x >= 16) return;
    out[threadIdx.x] = __shfl_xor_sync(0xffffffff, 1, 16);
}
