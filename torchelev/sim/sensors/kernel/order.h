// The order in which robots are worked on.
#pragma once

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <vector>

// Robots on the same tile one after the other, while it is in the caches.
inline std::vector<int> order_by_tile(const int64_t* tiles, int B) {
    std::vector<int> order(B);
    std::iota(order.begin(), order.end(), 0);
    std::sort(order.begin(), order.end(), [&](int a, int b) { return tiles[a] < tiles[b]; });
    return order;
}
