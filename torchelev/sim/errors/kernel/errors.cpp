// Errors of the clouds of many sensors: cloud_errors.py.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "kernels/threads.h"
#include "ranges.h"

namespace {

// `FIELDS` of cloud_kernel.py.
struct Settings {
    float flying, flying_step, too_short, too_long, range_constant, range_quadratic, range_step, point_noise, outliers,
        outlier_noise, disparity_step, dropout, missed_frames;
};

// `_Clouds` of cloud_kernel.py: B clouds of h x w points, and `Draws`, null where they are not used.
struct Clouds {
    const float* points;  // (B, h, w, 3)
    const Settings* settings;
    const float *flying, *artefact, *range_noise, *outlier, *point_noise, *missed, *dropped;
    float* disturbed;  // (B, h, w, 3)
    int64_t B, h, w, changes_ranges;
};

// One cloud; its arrays have one entry per point.
struct Cloud {
    const Settings& s;
    const float *points, *flying, *artefact, *range_noise, *outlier, *point_noise, *missed, *dropped;
    float* disturbed;
    int64_t h, w, M;

    Cloud(const Clouds& all, int64_t b) : s(all.settings[b]), h(all.h), w(all.w), M(all.h * all.w) {
        const auto of_cloud = [&](const float* draws, int64_t size) { return draws ? draws + b * size : nullptr; };
        points = all.points + 3 * b * M, disturbed = all.disturbed + 3 * b * M;
        flying = of_cloud(all.flying, M), artefact = of_cloud(all.artefact, M), outlier = of_cloud(all.outlier, M);
        range_noise = of_cloud(all.range_noise, M), point_noise = of_cloud(all.point_noise, 3 * M);
        missed = of_cloud(all.missed, 1), dropped = of_cloud(all.dropped, M);
    }

    void find_ranges(float* d) const {
        for (int64_t k = 0; k < M; k++) {
            const float *p = points + 3 * k;
            d[k] = std::sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
        }
    }

    void find_ranges_across_edges(const float* d, float* across) const {
        std::copy_n(d, M, across);
        const auto look = [&](int64_t first, int64_t last, int64_t offset) {
            for (int64_t k = first; k < last; k++) across[k] = farther(d[k], across[k], d[k + offset]);
        };
        look(w, M, -w);
        look(0, M - w, w);
        for (int64_t row = 0; row < M; row += w) look(row + 1, row + w, -1), look(row, row + w - 1, 1);
    }

    // Change ranges d into `measured`, which holds the ranges across edges before.
    void disturb_ranges(const float* d, float* measured) const {
        if (flying)
            for (int64_t k = 0; k < M; k++)
                measured[k] = add_flying_point(d[k], measured[k], flying[k], s.flying, s.flying_step);
        if (artefact)
            for (int64_t k = 0; k < M; k++)
                measured[k] = add_artefact(measured[k], artefact[k], s.too_short, s.too_long);
        if (range_noise)
            for (int64_t k = 0; k < M; k++) {
                const float sigma = s.range_constant + s.range_quadratic * (measured[k] * measured[k]);
                measured[k] += sigma * range_noise[k];
            }
        if (s.range_step > 0)
            for (int64_t k = 0; k < M; k++) measured[k] = quantise(measured[k], s.range_step);
    }

    void move_along_rays(std::vector<float>& d, std::vector<float>& measured) const {
        d.resize(M), measured.resize(M);
        find_ranges(d.data());
        if (flying)
            find_ranges_across_edges(d.data(), measured.data());
        else
            measured = d;
        disturb_ranges(d.data(), measured.data());
        for (int64_t k = 0; k < M; k++) measured[k] /= at_least(d[k], 1e-6f);
        for (int64_t k = 0; k < M; k++)
            for (int c = 0; c < 3; c++) disturbed[3 * k + c] = points[3 * k + c] * measured[k];
    }

    void add_noise() const {
        for (int64_t k = 0; k < M; k++) {
            const bool is_outlier = outlier && outlier[k] < s.outliers;
            const float sigma = is_outlier ? s.outlier_noise : s.point_noise;
            for (int c = 0; c < 3; c++) disturbed[3 * k + c] += sigma * point_noise[3 * k + c];
        }
    }

    void quantise_disparities() const {
        for (int64_t k = 0; k < M; k++) {
            const float scale = quantise_disparity(disturbed[3 * k], s.disparity_step);
            for (int c = 0; c < 3; c++) disturbed[3 * k + c] *= scale;
        }
    }

    void drop() const {
        const float nan = __builtin_nanf("");
        if (missed[0] < s.missed_frames) return void(std::fill_n(disturbed, 3 * M, nan));
        for (int64_t k = 0; k < M; k++)
            for (int c = 0; c < 3; c++) disturbed[3 * k + c] = dropped[k] < s.dropout ? nan : disturbed[3 * k + c];
    }
};

struct Scratch {
    std::vector<float> d, measured;
};

void disturb(const Clouds& clouds, int64_t b, Scratch& scratch) {
    const Cloud cloud(clouds, b);
    if (clouds.changes_ranges)
        cloud.move_along_rays(scratch.d, scratch.measured);
    else
        std::copy_n(cloud.points, 3 * cloud.M, cloud.disturbed);
    if (cloud.point_noise) cloud.add_noise();
    if (cloud.s.disparity_step > 0) cloud.quantise_disparities();
    if (cloud.dropped) cloud.drop();
}

}  // namespace

extern "C" int disturb_clouds(const Clouds* clouds, int num_threads) {
    return code_of([&] {
        const auto make = [] { return Scratch(); };
        for_each(int(clouds->B), num_threads, make, [&](int64_t b, Scratch& own) { disturb(*clouds, b, own); });
    });
}
