// One sensor's rays, in vectors, and what of the map they may meet.
#pragma once

#include <algorithm>
#include <limits>
#include <mutex>

#include "kernels/simd.h"
#include "kernels/update.h"
#include "stages/cells.h"
#include "stages/visibility/equation.h"

namespace visibility {

constexpr int64_t RAYS_AT_A_TIME = 2048;  // worth a thread; what is known of them fits the nearest cache
constexpr int64_t CELLS_AT_A_TIME = 8192;
constexpr int LANE_BITS = LANES == 16 ? 4 : LANES == 8 ? 3 : 2;
typedef std::integral_constant<int, LANES> Full;  // count of a whole vector

// Return memory for so many numbers whose rows of LANES lie within lines of the cache.
inline float* aligned(Buffer<float>& buffer, size_t number) {
    const uintptr_t place = reinterpret_cast<uintptr_t>(buffer.resize(number + 16));
    return reinterpret_cast<float*>((place + 63) / 64 * 64);
}

// Call `work(k, count)` for vectors from place `first` on up to `last`, none of them beyond `end`: the last one lies
// further ahead, so that some numbers may be seen twice.
template <class Work> void each_vector(int64_t first, int64_t last, int64_t end, const Work& work) {
    if (end < LANES) return work(int64_t(0), int(end));
    for (int64_t k = first; k < last; k += LANES) work(std::min(k, end - LANES), Full());
}

// Places that rays reach [m], as seen from the sensor.
struct Extent {
    float low[2], high[2], farthest;

    void include(const Extent& other) {
        for (int axis = 0; axis < 2; axis++) {
            low[axis] = std::min(low[axis], other.low[axis]), high[axis] = std::max(high[axis], other.high[axis]);
        }
        farthest = std::max(farthest, other.farthest);
    }
    Extent widened(float by) const {
        return {{low[0] - by, low[1] - by}, {high[0] + by, high[1] + by}, farthest};
    }
};

struct Sensor {
    const Update& u;
    const VisibilitySettings& s;
    View view;
    int64_t first, number;  // its rays among all points

    Sensor(const Update& u, int64_t k) : u(u), s(u.settings.visibility), first(k * u.sizes.N), number(u.sizes.N) {
        std::copy_n(&u.measurement.origin[3 * k], 3, view.origin);
        for (int axis = 0; axis < 2; axis++) {
            const float offset = lattice_offset(u, axis, s.resolution);
            view.start[axis] = view.origin[axis] + offset;
            view.first[axis] = std::nearbyint(offset / s.resolution);
            view.size[axis] = float(axis ? u.sizes.W : u.sizes.H);
        }
    }

    // Rays n to n + count.
    template <class Count> Ray<Lanes> ray(int64_t n, Count count) const {
        const Measurement& m = u.measurement;
        const int64_t k = first + n;
        return sensor_ray<Lanes>(load(&m.x[k], count) - view.origin[0], load(&m.y[k], count) - view.origin[1],
                                 load(&m.z[k], count) - view.origin[2]);
    }

    template <class Count> Flags casts(int64_t n, Count count) const {
        return load_bytes(&u.measurement.casts[first + n], count) > 0;
    }

    template <class Count> Flags used(int64_t n, Count count) const {
        return load_bytes(&u.measurement.used[first + n], count) > 0;
    }

    // Standard deviation of the rays' ends [m].
    template <class Count> Lanes noise(int64_t n, Count count) const {
        const Measurement& m = u.measurement;
        const Lanes own = load(&m.noise[first + n], count);
        return root(m.has_covariance ? own + load(&m.of_pose[first + n], count) : own);
    }

    // The places that rays which cast reach; the sensor's own is one of them.
    Extent extent() const {
        Extent whole{};
        std::mutex mutex;
        u.each(number, RAYS_AT_A_TIME, [&](int64_t, int64_t begin, int64_t end) {
            const Extent own = extent_of(begin, end);
            const std::lock_guard<std::mutex> lock(mutex);
            whole.include(own);
        });
        return whole;
    }

  private:
    Extent extent_of(int64_t begin, int64_t end) const {
        Lanes low[2]{}, high[2]{}, square{};
        auto include = [&](int64_t n, auto count) {
            const Measurement& m = u.measurement;
            const Flags casting = casts(n, count);
            const Lanes x = pick(casting, load(&m.x[first + n], count) - view.origin[0], splat(0));
            const Lanes y = pick(casting, load(&m.y[first + n], count) - view.origin[1], splat(0));
            low[0] = smaller(low[0], x), high[0] = larger(high[0], x);
            low[1] = smaller(low[1], y), high[1] = larger(high[1], y);
            square = larger(square, x * x + y * y);
        };
        each_vector(begin, end, number, include);
        const Lanes r = root(larger(square, splat(1e-12f)));
        Extent own{};
        for (int l = 0; l < LANES; l++)
            own.include({{low[0][l], low[1][l]}, {high[0][l], high[1][l]}, r[l]});
        return own;
    }
};

}  // namespace visibility
