// The steepest fall that rays may have before they pass below recently hit ground: stages/visibility/horizon.py.
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF  // rounded as in torch, so that places fall into the same cells
#else
#pragma GCC optimize("fp-contract=off")
#endif

#include <memory>

#include "falls.h"

namespace {

constexpr int64_t RAYS_AT_A_TIME = 8192;  // that are worth a thread
constexpr int64_t AZIMUTHS_AT_A_TIME = 16;

// Of one sensor: horizontal lengths [m], and azimuths in turns.
struct Rays {
    const float *r, *azimuth;
    int64_t number;
};

// The polar table's size. Of each azimuth it has bins as far as a ray needs.
struct Bins {
    int64_t ranges, azimuths;
    float step;  // [m]

    // Call `see(i, k, a)` with the bins of rays first to last; k is negative for rays that end in the first bin.
    template <class See> void each(const Rays& rays, int64_t first, int64_t last, const See& see) const {
        for (int64_t i = first; i < last; i += LANES) {
            const int count = int(std::min(int64_t(LANES), last - i));
            int32_t k[LANES], a[LANES];
            if (count == LANES)
                find(load(rays.r + i), load(rays.azimuth + i), k, a);
            else
                find(load(rays.r + i, count), load(rays.azimuth + i, count), k, a);
            for (int l = 0; l < count; l++) see(i + l, k[l], a[l]);
        }
    }

  private:
    void find(Lanes r, Lanes turn, int32_t* range, int32_t* azimuth) const {
        const Flags k = integers(clamp(floor_of(r / step) - 1, -1, float(ranges - 1)));
        const Flags a = integers(clamp(floor_of(turn * float(azimuths)), 0, float(azimuths - 1)));
        std::memcpy(range, &k, sizeof k), std::memcpy(azimuth, &a, sizeof a);
    }
};

// The running minimum of the falls of one environment, azimuth by azimuth.
class Horizon {
    const Bins& bins;
    const Rays& rays;
    const int num_threads;
    std::vector<int32_t> number;  // of bins that rays need, by azimuth
    std::vector<int64_t> first;   // where they start
    std::unique_ptr<float[]> steepest;

  public:
    Horizon(const Bins& bins, const Rays& rays, Ground& ground, const float* cosines, const float* sines,
            int num_threads)
        : bins(bins), rays(rays), num_threads(num_threads) {
        measure();
        const int64_t room = place();
        if (2 * room > ground.number) ground.look_at_all(num_threads);  // quicker, as was measured
        const int64_t blocks = (bins.azimuths + AZIMUTHS_AT_A_TIME - 1) / AZIMUTHS_AT_A_TIME;
        for_each(int(blocks), num_threads, [&](int64_t block) {
            const int64_t last = std::min(bins.azimuths, (block + 1) * AZIMUTHS_AT_A_TIME);
            for (int64_t a = block * AZIMUTHS_AT_A_TIME; a < last; a++)
                march({ground, cosines[a], sines[a]}, number[a], steepest.get() + first[a]);
        });
    }

    void look_up(float* limits) const {
        parts()(rays.number, [&](int64_t, int64_t begin, int64_t end) {
            bins.each(rays, begin, end, [&](int64_t i, int k, int a) {
                limits[i] = k < 0 ? NO_FALL : steepest[first[a] + k];
            });
        });
    }

  private:
    Parts parts() const {
        return {std::clamp(rays.number / RAYS_AT_A_TIME, int64_t(1), int64_t(num_threads)), num_threads};
    }

    void measure() {
        const int64_t azimuths = bins.azimuths;
        if (rays.number > azimuths * bins.ranges) {  // rays are more work than bins
            number.assign(azimuths, int32_t(bins.ranges));
            return;
        }
        std::vector<int32_t> farthest(parts().number * azimuths, 0);
        parts()(rays.number, [&](int64_t part, int64_t begin, int64_t end) {
            int32_t* own = &farthest[part * azimuths];
            bins.each(rays, begin, end, [&](int64_t, int k, int a) {
                own[a] = std::max(own[a], k + 1);
            });
        });
        number.assign(farthest.begin(), farthest.begin() + azimuths);
        for (size_t i = azimuths; i < farthest.size(); i++)
            number[i % azimuths] = std::max(number[i % azimuths], farthest[i]);
    }

    // Return for how many bins there is room.
    int64_t place() {
        int64_t size = 0;
        for (int32_t count : number) {
            first.push_back(size);
            size += (count + LANES - 1) / LANES * LANES;  // vectors are stored whole
        }
        steepest.reset(new float[size]);
        return size;
    }
};

}  // namespace

// Limits (B, N) for rays (B, N) from `origin` (B, 3) over maps (B, H, W), whose corners lie at -`offset` (B, 2) [m].
// `validity` is bytes; `cosines` and `sines` (A,) are the azimuths'. `beyond` is the fall outside the window, times rho.
extern "C" int horizon(const float* r, const float* azimuth, const float* origin, const float* offset,
                       const float* elevation, const float* variance, const float* time, const uint8_t* validity,
                       const float* cosines, const float* sines, float* limits, int64_t B, int64_t N, int64_t H,
                       int64_t W, int64_t ranges, int64_t azimuths, float resolution, float step, float relief,
                       float beyond, float gate, float min_time, int num_threads) {
    const Bins bins{ranges, azimuths, step};
    const Settings settings{resolution, step, relief, beyond, gate, min_time};
    auto look = [&](int64_t b, int threads) {
        const int64_t cell = b * H * W;
        const Layers layers{elevation + cell, variance + cell, time + cell, validity + cell};
        Ground ground(settings, layers, origin + 3 * b, offset + 2 * b, H, W);
        const Rays rays{r + b * N, azimuth + b * N, N};
        Horizon(bins, rays, ground, cosines, sines, threads).look_up(limits + b * N);
    };
    return code_of([&] { for_environments(B, num_threads, look); });
}
