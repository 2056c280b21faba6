// The steps between neighbouring cells of one map: cost_to_go.py.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

// The neighbours (i, j) of a cell in the order of `windows.AROUND`.
constexpr int AROUND[8][2] = {{-1, -1}, {-1, 0}, {-1, 1}, {0, -1}, {0, 1}, {1, -1}, {1, 0}, {1, 1}};

// A layer (H, W) with a rim of `fill`.
template <class T> std::vector<T> rimmed(const T* layer, int64_t H, int64_t W, T fill) {
    std::vector<T> result((H + 2) * (W + 2), fill);
    for (int64_t i = 0; i < H; i++)
        for (int64_t j = 0; j < W; j++) result[(i + 1) * (W + 2) + j + 1] = layer[i * W + j];
    return result;
}

template <class T> struct Steps {
    std::vector<T> cost;  // of each metre, (H + 2, W + 2)
    int64_t stride;
    T straight, diagonal;  // half a step's length

    Steps(const T* layer, int64_t H, int64_t W, double resolution)
        : cost(rimmed(layer, H, W, std::numeric_limits<T>::infinity())), stride(W + 2), straight(T(resolution / 2)),
          diagonal(T(std::sqrt(2.0) * resolution / 2)) {}

    // Call `visit(neighbour, step)` with each neighbour of a cell and the cost of the step, |ab| (c_a + c_b) / 2,
    // infinite where it cuts a corner.
    template <class Visit> void around(int64_t cell, const Visit& visit) const {
        for (const auto& [i, j] : AROUND) {
            const int64_t neighbour = cell + i * stride + j;
            const T sum = cost[cell] + cost[neighbour];
            const bool is_cut = i && j && std::isinf(cost[cell + i * stride] + cost[cell + j]);
            visit(neighbour, is_cut ? std::numeric_limits<T>::infinity() : sum * (i && j ? diagonal : straight));
        }
    }
};
