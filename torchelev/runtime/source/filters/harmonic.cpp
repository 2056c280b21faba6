// Laplace's equation in holes, by conjugate gradients preconditioned by a multigrid cycle: filters/inpainting/harmonic.py.

#include <algorithm>
#include <cmath>

#include "runtime/source/filters/filters.h"
#include "tables.h"

namespace {

typedef std::vector<double> Numbers;

// The equations of one grid, and memory for a cycle.
struct Level {
    int64_t H, W;
    Numbers ahead, beside, sink, inverse;  // weights of edges along H, along W, to known cells; 1 / the diagonal
    Numbers u, right, rest;

    Level(int64_t H, int64_t W) : H(H), W(W) {
        for (Numbers* part : {&ahead, &beside, &sink, &inverse, &u, &right, &rest}) part->assign(H * W, 0);
    }

    void complete() {
        for (int64_t k = 0; k < H * W; k++) {
            double total = sink[k] + ahead[k] + beside[k];
            if (k >= W) total += ahead[k - W];
            if (k % W) total += beside[k - 1];
            inverse[k] = total > 0 ? 1 / total : 0;
        }
    }

    // rest = right - A x
    void find_rest(const Numbers& x, const Numbers& of, Numbers& out) const {
        for (int64_t k = 0; k < H * W; k++) out[k] = of[k] - sink[k] * x[k];
        for (int64_t k = 0; k < H * W; k++) {
            if (ahead[k] != 0) {
                const double flow = ahead[k] * (x[k + W] - x[k]);
                out[k] += flow, out[k + W] -= flow;
            }
            if (beside[k] != 0) {
                const double flow = beside[k] * (x[k + 1] - x[k]);
                out[k] += flow, out[k + 1] -= flow;
            }
        }
    }

    // The block of 2 x 2 cells of a cell, on the next coarser grid.
    int64_t block(int64_t k) const { return k / W / 2 * ((W + 1) / 2) + k % W / 2; }

    Level coarser() const {
        Level next((H + 1) / 2, (W + 1) / 2);
        for (int64_t k = 0; k < H * W; k++) {
            next.sink[block(k)] += sink[k];
            if (k / W % 2) next.ahead[block(k)] += ahead[k];
            if (k % W % 2) next.beside[block(k)] += beside[k];
        }
        next.complete();
        return next;
    }
};

class Solver {
    std::vector<Level> levels;

    // Solve A u = right approximately: a Jacobi sweep, the coarser grids, another sweep.
    void cycle(size_t n) {
        Level& level = levels[n];
        for (size_t k = 0; k < level.u.size(); k++)
            level.u[k] = (n + 1 == levels.size() ? 1 : DAMPING) * level.inverse[k] * level.right[k];
        if (n + 1 == levels.size()) return;
        level.find_rest(level.u, level.right, level.rest);
        Level& next = levels[n + 1];
        std::fill(next.right.begin(), next.right.end(), 0);
        for (size_t k = 0; k < level.u.size(); k++) next.right[level.block(int64_t(k))] += level.rest[k];
        cycle(n + 1);
        for (size_t k = 0; k < level.u.size(); k++)
            if (level.inverse[k] > 0) level.u[k] += OVERCORRECTION * next.u[level.block(int64_t(k))];
        level.find_rest(level.u, level.right, level.rest);
        for (size_t k = 0; k < level.u.size(); k++) level.u[k] += DAMPING * level.inverse[k] * level.rest[k];
    }

    const Numbers& precondition(const Numbers& rest) {
        levels[0].right = rest;
        cycle(0);
        return levels[0].u;
    }

  public:
    explicit Solver(Level finest) : levels(1, std::move(finest)) {
        while (std::max(levels.back().H, levels.back().W) > 1) levels.push_back(levels.back().coarser());
    }

    Numbers solve(Numbers rest, double tolerance, int64_t iterations) {
        auto dot = [](const Numbers& a, const Numbers& b) {
            double total = 0;
            for (size_t k = 0; k < a.size(); k++) total += a[k] * b[k];
            return total;
        };
        const Numbers none(rest.size(), 0);
        Numbers u = none, estimate = precondition(rest), direction = estimate, image(rest.size());
        double product = dot(rest, estimate);
        for (int64_t turn = 0; turn < iterations; turn++) {
            double largest = 0;
            for (double value : estimate) largest = std::max(largest, std::fabs(value));
            if (SAFETY * largest <= tolerance || product <= 0) break;
            levels[0].find_rest(direction, none, image);  // -A direction
            const double curvature = -dot(direction, image), step = curvature > 0 ? product / curvature : 0;
            for (size_t k = 0; k < u.size(); k++) u[k] += step * direction[k], rest[k] += step * image[k];
            estimate = precondition(rest);
            const double before = product;
            product = dot(rest, estimate);
            for (size_t k = 0; k < u.size(); k++) direction[k] = estimate[k] + product / before * direction[k];
        }
        return u;
    }
};

// One equation for each unknown cell, and its right side: the sum of its known neighbours' heights.
Level equations(const FilterGrid& grid, const Cells& from, double datum, Numbers& right) {
    Level level(grid.H, grid.W);
    auto link = [&](int64_t k, int64_t n, Numbers& edges) {
        if (!from.known[k] && !from.known[n]) edges[k] = 1;
        for (auto [a, b] : {std::pair(k, n), std::pair(n, k)})
            if (!from.known[a] && from.known[b]) level.sink[a] += 1, right[a] += from.values[b] - datum;
    };
    for (int64_t k = 0; k < grid.cells(); k++) {
        if (k / grid.W + 1 < grid.H) link(k, k + grid.W, level.ahead);
        if (k % grid.W + 1 < grid.W) link(k, k + 1, level.beside);
    }
    level.complete();
    return level;
}

}  // namespace

void filters::inpaint_diffusion(const FilterGrid& grid, const Cells& from, double tolerance, int64_t iterations,
                                Cells& to) {
    to = from;
    double sum = 0, number = 0;
    for (int64_t k = 0; k < grid.cells(); k++)
        if (from.known[k]) sum += from.values[k], number++;
    if (number == 0) return;
    Numbers right(grid.cells());
    Level finest = equations(grid, from, sum / number, right);
    const Numbers filling = Solver(std::move(finest)).solve(right, tolerance, iterations);
    for (int64_t k = 0; k < grid.cells(); k++)
        if (!from.known[k]) to.values[k] = float(filling[k] + sum / number), to.known[k] = 1;
}
