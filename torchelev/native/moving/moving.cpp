// Layers moved by whole cells, in place: ops/moving.py.

#include <algorithm>
#include <cstdint>
#include <cstring>

#include "kernels/threads.h"

namespace {

// Fill `count` cells of `size` bytes with a value of 4 or 8 bytes, or of one that is zero.
void fill(uint8_t* cells, int64_t count, int64_t size, double blank) {
    if (size == 4) std::fill_n(reinterpret_cast<float*>(cells), count, float(blank));
    else if (size == 8) std::fill_n(reinterpret_cast<double*>(cells), count, blank);
    else std::memset(cells, 0, count * size);
}

// Give cell (i, j) of H x W cells of `size` bytes what was at (i + di, j + dj), or `blank` if that lies outside.
void move(uint8_t* layer, int64_t H, int64_t W, int64_t size, int64_t di, int64_t dj, double blank) {
    const int64_t first = std::min(W, std::max<int64_t>(0, -dj)), last = std::max(first, std::min(W, W - dj));
    for (int64_t n = 0; n < H; n++) {
        const int64_t i = di >= 0 ? n : H - 1 - n;  // no row is overwritten before it is read
        uint8_t* row = layer + i * W * size;
        const bool enters = i + di < 0 || i + di >= H;
        const int64_t begin = enters ? W : first, end = enters ? W : last;
        if (begin < end) std::memmove(row + begin * size, row + ((di * W) + begin + dj) * size, (end - begin) * size);
        fill(row, begin, size, blank);
        fill(row + end * size, W - end, size, blank);
    }
}

}  // namespace

// Move `count` layers (B, H, W) with cells of sizes[k] bytes by shifts (B, 2), each environment by its own.
extern "C" int move_layers(const int64_t* shifts, uint8_t* const* layers, const int64_t* sizes, const double* blanks,
                           int64_t count, int64_t B, int64_t H, int64_t W, int num_threads) {
    auto move_one = [&](int64_t k) {
        const int64_t b = k / count, l = k % count, di = shifts[2 * b], dj = shifts[2 * b + 1];
        if (di != 0 || dj != 0) move(layers[l] + b * H * W * sizes[l], H, W, sizes[l], di, dj, blanks[l]);
    };
    return code_of([&] { for_each(B * count, num_threads, move_one); });
}
