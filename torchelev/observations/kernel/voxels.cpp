// Voxels around many robots, from the surfaces of their maps: voxel_crop.py.

#include <cstring>

#include "observations/kernel/distances.h"
#include "observations/kernel/image_of_robot.h"

namespace {

// `_Voxels` of voxel_kernel.py.
struct Voxels {
    images::Images place;  // poses, corners and pattern of the columns
    const float *elevation, *upper_bound;
    const uint8_t *validity, *bounded;                    // (B, H, W)
    const float *lower, *upper, *support, *free_top;      // rings of `Levels`
    uint8_t* voxels;                                      // (B, P, Z)
    int64_t L, Z;
    float step, offset, min_support;  // [m] side of a voxel, of the crop's middle above the base
};

constexpr uint8_t FREE = 0, OCCUPIED = 1, UNKNOWN = 2;

// The columns of one robot.
struct Columns {
    const Voxels& all;
    images::Pixels pixels;
    std::vector<float> middle, bottom, top;  // (Z) [m]
    float per_step;

    explicit Columns(const Voxels& all)
        : all(all), pixels(all.place), middle(all.Z), bottom(all.Z), top(all.Z), per_step(1 / all.step) {}

    void fill(int64_t b) {
        const images::Images& at = all.place;
        const double* pose = at.pose + 16 * b;
        const int64_t *corner = at.corner + 2 * b, H = at.height, W = at.width;
        uint8_t* out = all.voxels + b * at.P * all.Z;
        if (!std::isfinite(pose[3]) || !std::isfinite(pose[7]) || !std::isfinite(pose[11]))
            return void(std::fill_n(out, at.P * all.Z, UNKNOWN));
        pixels.place(pose, corner);
        const int64_t start[] = {modulo(corner[0], H), modulo(corner[1], W)};
        const float z = float(pose[11]), half = 0.5f * all.step;
        for (int64_t k = 0; k < all.Z; k++) {
            middle[k] = z + (all.offset + (float(k) + 0.5f - 0.5f * float(all.Z)) * all.step);
            bottom[k] = middle[k] - half, top[k] = middle[k] + half;
        }
        for (int64_t p = 0; p < at.P; p++, out += all.Z) {
            const float i = std::floor(pixels.u[p]), j = std::floor(pixels.v[p]);
            const bool inside = i >= 0 && i < float(H) && j >= 0 && j < float(W);
            if (!inside) std::fill_n(out, all.Z, UNKNOWN);
            else column(b, int64_t(i), int64_t(j), start, out);
        }
    }

    void column(int64_t b, int64_t i, int64_t j, const int64_t* start, uint8_t* out) const {
        const int64_t H = all.place.height, W = all.place.width, cells = H * W, c = b * cells + i * W + j;
        const int64_t ring = wrapped(start[0] + i, H) * W + wrapped(start[1] + j, W);
        const bool known = all.validity[c], has_floor = known || all.bounded[c];
        const float floor = known ? all.elevation[c] : all.upper_bound[c];
        float limit = std::numeric_limits<float>::infinity();
        for (int64_t l = 0; l < all.L; l++) {
            const int64_t q = (b * all.L + l) * cells + ring;
            if (all.support[q] >= all.min_support && all.lower[q] > floor) limit = std::min(limit, all.lower[q]);
        }
        if (limit == std::numeric_limits<float>::infinity()) limit = all.free_top[b * cells + ring];
        const int64_t ground = known ? count_below(middle, floor) : 0;
        const int64_t first = has_floor ? count_below(middle, floor) : all.Z;
        const int64_t last = has_floor ? count_up_to(middle, limit) : all.Z;
        std::memset(out, UNKNOWN, all.Z);
        std::memset(out, OCCUPIED, ground);
        if (first < last) std::memset(out + first, FREE, last - first);
        for (int64_t l = 0; l < all.L; l++) {
            const int64_t q = (b * all.L + l) * cells + ring;
            if (!(all.support[q] >= all.min_support)) continue;
            const int64_t begin = count_up_to(top, all.lower[q]), end = count_up_to(bottom, all.upper[q]);
            if (begin < end) std::memset(out + begin, OCCUPIED, end - begin);
        }
    }

    // How many of the heights, which rise by `step`, are less than a value, or at most as large.
    int64_t count_below(const std::vector<float>& z, float value) const {
        int64_t k = guess(z, value);
        while (k < all.Z && z[k] < value) k++;
        while (k > 0 && !(z[k - 1] < value)) k--;
        return k;
    }
    int64_t count_up_to(const std::vector<float>& z, float value) const {
        int64_t k = guess(z, value);
        while (k < all.Z && z[k] <= value) k++;
        while (k > 0 && !(z[k - 1] <= value)) k--;
        return k;
    }
    int64_t guess(const std::vector<float>& z, float value) const {
        const float k = (value - z[0]) * per_step;
        return int64_t(std::min(std::max(k, 0.0f), float(all.Z)));  // infinite ones too
    }

    static int64_t wrapped(int64_t k, int64_t size) { return k < size ? k : k - size; }
    static int64_t modulo(int64_t k, int64_t size) { return ((k % size) + size) % size; }
};

}  // namespace

extern "C" int read_voxels(const Voxels* voxels, int num_threads) {
    return code_of([&] {
        const auto make = [&] { return Columns(*voxels); };
        for_each(int(voxels->place.B), num_threads, make, [](int64_t b, Columns& columns) { columns.fill(b); });
    });
}

template <class T> void measure_all(const distances::Voxels& all, int num_threads) {
    const auto make = [&] { return distances::Field<T>(all); };
    for_each(int(all.B), num_threads, make, [](int64_t b, distances::Field<T>& field) { field.measure(b); });
}

extern "C" int measure_distances(const distances::Voxels* voxels, int num_threads) {
    return code_of([&] {
        if (voxels->reach < 182) measure_all<uint16_t>(*voxels, num_threads);  // two squares fit
        else measure_all<uint32_t>(*voxels, num_threads);
    });
}
