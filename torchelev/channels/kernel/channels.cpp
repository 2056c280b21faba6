// Channels that follow their maps, and take in what points bring, in place: module.py.

#include <cstring>
#include <limits>
#include <vector>

#include "channels/kernel/equation.h"
#include "kernels/threads.h"

namespace {

constexpr float NOT_KNOWN = std::numeric_limits<float>::quiet_NaN();
constexpr int64_t AHEAD = 16;  // points ahead of which memory is fetched
constexpr int64_t BLOCK = 64;  // cells or points that are looked at together
constexpr int64_t FAR = int64_t(1) << 22;  // [cells] whole numbers up to it fit a float
constexpr float NEVER = std::numeric_limits<float>::infinity();

// `_Channel` of native.py.
struct Channel {
    float *values, *weight, *age;  // (B, H, W, C), (B, H, W), (B, H, W) or null
    const float* features;         // (B, M, C), null if the update brings none
    int64_t C;
    int32_t kind;
    float rate, half_life, max_age, tolerance;  // half_life: infinite for none
};

// `_Update` of native.py.
struct Update {
    const float* points;          // (B, S, N, 3) [m] sensor frame
    const double* T_map_sensor;   // (B, S, 4, 4)
    const float* variance;        // (B, S, N) [m^2], or null
    const uint8_t* own;           // (B, S, N) points on the robot's links, or null
    const double* T_base_sensor;  // (B, S, 4, 4), or null without a box
    const float* box;             // (2, 3) [m] lower and upper corner of the robot's box, base frame, or null
    const int64_t* anchor;        // (B, 2) cell that points count from
    const float *dt, *drift;      // (B) [s], (B) [m] or null
    const int64_t* corner_now;    // (B, 2)
    const float* elevation;       // (B, H, W) [m]
    const uint8_t* validity;      // (B, H, W)
    int64_t* corner;              // (B, 2)
    float* height;                // (B, H, W) [m]
    const Channel* channels;      // (K)
    int64_t B, S, N, H, W, K;
    double resolution;
    float noise_factor, noise_floor, min_distance, max_distance;  // of the sensor [m]
};

// Give cell (i, j) of H x W cells of C values what was at (i, j) + by, or `blank` if that lies outside.
void move(float* layer, int64_t H, int64_t W, int64_t C, const int64_t* by, float blank) {
    const int64_t offset = by[0] * W + by[1], size = H * W;
    const int64_t begin = std::clamp(-offset, int64_t(0), size), end = std::clamp(size - offset, begin, size);
    std::memmove(layer + begin * C, layer + (begin + offset) * C, (end - begin) * C * sizeof(float));
    const int64_t first = std::clamp(-by[1], int64_t(0), W), last = std::clamp(W - by[1], first, W);
    const int64_t top = std::clamp(-by[0], int64_t(0), H), bottom = std::clamp(H - by[0], top, H);
    std::fill(layer, layer + top * W * C, blank), std::fill(layer + bottom * W * C, layer + size * C, blank);
    if (first == 0 && last == W) return;
    for (int64_t row = top * W; row < bottom * W; row += W) {
        std::fill(layer + row * C, layer + (row + first) * C, blank);
        std::fill(layer + (row + last) * C, layer + (row + W) * C, blank);
    }
}

// Memory of one thread.
struct Scratch {
    std::vector<int32_t> slot;             // cell of each point
    std::vector<std::vector<int32_t>> points;  // over known cells: of each part of them, by the range of the cell
    std::vector<int64_t> count;                // of the points of each list
    std::vector<float> distance, weight;   // [m] from the cell's elevation; POINT / sigma^2
    std::vector<float> rise;               // of each cell [m] since the last update, NaN where it is not known
    std::vector<float> sum;                // of each cell: C values, and the total of the weights
};

// Where a sensor's points lie in the window, and how much they count.
struct Frame {
    float R[9], t[3], first[2], resolution, H, W, noise_factor, noise_floor, nearest2, farthest2;
    int32_t width;

    Frame(const Update& u, int64_t b, const float* rotation, const float* origin)
        : resolution(float(u.resolution)), H(float(u.H)), W(float(u.W)), noise_factor(u.noise_factor),
          noise_floor(u.noise_floor), nearest2(u.min_distance * u.min_distance),
          farthest2(u.max_distance * u.max_distance), width(int32_t(u.W)) {
        std::copy(rotation, rotation + 9, R), std::copy(origin, origin + 3, t);
        for (int axis = 0; axis < 2; axis++)
            first[axis] = float(std::clamp(u.anchor[2 * b + axis] - u.corner[2 * b + axis], -FAR, FAR));
    }

    // Return whether a point lies in a box of the base frame, where the sensor is at `place`.
    static bool is_inside(const float* turn, const float* place, const float* box, float x, float y, float z) {
        bool inside = true;
        for (int axis = 0; axis < 3; axis++) {
            const float c = turn[3 * axis] * x + turn[3 * axis + 1] * y + turn[3 * axis + 2] * z + place[axis];
            inside &= (c >= box[axis]) & (c <= box[3 + axis]);
        }
        return inside;
    }

    // Find the cell of a point, -1 out of the window, its height, and POINT / sigma^2.
    void place(float x, float y, float z, int32_t& cell, float& height, float& weight) const {
        const float d2 = x * x + y * y + z * z;
        // As `Window::slot`: a point on the border of two cells belongs to that whose height it measures.
        const float i = std::floor((R[0] * x + R[1] * y + R[2] * z + t[0]) / resolution) + first[0];
        const float j = std::floor((R[3] * x + R[4] * y + R[5] * z + t[1]) / resolution) + first[1];
        const bool inside = (d2 >= nearest2) & (d2 <= farthest2) & (d2 < NEVER) & (i >= 0) & (i < H) & (j >= 0) & (j < W);
        cell = inside ? int32_t(inside ? i : 0) * width + int32_t(inside ? j : 0) : -1;
        height = R[6] * x + R[7] * y + R[8] * z + t[2];
        weight = channels::POINT / (noise_factor * d2 + noise_floor);
    }
};

class Map {
  public:
    Map(const Update& u, int64_t b, int num_threads, Scratch& own)
        : u(u), b(b), own(own), cells(u.H * u.W), parts{num_threads, num_threads} {}

    void run() {
        follow();
        bool has_points = false;
        for (int64_t k = 0; k < u.K; k++) has_points |= u.channels[k].features != nullptr;
        if (!has_points) return;
        locate();
        for (int64_t k = 0; k < u.K; k++)
            if (u.channels[k].features) fuse(u.channels[k]);
    }

  private:
    const Update& u;
    const int64_t b;
    Scratch& own;
    const int64_t cells;
    const Parts parts;

    void follow() {
        int64_t shift[2];
        for (int axis = 0; axis < 2; axis++) {
            const int64_t now = u.corner_now[2 * b + axis], largest = std::max(u.H, u.W);
            shift[axis] = std::clamp(now - u.corner[2 * b + axis], -largest, largest);
            u.corner[2 * b + axis] = now;
        }
        const bool moves = shift[0] || shift[1];
        float* height = u.height + b * cells;
        if (moves) move(height, u.H, u.W, 1, shift, NOT_KNOWN);
        const float* elevation = u.elevation + b * cells;
        const uint8_t* known = u.validity + b * cells;
        const float drift = u.drift ? u.drift[b] : 0;
        own.rise.resize(cells);
        parts(cells, [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t c = begin; c < end; c++) {
                const float now = known[c] ? elevation[c] : NOT_KNOWN;
                own.rise[c] = std::fabs(now - (height[c] + drift));
                height[c] = now;
            }
        });
        for (int64_t k = 0; k < u.K; k++) {
            const Channel& channel = u.channels[k];
            if (moves) {
                move(channel.values + b * cells * channel.C, u.H, u.W, channel.C, shift, 0);
                move(channel.weight + b * cells, u.H, u.W, 1, shift, 0);
                if (channel.age) move(channel.age + b * cells, u.H, u.W, 1, shift, 0);
            }
            parts(cells, [&](int64_t, int64_t begin, int64_t end) { keep(channel, begin, end); });
        }
    }

    // Age the cells of a channel, and forget those whose ground is another one.
    void keep(const Channel& channel, int64_t begin, int64_t end) {
        const float dt = u.dt[b], share = channel.half_life < NEVER ? std::exp2(-dt / channel.half_life) : 1.0f;
        float* values = channel.values + b * cells * channel.C;
        float* weight = channel.weight + b * cells;
        float* age = channel.age ? channel.age + b * cells : nullptr;
        for (int64_t first = begin; first < end; first += BLOCK) {
            const int64_t last = std::min(first + BLOCK, end);
            int lost = 0;  // mostly 0: then the block is left as it is
            for (int64_t c = first; c < last; c++) {
                if (age) age[c] = weight[c] != 0 ? age[c] + dt : 0;
                const bool stays = own.rise[c] <= channel.tolerance && !(age && age[c] > channel.max_age);
                lost += !stays & (weight[c] != 0);
            }
            for (int64_t c = first; lost && c < last; c++) {
                if (own.rise[c] <= channel.tolerance && !(age && age[c] > channel.max_age)) continue;
                weight[c] = 0;
                if (age) age[c] = 0;
                std::fill(values + c * channel.C, values + (c + 1) * channel.C, 0.0f);
            }
        }
        if (share == 1) return;
        for (int64_t c = begin; c < end; c++) weight[c] *= share;
        if (channel.kind == channels::CLASS)
            for (int64_t n = begin * channel.C; n < end * channel.C; n++) values[n] *= share;
    }

    void locate() {
        const int64_t M = u.S * u.N;
        own.slot.resize(M), own.distance.resize(M), own.weight.resize(M);
        own.points.resize(parts.number * parts.number);
        own.count.assign(parts.number * parts.number, 0);
        for (std::vector<int32_t>& list : own.points) list.resize(M);
        for (int64_t s = 0; s < u.S; s++) {
            const double* T = u.T_map_sensor + 16 * (b * u.S + s);
            bool is_sound = true;
            for (int n = 0; n < 12; n++) is_sound &= std::isfinite(T[n]);
            float R[9], t[3];
            for (int row = 0; row < 3; row++) {
                const double corner = row < 2 ? double(u.anchor[2 * b + row]) * u.resolution : 0;
                for (int k = 0; k < 3; k++) R[3 * row + k] = float(T[4 * row + k]);
                t[row] = float(T[4 * row + 3] - corner);
            }
            if (!is_sound) continue;
            parts(u.N, [&](int64_t part, int64_t begin, int64_t end) {
                for (int64_t n = begin; n < end; n += BLOCK) find(s, part, n, std::min(n + BLOCK, end), R, t);
            });
        }
    }

    // Find the cells of points `begin` to `end`, a part of those of sensor s, and how much they count.
    void find(int64_t s, int64_t part, int64_t begin, int64_t end, const float* R, const float* t) {
        const float* p = u.points + 3 * ((b * u.S + s) * u.N + begin);
        const float* variance = u.variance ? u.variance + (b * u.S + s) * u.N + begin : nullptr;
        const int64_t m = s * u.N + begin, number = end - begin;
        float x[BLOCK] = {}, y[BLOCK] = {}, z[BLOCK] = {}, height[BLOCK], share[BLOCK];
        int32_t cell[BLOCK];
        for (int64_t n = 0; n < number; n++) x[n] = p[3 * n], y[n] = p[3 * n + 1], z[n] = p[3 * n + 2];
        const Frame frame(u, b, R, t);
        for (int64_t n = 0; n < BLOCK; n++) frame.place(x[n], y[n], z[n], cell[n], height[n], share[n]);
        for (int64_t n = 0; variance && n < number; n++) {
            const bool is_sound = variance[n] > 0 && variance[n] < NEVER;
            share[n] = channels::POINT / variance[n], cell[n] = is_sound ? cell[n] : -1;
        }
        if (u.box) {
            const double* T = u.T_base_sensor + 16 * (b * u.S + s);
            float turn[9], place[3], box[6];
            for (int row = 0; row < 3; row++) {
                for (int k = 0; k < 3; k++) turn[3 * row + k] = float(T[4 * row + k]);
                place[row] = float(T[4 * row + 3]);
            }
            std::copy(u.box, u.box + 6, box);
            for (int64_t n = 0; n < BLOCK; n++)
                cell[n] = Frame::is_inside(turn, place, box, x[n], y[n], z[n]) ? -1 : cell[n];
        }
        const uint8_t* is_own = u.own ? u.own + (b * u.S + s) * u.N + begin : nullptr;
        for (int64_t n = 0; is_own && n < number; n++) cell[n] = is_own[n] ? -1 : cell[n];
        int32_t* slot = own.slot.data() + m;
        float *distance = own.distance.data() + m, *weight = own.weight.data() + m;
        const float* elevation = u.elevation + b * cells;
        const uint8_t* known = u.validity + b * cells;
        for (int64_t n = 0; n < number; n++) {
            const int64_t c = std::max(cell[n], 0);
            slot[n] = cell[n], weight[n] = share[n];
            distance[n] = std::fabs(height[n] - elevation[c]);
            const int64_t range = ((c + 1) * parts.number - 1) / cells;  // as `Parts` divides the cells
            const int64_t list = part * parts.number + range;
            own.points[list][own.count[list]] = int32_t(m + n);
            own.count[list] += (cell[n] >= 0) & (known[c] != 0);
        }
    }

    void fuse(const Channel& channel) {
        if (int64_t(own.sum.size()) < cells * (channel.C + 1)) own.sum.resize(cells * (channel.C + 1));
        parts(cells, [&](int64_t range, int64_t begin, int64_t end) {
            if (channel.C == 1) fuse_cells<1>(channel, range, begin, end);
            else if (channel.C == 3) fuse_cells<3>(channel, range, begin, end);
            else fuse_cells<0>(channel, range, begin, end);
        });
    }

    // Fuse the points of cells `begin` to `end`, a range of them; SIZE is C, or 0 for any.
    template <int SIZE> void fuse_cells(const Channel& channel, int64_t range, int64_t begin, int64_t end) {
        const int64_t C = SIZE ? SIZE : channel.C, M = u.S * u.N, stride = C + 1;
        const bool weighted = channels::is_weighted(channel.kind), is_maximum = channel.kind == channels::MAXIMUM;
        float* const sums = own.sum.data();
        std::fill(sums + begin * stride, sums + end * stride, 0.0f);
        const float* const features = channel.features + b * M * C;
        for (int64_t part = 0; part < parts.number; part++) {
            const int32_t* points = own.points[part * parts.number + range].data();
            const int64_t number = own.count[part * parts.number + range];
            for (int64_t n = 0; n < number; n++) {
                if (n + AHEAD < number) __builtin_prefetch(sums + own.slot[points[n + AHEAD]] * stride, 1);
                const int64_t m = points[n];
                const float* x = features + m * C;
                float zero = 0;  // NaN where a value is not finite
                for (int64_t k = 0; k < C; k++) zero += x[k] * 0;
                const float w = weighted ? own.weight[m] : 1.0f;
                if (!(own.distance[m] <= channel.tolerance) || zero != 0) continue;
                float* sum = sums + own.slot[m] * stride;
                for (int64_t k = 0; k < C; k++)
                    sum[k] = !is_maximum ? sum[k] + w * x[k] : sum[C] > 0 ? std::max(sum[k], x[k]) : x[k];
                sum[C] += w;
            }
        }
        float *values = channel.values + b * cells * C, *weight = channel.weight + b * cells;
        for (int64_t c = begin; c < end; c++) {
            const float* sum = sums + c * stride;
            if (!(sum[C] > 0)) continue;
            for (int64_t k = 0; k < C; k++)
                values[c * C + k] =
                    channels::combine(channel.kind, values[c * C + k], weight[c], sum[k], sum[C], channel.rate);
            weight[c] += sum[C];
            if (channel.age) channel.age[b * cells + c] = 0;
        }
    }
};

}  // namespace

extern "C" int update_channels(const Update* u, int num_threads) {
    return code_of([&] {
        for_environments(u->B, num_threads, [&](int64_t b, int threads) {
            static thread_local Scratch own;  // kept: pages that are new each time would take as long as the points
            Map(*u, b, threads, own).run();
        });
    });
}
