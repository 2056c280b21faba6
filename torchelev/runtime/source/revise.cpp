// Changes of a map besides updates: ground points that fill unknown cells, and cells that are forgotten.
#include <algorithm>
#include <cmath>

#include "runtime/source/map.h"

namespace {

struct Foot {
    double x, y, z;
};

// The plane of least squares through ground points, and its errors: `interpolate` of stages/initialize.py.
struct Ground {
    std::vector<Foot> feet;
    Foot mean{0, 0, 0};
    double slope_x = 0, slope_y = 0;
    std::vector<double> errors;  // of each foot from the plane

    explicit Ground(const double* given, int64_t number) {
        for (int64_t k = 0; k < number; k++) feet.push_back({given[3 * k], given[3 * k + 1], given[3 * k + 2]});
        const double share = 1.0 / double(number);
        for (const Foot& foot : feet) mean.x += share * foot.x, mean.y += share * foot.y, mean.z += share * foot.z;
        fit();
        for (const Foot& foot : feet) errors.push_back(foot.z - plane(foot.x, foot.y));
    }

    double plane(double x, double y) const { return mean.z + slope_x * (x - mean.x) + slope_y * (y - mean.y); }

    // Feet on one line give the slope along it: the pseudoinverse drops a singular value below 1e-4 of the largest.
    void fit() {
        double xx = 0, xy = 0, yy = 0, xz = 0, yz = 0;
        for (const Foot& foot : feet) {
            const double x = foot.x - mean.x, y = foot.y - mean.y, z = foot.z - mean.z;
            xx += x * x, xy += x * y, yy += y * y, xz += x * z, yz += y * z;
        }
        const double angle = 0.5 * std::atan2(2 * xy, xx - yy), half = 0.5 * (xx + yy),
                     spread = std::hypot(0.5 * (xx - yy), xy);
        const double squares[] = {half + spread, half - spread};  // singular values, squared
        for (int k = 0; k < 2; k++) {
            if (squares[k] <= 1e-8 * squares[0]) continue;
            const double ux = k ? -std::sin(angle) : std::cos(angle), uy = k ? std::cos(angle) : std::sin(angle);
            const double along = (ux * xz + uy * yz) / squares[k];
            slope_x += along * ux, slope_y += along * uy;
        }
    }

    double linear(double x, double y) const {
        double sum = 0, total = 0;
        for (size_t k = 0; k < feet.size(); k++) {
            const double dx = x - feet[k].x, dy = y - feet[k].y, weight = 1 / std::max(dx * dx + dy * dy, 1e-8);
            sum += weight * errors[k], total += weight;
        }
        return plane(x, y) + sum / total;
    }

    double nearest(double x, double y) const {
        const auto closer = [&](const Foot& a, const Foot& b) {
            return std::hypot(a.x - x, a.y - y) < std::hypot(b.x - x, b.y - y);
        };
        return std::min_element(feet.begin(), feet.end(), closer)->z;
    }
};

// The convex hull of feet, widened by a margin, as 64 half-planes.
struct Hull {
    static constexpr int DIRECTIONS = 64;
    double x[DIRECTIONS], y[DIRECTIONS], extent[DIRECTIONS];

    Hull(const std::vector<Foot>& feet, double margin) {
        for (int k = 0; k < DIRECTIONS; k++) {
            const double angle = k * (2 * M_PI / DIRECTIONS);
            x[k] = std::cos(angle), y[k] = std::sin(angle), extent[k] = -INFINITY;
            for (const Foot& foot : feet) extent[k] = std::max(extent[k], foot.x * x[k] + foot.y * y[k] + margin);
        }
    }

    bool contains(double px, double py) const {
        for (int k = 0; k < DIRECTIONS; k++)
            if (px * x[k] + py * y[k] > extent[k]) return false;
        return true;
    }
};

}  // namespace

// Call `change(cell, x, y)` for each cell and its centre [m], and rate the map anew.
template <class Change>
void torchelev_map::revise(const Change& change) {
    const double T[] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    const torchelev_input none{1, 0, nullptr, T, nullptr, nullptr, 0, nullptr, nullptr};
    const Stage before[] = {run_subtract_disagreement}, after[] = {run_add_disagreement, run_rate_surface};
    run(none, before, std::size(before));
    for (int64_t k = 0; k < cells(); k++)
        change(k, (double(state.corner[0] + k / sizes.W) + 0.5) * resolution(),
               (double(state.corner[1] + k % sizes.W) + 0.5) * resolution());
    run(none, after, std::size(after));
}

void torchelev_map::initialize(const double* feet, int64_t number, const std::string& method) {
    REQUIRE(method == "linear" || method == "nearest", "method", "must be one of linear, nearest", "'" + method + "'",
            "use linear");
    REQUIRE(feet && number >= 1, "feet", "expected (K, 3) with K >= 1", feet ? "K = " + std::to_string(number) : "null",
            "give ground points");
    REQUIRE(std::all_of(feet, feet + 3 * number, [](double v) { return std::isfinite(v); }), "feet", "must be finite",
            "NaN or inf", "leave those feet out");
    const Ground ground(feet, number);
    const Hull hull(ground.feet, resolution());
    const bool is_linear = method == "linear";
    revise([&](int64_t k, double x, double y) {
        if (state.validity[k] || (is_linear && !hull.contains(x, y))) return;
        state.elevation[k] = float(is_linear ? ground.linear(x, y) : ground.nearest(x, y));
        state.variance[k] = settings.fusion.max_variance;
        state.validity[k] = 1, state.time[k] = 0, state.support[k] = 0, state.bounded[k] = 0;
    });
}

void torchelev_map::clear_around(double x, double y, double radius) {
    REQUIRE(std::isfinite(x) && std::isfinite(y), "center", "must be finite", "NaN or inf", "give x and y in metres");
    REQUIRE(std::isfinite(radius) && radius > 0, "radius", "must be positive and finite", repr(radius),
            "give metres");
    revise([&](int64_t k, double px, double py) {
        if (std::hypot(px - x, py - y) <= radius) blank(k);
    });
}

// Make a cell as one that was never known.
void torchelev_map::blank(int64_t cell) {
    if (levels) levels->forget_cell(state, cell);
    for (size_t k = 0; k < NUMBER_OF_TENSORS; k++) {
        if (STATE[k].shape[0] != ROWS) continue;
        unsigned char* const layer = tensors[k].get();
        if (STATE[k].size == sizeof(float))
            reinterpret_cast<float*>(layer)[cell] = float(STATE[k].blank);
        else
            layer[cell] = static_cast<unsigned char>(STATE[k].blank);
    }
}
