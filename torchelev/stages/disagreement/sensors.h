// The standard deviation of the height error of each sensor, as the cells they share show it: `compare_sensors`.
#pragma once

#include <cmath>
#include <cstdlib>
#include <memory>
#include <vector>

#include "stages/cells.h"

namespace disagreement {

// Memory that users leave zero, of which large maps use a few pages.
class Zeros {
    std::unique_ptr<float, decltype(&std::free)> values{nullptr, &std::free};
    size_t room = 0;

  public:
    float* resize(size_t number) {
        if (number > room) {
            values.reset(static_cast<float*>(std::calloc(number, sizeof(float))));
            room = values ? number : 0;
            if (!values) throw std::bad_alloc();
        }
        return values.get();
    }
    float* data() const { return values.get(); }
};

// What the cells say of one sensor.
struct Bias {
    double count = 0, sum = 0, squares = 0;

    double mean() const { return sum / std::max(count, 1.0); }
    double noise() const {  // of the mean
        const double n = std::max(count, 1.0), b = mean();
        return std::max(squares - 2 * b * sum + count * b * b, 0.0) / (n * n);
    }
};

// What a thread keeps from update to update.
struct Compared {
    Zeros numbers, moments;      // (H, W, S) points of each sensor; the sum of their heights [m]
    Zeros views;                 // (H, W) sensors that see a cell
    std::vector<int32_t> cells;  // those that are hit, once for each sensor
    std::vector<Bias> biases;    // (S)

    int64_t count_points(const Update& u);
    void sum_heights(const Update& u);
    void compare(float max_bias);
    void forget();
};

// Mean height [m] of the points, from which the others count.
inline float level_of(const Measurement& m) {
    double sum = 0;
    for (int64_t k = 0; k < m.number; k++) sum += m.slot[k] >= 0 ? m.z[k] : 0.0f;
    return float(sum / double(std::max<int64_t>(m.inside, 1)));
}

// Count the points of each sensor in each cell; return how many cells several sensors see.
inline int64_t Compared::count_points(const Update& u) {
    const Measurement& m = u.measurement;
    const int64_t per_sensor = m.number / m.sensors;
    float *number = numbers.resize(u.cells() * m.sensors), *seen = views.resize(u.cells());
    moments.resize(u.cells() * m.sensors);
    cells.clear(), cells.reserve(m.number);  // nothing below runs out of memory and leaves numbers behind
    int64_t shared = 0;
    for (int64_t s = 0; s < m.sensors; s++)
        for (int64_t k = s * per_sensor; k < (s + 1) * per_sensor; k++) {
            const int32_t cell = m.slot[k];
            if (cell < 0 || number[size_t(cell) * m.sensors + s]++ > 0) continue;
            cells.push_back(cell);
            shared += ++seen[cell] == 2;
        }
    return shared;
}

// Sum the heights of each sensor's points in each shared cell, without the slope of the ground within a cell.
inline void Compared::sum_heights(const Update& u) {
    const Measurement& m = u.measurement;
    const float size = u.settings.disagreement.resolution, level = level_of(m);
    const int64_t per_sensor = m.number / m.sensors;
    for (int64_t k = 0; k < m.number; k++) {
        const int32_t cell = m.slot[k];
        if (cell < 0 || views.data()[cell] < 2) continue;
        const float x = m.x[k] - (std::floor(m.x[k] / size) + 0.5f) * size;
        const float y = m.y[k] - (std::floor(m.y[k] / size) + 0.5f) * size;
        const float height = m.z[k] - level - u.state.gradient_x[cell] * x - u.state.gradient_y[cell] * y;
        moments.data()[size_t(cell) * m.sensors + k / per_sensor] += height;
    }
}

// Compare the sensors in one cell that several see.
inline void compare_in_cell(const float* number, const float* moment, float max_bias, std::vector<Bias>& biases) {
    const size_t sensors = biases.size();
    float seen = 0, sum = 0;
    for (size_t s = 0; s < sensors; s++)
        if (number[s] > 0) seen++, sum += moment[s] / number[s];
    for (size_t s = 0; seen > 1 && s < sensors; s++) {
        const float error = number[s] > 0 ? moment[s] / number[s] - sum / seen : max_bias + 1;
        if (!(std::fabs(error) <= max_bias)) continue;
        biases[s].count++, biases[s].sum += error, biases[s].squares += double(error) * error;
    }
}

// The deviation [m] by the biases of sensors that were compared often enough; else the one before.
inline float deviation_of(const std::vector<Bias>& biases, float before, const DisagreementSettings& s) {
    double compared = 0, mean = 0, d2 = 0, noise = 0;
    auto counts = [&](const Bias& bias) { return bias.count > s.min_cells - 0.5; };
    for (const Bias& bias : biases)
        if (counts(bias)) compared++, mean += bias.mean(), noise += bias.noise();
    mean /= std::max(compared, 1.0), noise /= std::max(compared, 1.0);
    for (const Bias& bias : biases)
        if (counts(bias)) d2 += (bias.mean() - mean) * (bias.mean() - mean);
    d2 /= std::max(compared - 1, 1.0);
    if (compared < 2) return before;
    return d2 > s.significant_square * noise ? float(std::sqrt(d2)) : 0;
}

inline void Compared::compare(float max_bias) {
    const size_t sensors = biases.size();
    for (const int32_t cell : cells) {
        if (views.data()[cell] < 2) continue;
        compare_in_cell(numbers.data() + cell * sensors, moments.data() + cell * sensors, max_bias, biases);
        views.data()[cell] = 0;  // compared once
    }
}

inline void Compared::forget() {
    const size_t sensors = biases.size();
    for (const int32_t cell : cells) {
        std::fill_n(numbers.data() + cell * sensors, sensors, 0.0f);
        std::fill_n(moments.data() + cell * sensors, sensors, 0.0f);
        views.data()[cell] = 0;
    }
}

inline float compare_sensors(Update& u) {
    const DisagreementSettings& s = u.settings.disagreement;
    locate(u, s.resolution);
    auto& compared = u.memory.get<Compared>();
    compared.biases.assign(u.measurement.sensors, Bias());
    if (compared.count_points(u) >= s.min_cells) compared.sum_heights(u), compared.compare(s.max_bias);
    compared.forget();
    return deviation_of(compared.biases, *u.state.statistics.disagreement, s);
}

}  // namespace disagreement
