// Checks of poses and their covariances: inputs/checks.py, with its sentences.
#include <algorithm>

#include "runtime/source/map.h"

namespace {

double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

double determinant(const double* T) {
    return T[0] * (T[5] * T[10] - T[6] * T[9]) - T[1] * (T[4] * T[10] - T[6] * T[8]) +
           T[2] * (T[4] * T[9] - T[5] * T[8]);
}

// The largest error of R R^T = 1.
double skew(const double* T) {
    double error = 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) error = std::max(error, std::fabs(dot(T + 4 * i, T + 4 * j) - (i == j)));
    return error;
}

const char* const HINT = "use torchelev.frames.transform(position, quat_wxyz)";
const double LAST[] = {0, 0, 0, 1};

bool is_last_row(const double* T, double tolerance) {
    for (int k = 0; k < 4; k++)
        if (!(std::fabs(T[12 + k] - LAST[k]) <= tolerance)) return false;
    return true;
}

bool is_transposed(const double* T) {
    for (int k = 0; k < 4; k++)
        if (T[4 * k + 3] != LAST[k]) return false;
    return true;
}

std::string last_row(const double* T) {
    return general(T[12]) + " " + general(T[13]) + " " + general(T[14]) + " " + general(T[15]);
}

void require_pose(const char* name, const double* T) {
    REQUIRE(std::all_of(T, T + 16, [](double v) { return std::isfinite(v); }), name, "must be finite", "NaN or inf",
            "where the pose is unknown, give any rigid one, and NaN points if they should be ignored");
    const double error = skew(T), distance = std::max({std::fabs(T[3]), std::fabs(T[7]), std::fabs(T[11])});
    REQUIRE(error < 1e-3, name, "must be rigid (R R^T = 1)", "an error of " + general(error, 3), HINT);
    REQUIRE(determinant(T) > 0, name, "must not mirror", "determinant -1", HINT);
    REQUIRE(is_last_row(T, 1e-6), name, "must have the last row 0 0 0 1", last_row(T),
            is_transposed(T) ? "transpose it: the position is the last column" : HINT);
    REQUIRE(distance <= FARTHEST, name, "must lie within 1e+09 m", general(distance, 3) + " m",
            "check its units and source");
}

// Whether a symmetric matrix (6, 6), to which `least` is added on its diagonal, has no negative eigenvalue: its
// Cholesky factorisation exists.
bool is_semidefinite(const double* matrix, double least) {
    double L[6][6] = {};
    for (int i = 0; i < 6; i++)
        for (int j = 0; j <= i; j++) {
            double rest = matrix[6 * i + j] + (i == j ? least : 0);
            for (int k = 0; k < j; k++) rest -= L[i][k] * L[j][k];
            if (i == j && rest < 0) return false;
            L[i][j] = i == j ? std::sqrt(rest) : L[j][j] > 0 ? rest / L[j][j] : 0;
        }
    return true;
}

}  // namespace

void require_poses(const char* name, const double* poses, int64_t number) {
    REQUIRE(poses, name, "must be given", "null", "give (4, 4) doubles for each");
    for (int64_t k = 0; k < number; k++) require_pose(name, poses + 16 * k);
}

void require_covariances(const double* values, int64_t number) {
    const char* name = "pose_covariance";
    double scale = 0;
    for (int64_t k = 0; k < 36 * number; k++) {
        REQUIRE(std::isfinite(values[k]), name, "must be finite", "NaN or inf",
                "where the pose's uncertainty is unknown, leave it out");
        scale = std::max(scale, std::fabs(values[k]));
    }
    for (int64_t s = 0; s < number; s++) {
        const double* matrix = values + 36 * s;
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < i; j++)
                REQUIRE(std::fabs(matrix[6 * i + j] - matrix[6 * j + i]) <= 1e-4 * scale, name, "must be symmetric",
                        "another", "give the covariance of x, y, z and the rotations about the map's axes");
        REQUIRE(is_semidefinite(matrix, 1e-4 * scale), name, "must have no negative eigenvalue", "one",
                "give the covariance of x, y, z and the rotations about the map's axes");
    }
}
