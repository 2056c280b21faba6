// The cost to go by Dijkstra's algorithm, and the descent along it: planning/solvers/dijkstra.py.

#include <functional>
#include <queue>
#include <utility>

#include "kernels/threads.h"
#include "steps.h"

namespace {

// The lowest cost to go comes first; cells are counted with the rim.
template <class T> using Entry = std::pair<T, int32_t>;
template <class T> using Queue = std::priority_queue<Entry<T>, std::vector<Entry<T>>, std::greater<>>;

template <class T>
void find_costs(const T* cost, const bool* goal, T* value, int64_t H, int64_t W, double resolution) {
    const Steps<T> steps(cost, H, W, resolution);
    const T infinity = std::numeric_limits<T>::infinity();
    std::vector<T> lowest(steps.cost.size(), infinity);
    Queue<T> queue;
    const auto offer = [&](int64_t cell, T total) {
        if (total < lowest[cell]) queue.emplace(lowest[cell] = total, int32_t(cell));
    };
    for (int64_t k = 0; k < H * W; k++) {
        const int64_t cell = (k / W + 1) * (W + 2) + k % W + 1;
        if (goal[k] && steps.cost[cell] < infinity) offer(cell, 0);
    }
    while (!queue.empty()) {
        const auto [total, cell] = queue.top();
        queue.pop();
        if (total > lowest[cell]) continue;  // it was offered less since
        steps.around(cell, [&, total = total](int64_t neighbour, T step) { offer(neighbour, total + step); });
    }
    for (int64_t k = 0; k < H * W; k++) value[k] = lowest[(k / W + 1) * (W + 2) + k % W + 1];
}

// Follow the neighbour with the lowest sum, the first of equal ones. A cell that leads nowhere is repeated.
template <class T>
void follow(const T* value, const T* cost, int64_t* path, int64_t H, int64_t W, int64_t K, double resolution) {
    const Steps<T> steps(cost, H, W, resolution);
    const std::vector<T> to_go = rimmed(value, H, W, std::numeric_limits<T>::infinity());
    int64_t cell = (path[0] / W + 1) * (W + 2) + path[0] % W + 1;
    for (int64_t k = 1; k < K; k++) {
        T best = std::numeric_limits<T>::infinity();
        int64_t next = cell;
        const auto offer = [&](int64_t neighbour, T step) {
            const T total = to_go[neighbour] + step;
            if (total < best) best = total, next = neighbour;
        };
        if (to_go[cell] > 0) steps.around(cell, offer);
        cell = next;
        path[k] = (cell / (W + 2) - 1) * W + cell % (W + 2) - 1;
    }
}

template <class T>
int cost_to_go(const T* cost, const bool* goal, T* value, int64_t B, int64_t H, int64_t W, double resolution,
               int num_threads) {
    return code_of([&] {
        for_each(int(B), num_threads, [&](int64_t b) {
            find_costs(cost + b * H * W, goal + b * H * W, value + b * H * W, H, W, resolution);
        });
    });
}

template <class T>
int descend(const T* value, const T* cost, int64_t* path, int64_t B, int64_t H, int64_t W, int64_t K, double resolution,
            int num_threads) {
    return code_of([&] {
        for_each(int(B), num_threads, [&](int64_t b) {
            checked(path[b * K], H * W);
            follow(value + b * H * W, cost + b * H * W, path + b * K, H, W, K, resolution);
        });
    });
}

}  // namespace

// The cost to go `value` (B, H, W) to the `goal` cells over ground of these costs. Returns what `code_of` does.
extern "C" int cost_to_go_float(const float* cost, const bool* goal, float* value, int64_t B, int64_t H, int64_t W,
                                double resolution, int num_threads) {
    return cost_to_go(cost, goal, value, B, H, W, resolution, num_threads);
}

extern "C" int cost_to_go_double(const double* cost, const bool* goal, double* value, int64_t B, int64_t H, int64_t W,
                                 double resolution, int num_threads) {
    return cost_to_go(cost, goal, value, B, H, W, resolution, num_threads);
}

// The numbers of the cells of each path (B, K), of which the first are given. Returns what `code_of` does.
extern "C" int descend_float(const float* value, const float* cost, int64_t* path, int64_t B, int64_t H, int64_t W,
                             int64_t K, double resolution, int num_threads) {
    return descend(value, cost, path, B, H, W, K, resolution, num_threads);
}

extern "C" int descend_double(const double* value, const double* cost, int64_t* path, int64_t B, int64_t H, int64_t W,
                              int64_t K, double resolution, int num_threads) {
    return descend(value, cost, path, B, H, W, K, resolution, num_threads);
}
