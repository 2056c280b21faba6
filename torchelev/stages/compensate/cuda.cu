// Height drift compensation on a GPU: stage.py. A block for each map, but where it says otherwise.

#include "kernels/cuda/update.h"
#include "stages/compensate/equation.h"
#include "stages/disagreement/equation.h"
#include "stages/window.h"

constexpr float NONE = 3.4028234e38f;  // an error [m] that counts nowhere

// Sums over a block's points.
struct Sums {
    double error, noise;
    int64_t number;

    Sums of_block() const {
        double* memory = reinterpret_cast<double*>(block_memory());
        return {sum_of_block(error, memory), sum_of_block(noise, memory), int64_t(sum_of_block(double(number), memory))};
    }
    float mean() const { return float(error / double(number > 1 ? number : 1)); }
    float mean_noise() const { return float(noise / double(number > 1 ? number : 1)); }
};

// Find the mean height error and its correction, and by how much successive scans disagree.
extern "C" __global__ void find_drift(Update u) {
    const CompensateSettings& s = u.settings.compensate;
    const int64_t b = blockIdx.x;
    const MapState map = u.state.at(b, u.sizes);
    const Scratch scan = u.scratch.at(b, u.sizes);
    if (threadIdx.x == 0) *scan.correction = 0;
    if (!s.has_drift) return;
    Sums all{};
    for (int64_t k = threadIdx.x; k < u.sizes.M; k += blockDim.x) {
        const int32_t cell = scan.slot[k];
        float error = NONE;
        if (cell >= 0 && map.validity[cell] && drift::suits(map.traversability[cell], map.variance[cell], s)) {
            error = drift::height_error(scan.x[k], scan.y[k], scan.z[k], map.elevation[cell], map.gradient_x[cell],
                                        map.gradient_y[cell], s);
            if (!(absolute(error) <= s.max_error)) error = NONE;
        }
        scan.error[k] = error;
        if (error != NONE) all.error += error, all.number++;
    }
    const float first_mean = all.of_block().mean();
    Sums near{};
    for (int64_t k = threadIdx.x; k < u.sizes.M; k += blockDim.x) {
        const float error = scan.error[k], noise = scan.noise[k];
        if (error == NONE || !drift::is_near_mean(error, first_mean, noise, s)) continue;
        near.error += error, near.noise += noise + s.relief_square, near.number++;
    }
    near = near.of_block();
    if (threadIdx.x) return;
    const float mean = near.mean();
    const bool applies = drift::applies(mean, near.number, u.inputs.at(b, u.sizes).moving, s);
    const float correction = applies ? s.gain * mean : 0;
    const Statistics to = map.statistics;
    if (u.sizes.S == 1) {
        const float error_variance = near.mean_noise() / float(near.number > 1 ? near.number : 1);
        *to.disagreement = disagreement::compare_scans(*to.drift_correction, *to.disagreement, correction,
                                                       error_variance, u.settings.disagreement);
    }
    *to.drift_points = near.number, *to.drift_error = mean, *to.drift_correction = correction;
    *scan.correction = correction;
}

// Note how uncertain the position is that the map's heights count from: `share_pose_error`.
extern "C" __global__ void share_pose_error(Update u) {
    const CompensateSettings& s = u.settings.compensate;
    const int64_t b = blockIdx.x;
    const MapState map = u.state.at(b, u.sizes);
    const Scratch scan = u.scratch.at(b, u.sizes);
    if (threadIdx.x == 0) *scan.shared = 0;
    if (!u.inputs.pose_covariance) return;
    double known = 0;
    for (int64_t k = threadIdx.x; k < u.cells(); k += blockDim.x) known += map.validity[k];
    known = sum_of_block(known, reinterpret_cast<double*>(block_memory()));
    if (threadIdx.x) return;
    const Statistics& to = map.statistics;
    const Inputs in = u.inputs.at(b, u.sizes);
    const bool follows = known == 0 || (s.has_drift && drift::applies(*to.drift_error, *to.drift_points, in.moving, s));
    *scan.shared = follows ? 0 : map.pose_covariance[8];
    const float* given = in.pose_covariance;
    for (int row = 0; row < 3; row++)
        for (int k = 0; k < 3; k++)
            map.pose_covariance[3 * row + k] = !follows && (row == 2 || k == 2) ? 0 : given[6 * row + k];
}

// Add the correction to heights, and what they shared to variances. A thread for each cell.
extern "C" __global__ void shift_heights(Update u) {
    const Place at = place(u.cells());
    const float shift = u.scratch.correction[at.row], shared = u.scratch.shared[at.row];
    if ((shift == 0 && shared == 0) || at.k >= u.cells()) return;
    const MapState map = u.state.at(at.row, u.sizes);
    map.elevation[at.k] += map.validity[at.k] ? shift : 0.0f;
    map.challenger[at.k] += map.challenger_support[at.k] ? shift : 0.0f;
    map.upper_bound[at.k] += map.bounded[at.k] ? shift : 0.0f;
    if (map.validity[at.k])
        map.variance[at.k] = smaller(map.variance[at.k] + shared, u.settings.fusion.max_variance);
}

// Several sensors ----------------------------------------------------------------------------------------------------

// Set the sums of each sensor's points in each cell to zero. A thread for each.
extern "C" __global__ void clear_sums(Update u) {
    const int64_t k = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (k < u.sizes.B * u.sizes.P * u.cells()) u.scratch.sensor_number[k] = 0, u.scratch.sensor_moment[k] = 0;
}

// Sum the heights of each sensor's points in each cell, without the slope of the ground within a cell.
extern "C" __global__ void sum_heights(Update u) {
    const float size = u.settings.disagreement.resolution;
    const MapState map = u.state.at(blockIdx.x, u.sizes);
    const Scratch scan = u.scratch.at(blockIdx.x, u.sizes);
    double sum = 0;
    for (int64_t k = threadIdx.x; k < u.sizes.M; k += blockDim.x) sum += scan.slot[k] >= 0 ? scan.z[k] : 0.0f;
    sum = sum_of_block(sum, reinterpret_cast<double*>(block_memory()));
    const float level = float(sum / double(scan.located[0] > 1 ? scan.located[0] : 1));
    for (int64_t k = threadIdx.x; k < u.sizes.M; k += blockDim.x) {
        const int32_t cell = scan.slot[k];
        if (cell < 0) continue;
        const float x = scan.x[k] - (std::floor(scan.x[k] / size) + 0.5f) * size;
        const float y = scan.y[k] - (std::floor(scan.y[k] / size) + 0.5f) * size;
        const int64_t at = k / u.sizes.N * u.cells() + cell;
        atomicAdd(scan.sensor_number + at, 1.0f);
        atomicAdd(scan.sensor_moment + at, scan.z[k] - level - map.gradient_x[cell] * x - map.gradient_y[cell] * y);
    }
}

// What the cells say of one sensor: how many, and the sum and the squares of its errors [m].
struct Bias {
    double count, sum, squares;

    double mean() const { return sum / (count > 1 ? count : 1); }
    double noise() const {  // of the mean
        const double n = count > 1 ? count : 1, b = mean(), rest = squares - 2 * b * sum + count * b * b;
        return (rest > 0 ? rest : 0) / (n * n);
    }
};

inline Bias compare_sensor(const Update& u, const Scratch& scan, int64_t sensor) {
    Bias bias{};
    for (int64_t cell = threadIdx.x; cell < u.cells(); cell += blockDim.x) {
        float seen = 0, sum = 0;
        for (int64_t s = 0; s < u.sizes.P; s++) {
            const float number = scan.sensor_number[s * u.cells() + cell];
            if (number > 0) seen++, sum += scan.sensor_moment[s * u.cells() + cell] / number;
        }
        const float own = scan.sensor_number[sensor * u.cells() + cell];
        if (!(seen > 1) || !(own > 0)) continue;
        const float error = scan.sensor_moment[sensor * u.cells() + cell] / own - sum / seen;
        if (!(absolute(error) <= u.settings.disagreement.max_bias)) continue;
        bias.count++, bias.sum += error, bias.squares += double(error) * error;
    }
    double* memory = reinterpret_cast<double*>(block_memory());
    return {sum_of_block(bias.count, memory), sum_of_block(bias.sum, memory), sum_of_block(bias.squares, memory)};
}

// By how much the sensors disagree: `compare_sensors`.
extern "C" __global__ void compare_sensors(Update u) {
    const DisagreementSettings& s = u.settings.disagreement;
    const Scratch scan = u.scratch.at(blockIdx.x, u.sizes);
    double compared = 0, mean = 0, squares = 0, noise = 0;
    for (int64_t sensor = 0; sensor < u.sizes.P; sensor++) {
        const Bias bias = compare_sensor(u, scan, sensor);
        if (!(bias.count > s.min_cells - 0.5)) continue;
        compared++, mean += bias.mean(), squares += bias.mean() * bias.mean(), noise += bias.noise();
    }
    if (threadIdx.x || compared < 2) return;
    mean /= compared, noise /= compared;
    const double d2 = (squares - compared * mean * mean) / (compared - 1);
    *u.state.statistics.at(blockIdx.x, u.sizes).disagreement = d2 > s.significant_square * noise ? float(sqrt(d2)) : 0;
}
