// The inputs of a map's last few updates, thinned: diagnosis/history.py, with the same choice of updates and points.
#pragma once

#include <algorithm>
#include <vector>

#include "kernels/update.h"
#include "runtime/include/torchelev.h"
#include "tables.h"

// One update's input, of which every `step`-th point is kept.
struct PastUpdate {
    int64_t number;  // of the update, counted from 0
    int64_t sensors, points;  // of each sensor
    bool has_base, has_variance, has_own;
    float dt;
    double base[16];
    Buffer<double> poses;     // (S, 4, 4)
    Buffer<float> xyz;        // (S, N, 3)
    Buffer<float> variance;   // (S, N)
    Buffer<uint8_t> own;      // (S, N) on the robot's links

    const double* pose(int64_t sensor) const { return poses.data() + 16 * sensor; }
};

class History {
    static constexpr int64_t MAX_UPDATES = diagnosis::MAX_UPDATES, MAX_CORRECTIONS = diagnosis::MAX_CORRECTIONS,
                             MAX_POINTS = diagnosis::MAX_POINTS, PERIOD = diagnosis::PERIOD;
    PastUpdate updates[MAX_UPDATES];
    double corrections[MAX_CORRECTIONS];
    int64_t kept = 0, number = 0;

  public:
    // Take the memory for the largest updates.
    void resize(const torchelev_limits& limits) {
        const int64_t most = std::min(limits.max_points, int64_t(limits.max_sensors) * MAX_POINTS);
        for (PastUpdate& update : updates) {
            update.poses.resize(16 * limits.max_sensors), update.xyz.resize(3 * most);
            update.variance.resize(most), update.own.resize(most);
        }
    }

    void forget() { kept = number = 0; }

    // Keep an update's input, if it is its turn, with which points lie on the robot's links (or null), and the drift
    // correction [m] of the update before it.
    void add(const torchelev_input& input, const uint8_t* own, double last_correction) {
        if (number > 0) corrections[(number - 1) % MAX_CORRECTIONS] = last_correction;
        if (number < MAX_UPDATES || number % PERIOD < 2) keep(updates[kept++ % MAX_UPDATES], input, own);
        number++;
    }

    // The updates that are kept, in their order.
    std::vector<const PastUpdate*> all() const {
        std::vector<const PastUpdate*> found;
        for (int64_t k = std::max<int64_t>(0, kept - MAX_UPDATES); k < kept; k++)
            found.push_back(&updates[k % MAX_UPDATES]);
        return found;
    }

    // Drift corrections [m] of the last updates but one.
    std::vector<double> past_corrections() const {
        std::vector<double> found;
        for (int64_t k = std::max<int64_t>(0, number - 1 - MAX_CORRECTIONS); k < number - 1; k++)
            found.push_back(corrections[k % MAX_CORRECTIONS]);
        return found;
    }

  private:
    void keep(PastUpdate& to, const torchelev_input& input, const uint8_t* own) const {
        const int64_t S = input.num_sensors, N = input.num_points;
        const int64_t step = std::max<int64_t>(1, (N + MAX_POINTS - 1) / MAX_POINTS) | 1;
        to.number = number, to.sensors = S, to.points = (N + step - 1) / step, to.dt = float(input.dt);
        to.has_base = input.T_map_base, to.has_variance = input.variance, to.has_own = own;
        std::copy_n(input.T_map_sensor, 16 * S, to.poses.data());
        if (to.has_base) std::copy_n(input.T_map_base, 16, to.base);
        int64_t k = 0;
        for (int64_t s = 0; s < S; s++)
            for (int64_t n = s * N; n < (s + 1) * N; n += step, k++) {
                std::copy_n(input.points + 3 * n, 3, to.xyz.data() + 3 * k);
                if (input.variance) to.variance[k] = input.variance[n];
                if (own) to.own[k] = own[n];
            }
    }
};
