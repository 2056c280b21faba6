// The cells that cameras see, of many robots: camera.py.

#include <algorithm>
#include <limits>
#include <vector>

#include "channels/kernel/camera.h"
#include "channels/kernel/equation.h"
#include "kernels/threads.h"

static_assert(sizeof(channels::Camera) == 26 * sizeof(float), "as `_pack` of views.py");

// `_Views` of views.py.
struct Views {
    const channels::Camera* cameras;  // (B, V)
    const float* elevation;           // (B, H, W) [m]
    const uint8_t* validity;          // (B, H, W)
    float* uv;                        // (B, V, H, W, 2) [pixels]
    uint8_t* seen;                    // (B, V, H, W)
    int64_t B, V, H, W, image_height, image_width;
    float resolution, margin;
};

// `_Painting` of views.py.
struct Painting {
    const float* image;          // (B, V, C, h, w)
    const float* uv;             // (B, V, H, W, 2) [pixels]
    const uint8_t* seen;         // (B, V, H, W)
    float *values, *weight, *age;  // (B, H, W, C), (B, H, W), (B, H, W) or null
    int64_t B, V, C, cells, image_height, image_width;
    int32_t kind, is_nearest;
    float rate;
};

namespace {

void look(const Views& all, int64_t b, int64_t v, const float* high, int64_t begin, int64_t end) {
    const channels::Camera& camera = all.cameras[b * all.V + v];
    const channels::Ground ground{high, all.H, all.W};
    const int64_t cells = all.H * all.W;
    float* uv = all.uv + 2 * (b * all.V + v) * cells;
    uint8_t* seen = all.seen + (b * all.V + v) * cells;
    const float at_i = -camera.x / all.resolution + 0.5f, at_j = -camera.y / all.resolution + 0.5f;
    for (int64_t i = begin; i < end; i++) {
        for (int64_t j = 0; j < all.W; j++) {
            const int64_t c = i * all.W + j;
            seen[c] = 0, uv[2 * c] = uv[2 * c + 1] = 0;
            if (!(high[c] > -std::numeric_limits<float>::infinity())) continue;
            const float dx = camera.x + all.resolution * float(i), dy = camera.y + all.resolution * float(j);
            const float dz = high[c] - camera.z;
            float u, w;
            if (!camera.project(dx, dy, dz, u, w)) continue;
            if (!(u >= -0.5f && u < float(all.image_width) - 0.5f && w >= -0.5f && w < float(all.image_height) - 0.5f))
                continue;
            uv[2 * c] = u, uv[2 * c + 1] = w;
            const float di = dx / all.resolution, dj = dy / all.resolution;
            seen[c] = !ground.hides(at_i, at_j, camera.z, di, dj, dz, all.margin);
        }
    }
}

// Reads pixels as `F.grid_sample` does with its border: out of the picture, the nearest pixel.
class Pixel {
  public:
    Pixel(float u, float v, int64_t h, int64_t w, bool is_nearest) {
        u = std::clamp(u, 0.0f, float(w - 1)), v = std::clamp(v, 0.0f, float(h - 1));
        if (is_nearest) u = std::nearbyint(u), v = std::nearbyint(v);
        const float left = std::floor(u), top = std::floor(v);
        a = u - left, b = v - top;
        const int64_t i = int64_t(left), j = int64_t(top);
        place[0] = j * w + i, place[1] = j * w + std::min(i + 1, w - 1);
        place[2] = std::min(j + 1, h - 1) * w + i, place[3] = std::min(j + 1, h - 1) * w + std::min(i + 1, w - 1);
    }
    float operator()(const float* plane) const {
        if (a == 0 && b == 0) return plane[place[0]];
        return plane[place[0]] * ((1 - a) * (1 - b)) + plane[place[1]] * (a * (1 - b)) +
               plane[place[2]] * ((1 - a) * b) + plane[place[3]] * (a * b);
    }

  private:
    int64_t place[4];
    float a, b;
};

// Fuse what the cameras see of cell c into a channel; `sum` has room for C values.
void paint_cell(const Painting& p, int64_t b, int64_t c, float* sum, float* x) {
    const int64_t pixels = p.image_height * p.image_width;
    float total = 0;
    for (int64_t v = 0; v < p.V; v++) {
        const int64_t view = (b * p.V + v) * p.cells + c;
        if (!p.seen[view]) continue;
        const Pixel pixel(p.uv[2 * view], p.uv[2 * view + 1], p.image_height, p.image_width, p.is_nearest);
        const float* image = p.image + (b * p.V + v) * p.C * pixels;
        bool is_sound = true;
        for (int64_t k = 0; k < p.C; k++) x[k] = pixel(image + k * pixels), is_sound &= std::isfinite(x[k]);
        if (!is_sound) continue;
        for (int64_t k = 0; k < p.C; k++)
            sum[k] = total == 0 ? x[k] : p.kind == channels::MAXIMUM ? std::max(sum[k], x[k]) : sum[k] + x[k];
        total += 1;
    }
    if (total == 0) return;
    const int64_t cell = b * p.cells + c;
    for (int64_t k = 0; k < p.C; k++)
        p.values[cell * p.C + k] =
            channels::combine(p.kind, p.values[cell * p.C + k], p.weight[cell], sum[k], total, p.rate);
    p.weight[cell] += total;
    if (p.age) p.age[cell] = 0;
}

}  // namespace

extern "C" int paint_channel(const Painting* p, int num_threads) {
    return code_of([&] {
        for_environments(p->B, num_threads, [&](int64_t b, int threads) {
            const Parts parts{threads > 1 ? 16 * threads : 1, threads};
            parts(p->cells, [&](int64_t, int64_t begin, int64_t end) {
                std::vector<float> memory(2 * p->C);
                for (int64_t c = begin; c < end; c++) paint_cell(*p, b, c, memory.data(), memory.data() + p->C);
            });
        });
    });
}

extern "C" int find_seen(const Views* all, int num_threads) {
    return code_of([&] {
        const int64_t cells = all->H * all->W;
        const auto make = [] { return std::vector<float>(); };
        for_environments(all->B, num_threads, make, [&](int64_t b, int threads, std::vector<float>& high) {
            high.resize(cells);
            for (int64_t c = 0; c < cells; c++)
                high[c] = all->validity[b * cells + c] ? all->elevation[b * cells + c]
                                                       : -std::numeric_limits<float>::infinity();
            // Many parts: a camera sees few of the rows.
            const Parts parts{threads > 1 ? 16 * threads : 1, threads};
            for (int64_t v = 0; v < all->V; v++)
                parts(all->H, [&](int64_t, int64_t begin, int64_t end) { look(*all, b, v, high.data(), begin, end); });
        });
    });
}
