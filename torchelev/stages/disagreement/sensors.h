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
    std::vector<int32_t> cells;  // those that are hit, once for each sensor
    std::vector<Bias> biases;    // (S)
};

// Mean height [m] of the points, from which the others count.
inline float level_of(const Measurement& m) {
    double sum = 0;
    for (int64_t k = 0; k < m.number; k++) sum += m.slot[k] >= 0 ? m.z[k] : 0.0f;
    return float(sum / double(std::max<int64_t>(m.inside, 1)));
}

// Sum the heights of each sensor's points in each cell, without the slope of the ground within a cell.
inline void sum_heights(const Update& u, float* number, float* moment, std::vector<int32_t>& cells) {
    const Measurement& m = u.measurement;
    const float size = u.settings.disagreement.resolution, level = level_of(m);
    const int64_t per_sensor = m.number / m.sensors;
    for (int64_t k = 0; k < m.number; k++) {
        const int32_t cell = m.slot[k];
        if (cell < 0) continue;
        const float x = m.x[k] - (std::floor(m.x[k] / size) + 0.5f) * size;
        const float y = m.y[k] - (std::floor(m.y[k] / size) + 0.5f) * size;
        const size_t place = size_t(cell) * m.sensors + k / per_sensor;
        if (number[place]++ == 0) cells.push_back(cell);
        moment[place] += m.z[k] - level - u.state.gradient_x[cell] * x - u.state.gradient_y[cell] * y;
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

inline float compare_sensors(Update& u) {
    const DisagreementSettings& s = u.settings.disagreement;
    locate(u, s.resolution);
    const size_t sensors = u.measurement.sensors;
    auto& [numbers, moments, cells, biases] = u.memory.get<Compared>();
    float *number = numbers.resize(u.cells() * sensors), *moment = moments.resize(u.cells() * sensors);
    cells.clear(), cells.reserve(u.measurement.number);  // nothing below runs out of memory and leaves numbers behind
    biases.assign(sensors, Bias());
    sum_heights(u, number, moment, cells);
    for (int32_t cell : cells) {
        float *own = number + cell * sensors, *sums = moment + cell * sensors;
        compare_in_cell(own, sums, s.max_bias, biases);
        std::fill_n(own, sensors, 0.0f), std::fill_n(sums, sensors, 0.0f);  // compared once
    }
    return deviation_of(biases, *u.state.statistics.disagreement, s);
}

}  // namespace disagreement
