// The surfaces of one cell: surfaces.py, with the same names.
#pragma once

#include <algorithm>
#include <cmath>

namespace levels {

constexpr float GATE = 3.0f, SETTLED = 10.0f;

struct Found {
    float lower, upper, mean, variance, noise, number;
};

inline float distance(float lower, float upper, float low, float high) {
    return std::max(std::max(lower - high, low - upper), 0.0f);
}

// The L places of a cell: values `stride` apart.
struct Cell {
    float *lower, *upper, *variance, *support, *time;
    int64_t L, stride;

    bool insert(const Found& found, float new_time) const {  // whether a surface was dropped
        int64_t place = 0;
        for (int64_t l = 1; l < L; l++)
            if (support[l * stride] < support[place * stride]) place = l;
        const int64_t p = place * stride;
        const bool was_there = support[p] > 0;
        if (was_there && !(found.number > support[p])) return true;
        const bool is_thin = found.upper - found.lower <= 2 * GATE * std::sqrt(found.noise);
        lower[p] = is_thin ? found.mean : found.lower, upper[p] = is_thin ? found.mean : found.upper;
        variance[p] = found.variance, support[p] = found.number, time[p] = new_time;
        return was_there;
    }

    void fuse(int64_t l, const Found& found, float max_support) const {
        const int64_t p = l * stride;
        const float sigma = std::sqrt(variance[p] + found.noise);
        const bool is_flat = found.upper - found.lower <= 2 * GATE * std::sqrt(found.noise);
        const float gain = variance[p] / (variance[p] + found.variance);
        const bool at_top = std::fabs(found.mean - upper[p]) <= GATE * sigma;
        const bool at_bottom = std::fabs(found.mean - lower[p]) <= GATE * sigma;
        float up = at_top ? upper[p] + gain * (found.mean - upper[p]) : std::max(upper[p], found.mean);
        float low = at_bottom ? lower[p] + gain * (found.mean - lower[p]) : std::min(lower[p], found.mean);
        if (!is_flat) up = std::max(upper[p], found.upper), low = std::min(lower[p], found.lower);
        if (is_flat && (at_top || at_bottom)) variance[p] = (1 - gain) * variance[p];
        lower[p] = std::min(low, up), upper[p] = std::max(low, up);
        support[p] = std::min(support[p] + found.number, max_support), time[p] = 0;
    }

    void remove(int64_t l) const {
        for (float* values : {lower, upper, variance, support, time}) values[l * stride] = 0;
    }

    // Make one of surfaces that meet; return how many are gone.
    int64_t merge() const {
        int64_t gone = 0;
        for (int64_t a = 0; a < L; a++)
            for (int64_t b = a + 1; b < L; b++) {
                const int64_t p = a * stride, q = b * stride;
                if (!(support[p] > 0) || !(support[q] > 0) || distance(lower[p], upper[p], lower[q], upper[q]) > 0)
                    continue;
                lower[p] = std::min(lower[p], lower[q]), upper[p] = std::max(upper[p], upper[q]);
                variance[p] = std::min(variance[p], variance[q]), support[p] = std::max(support[p], support[q]);
                time[p] = std::min(time[p], time[q]);
                remove(b), gone++;
            }
        return gone;
    }
};

}  // namespace levels
