// Checks of poses: inputs/checks.py, with its sentences.
#include <algorithm>

#include "runtime/source/map.h"

namespace {

constexpr double FARTHEST = 1e9;  // [m] of inputs/checks.py

double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

double determinant(const double* T) {
    return T[0] * (T[5] * T[10] - T[6] * T[9]) - T[1] * (T[4] * T[10] - T[6] * T[8]) + T[2] * (T[4] * T[9] - T[5] * T[8]);
}

// The largest error of R R^T = 1.
double skew(const double* T) {
    double error = 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) error = std::max(error, std::fabs(dot(T + 4 * i, T + 4 * j) - (i == j)));
    return error;
}

void require_pose(const std::string& name, const double* T) {
    const bool is_finite = std::all_of(T, T + 16, [](double v) { return std::isfinite(v); });
    require(is_finite, name, "must be finite", "NaN or inf",
            "where the pose is unknown, give any rigid one, and NaN points if they should be ignored");
    const std::string hint = "use torchelev.frames.transform(position, quat_wxyz)";
    const double error = skew(T);
    require(error < 1e-3, name, "must be rigid (R R^T = 1)", "an error of " + general(error, 3), hint);
    require(determinant(T) > 0, name, "must not mirror", "determinant -1", hint);
    const double last[] = {0, 0, 0, 1};
    bool is_last = true, is_transposed = true;
    for (int k = 0; k < 4; k++) {
        is_last = is_last && std::fabs(T[12 + k] - last[k]) <= 1e-6;
        is_transposed = is_transposed && T[4 * k + 3] == last[k];
    }
    const std::string row = general(T[12]) + " " + general(T[13]) + " " + general(T[14]) + " " + general(T[15]);
    require(is_last, name, "must have the last row 0 0 0 1", row,
            is_transposed ? "transpose it: the position is the last column" : hint);
    const double distance = std::max({std::fabs(T[3]), std::fabs(T[7]), std::fabs(T[11])});
    require(distance <= FARTHEST, name, "must lie within 1e+09 m", general(distance, 3) + " m",
            "check its units and source");
}

}  // namespace

void require_poses(const std::string& name, const double* poses, int64_t number) {
    for (int64_t k = 0; k < number; k++) require_pose(name, poses + 16 * k);
}
