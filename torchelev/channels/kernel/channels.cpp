// Channels that follow their maps, and take in what points bring, in place: module.py.

#include <cstring>
#include <limits>
#include <utility>
#include <vector>

#include "channels/kernel/equation.h"
#include "channels/kernel/inputs.h"
#include "kernels/threads.h"

namespace {

using channels::Channel, channels::Frame, channels::INFINITE, channels::Origin, channels::TINY, channels::Update;

constexpr float NOT_KNOWN = std::numeric_limits<float>::quiet_NaN();
constexpr int64_t CACHE = 1 << 17;  // [bytes] of a range's sums
constexpr int MAX_RANGES = 64;            // ranges of cells
constexpr int64_t BLOCK = 64;  // cells or points that are looked at together

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
    std::vector<int32_t> slot;            // cell of each point, -1 if it lies over none that is known
    std::vector<int32_t> order;           // the points by range of cells
    std::vector<int64_t> place;           // in `order`, of each range of cells and part of the points
    std::vector<float> distance, weight;  // [m] from the cell's elevation; POINT / sigma^2
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
    int shift = 0;       // of a cell's number to that of its range
    int64_t ranges = 0;  // of cells

    void follow() {
        int64_t shift[2];
        for (int axis = 0; axis < 2; axis++) {
            const int64_t now = u.corner_now[2 * b + axis], largest = std::max(u.H, u.W);
            shift[axis] = std::clamp(now - u.corner[2 * b + axis], -largest, largest);
            u.corner[2 * b + axis] = now;
        }
        if (shift[0] || shift[1]) move_layers(shift);
        parts(cells, [&](int64_t, int64_t begin, int64_t end) {
            for (int64_t first = begin; first < end; first += BLOCK) {
                const int64_t last = std::min(first + BLOCK, end);
                float rise[BLOCK];
                note_heights(first, last, rise);
                for (int64_t k = 0; k < u.K; k++) keep(u.channels[k], first, last, rise);
            }
        });
    }

    void move_layers(const int64_t* shift) {
        for_each(int(3 * u.K + 1), parts.num_threads, [&](int n) {  // the largest first
            const Channel& channel = u.channels[n % std::max<int64_t>(u.K, 1)];
            if (n == 3 * u.K) move(u.height + b * cells, u.H, u.W, 1, shift, NOT_KNOWN);
            else if (n < u.K) move(channel.values + b * cells * channel.C, u.H, u.W, channel.C, shift, 0);
            else if (n < 2 * u.K) move(channel.weight + b * cells, u.H, u.W, 1, shift, 0);
            else if (channel.age) move(channel.age + b * cells, u.H, u.W, 1, shift, 0);
        });
    }

    // Note the elevations of a block of cells, and by how much they rose or fell, NaN where they are not known.
    void note_heights(int64_t begin, int64_t end, float* __restrict rise) {
        const float* __restrict elevation = u.elevation + b * cells + begin;
        const uint8_t* __restrict known = u.validity + b * cells + begin;
        float* __restrict height = u.height + b * cells + begin;
        const float drift = u.drift ? u.drift[b] : 0;
        for (int64_t n = 0; n < end - begin; n++) {
            const float now = known[n] ? elevation[n] : NOT_KNOWN;
            rise[n] = std::fabs(now - (height[n] + drift));
            height[n] = now;
        }
    }

    // Age the cells of a block of a channel, and forget those whose ground is another one.
    void keep(const Channel& channel, int64_t begin, int64_t end, const float* __restrict rise) {
        const float dt = u.dt[b], tolerance = channel.tolerance, max_age = channel.max_age;
        const int64_t number = end - begin, first = b * cells + begin;
        float* __restrict weight = channel.weight + first;
        float* __restrict age = channel.age ? channel.age + first : nullptr;
        for (int64_t n = 0; age && n < number; n++) age[n] = weight[n] != 0 ? age[n] + dt : 0;
        auto is_lost = [&](int64_t n) { return !(rise[n] <= tolerance) | (age && age[n] > max_age); };
        int lost = 0;  // mostly 0: then the block is left as it is
        for (int64_t n = 0; !age && n < number; n++) lost |= !(rise[n] <= tolerance) & (weight[n] != 0);
        for (int64_t n = 0; age && n < number; n++) lost |= is_lost(n) & (weight[n] != 0);
        float* values = channel.values + first * channel.C;
        for (int64_t n = 0; lost && n < number; n++) {
            if (!is_lost(n)) continue;
            weight[n] = 0;
            if (age) age[n] = 0;
            std::fill(values + n * channel.C, values + (n + 1) * channel.C, 0.0f);
        }
        if (channel.half_life == INFINITE) return;
        const float share = std::exp2(-dt / channel.half_life);
        for (int64_t n = 0; n < number; n++) weight[n] *= share;
        if (channel.kind == channels::CLASS)
            for (int64_t n = 0; n < number * channel.C; n++) values[n] *= share;
    }

    // Find the cells of all points, and sort the points by ranges of cells whose sums fit the cache.
    void locate() {
        const int64_t M = u.S * u.N;
        own.slot.resize(M), own.distance.resize(M), own.weight.resize(M), own.order.resize(M);
        shift = shift_of_ranges();
        ranges = ((cells - 1) >> shift) + 1;
        own.place.assign((ranges + 1) * parts.number, 0);  // the last range is that of no cell
        const Origin origin(u, b);
        parts(M, [&](int64_t part, int64_t begin, int64_t end) {
            for (int64_t s = u.N ? begin / u.N : u.S; s * u.N < end; s++)
                find_all(origin, s, std::max(begin, s * u.N), std::min(end, (s + 1) * u.N));
            int64_t number[MAX_RANGES + 1] = {};  // of this thread alone: others would wait for its cache line
            for (int64_t m = begin; m < end; m++) number[range_of(m)]++;
            for (int64_t r = 0; r <= ranges; r++) own.place[r * parts.number + part] = number[r];
        });
        int64_t before = 0;
        for (int64_t& place : own.place) before += std::exchange(place, before);
        own.place.push_back(before);
        parts(M, [&](int64_t part, int64_t begin, int64_t end) {
            int64_t place[MAX_RANGES + 1];
            for (int64_t r = 0; r <= ranges; r++) place[r] = own.place[r * parts.number + part];
            for (int64_t m = begin; m < end; m++) own.order[place[range_of(m)]++] = int32_t(m);
        });
    }

    int shift_of_ranges() const {
        int64_t largest = 1;
        for (int64_t k = 0; k < u.K; k++)
            if (u.channels[k].features) largest = std::max(largest, u.channels[k].C);
        int shift = 6;
        while (shift < 30 && ((largest + 1) * int64_t(sizeof(float)) << (shift + 1) <= CACHE || cells >> shift >= MAX_RANGES))
            shift++;
        return shift;
    }

    int64_t range_of(int64_t m) const { return own.slot[m] < 0 ? ranges : own.slot[m] >> shift; }

    // Find the cells of points `begin` to `end`, of sensor s, and how much they count.
    void find_all(const Origin& origin, int64_t s, int64_t begin, int64_t end) {
        const double* T = u.T_map_sensor + 16 * (b * u.S + s);
        bool is_sound = origin.is_sound;
        for (int n = 0; n < 12; n++) is_sound &= std::isfinite(T[n]);
        if (!is_sound) return std::fill(own.slot.begin() + begin, own.slot.begin() + end, -1);
        const Frame frame(u, b, T, origin);
        for (int64_t m = begin; m < end; m += BLOCK) find(m, std::min(m + BLOCK, end), frame);
    }

    // Find those of a block.
    void find(int64_t begin, int64_t end, const Frame& given) {
        const Frame frame = given;  // a copy that nothing else can change: the loops become vectors
        const float* p = u.points + 3 * (b * u.S * u.N + begin);
        const float* variance = u.variance ? u.variance + b * u.S * u.N + begin : nullptr;
        const int64_t number = end - begin;
        float x[BLOCK] = {}, y[BLOCK] = {}, z[BLOCK] = {}, ax[BLOCK], ay[BLOCK], az[BLOCK], share[BLOCK];
        int32_t cell[BLOCK];
        for (int64_t n = 0; n < number; n++) x[n] = p[3 * n], y[n] = p[3 * n + 1], z[n] = p[3 * n + 2];
        for (int64_t n = 0; n < BLOCK; n++)
            frame.place(x[n], y[n], z[n], ax[n], ay[n], az[n], cell[n], share[n]);
        for (int64_t n = 0; n < BLOCK; n++) share[n] = channels::POINT / share[n];
        for (int64_t n = 0; variance && n < number; n++) {
            const bool is_sound = variance[n] >= TINY && variance[n] < INFINITE;
            share[n] = channels::POINT / variance[n], cell[n] = is_sound ? cell[n] : -1;
        }
        for (int64_t n = 0; u.has_box && u.T_map_base && n < BLOCK; n++)
            cell[n] = frame.is_inside(ax[n], ay[n], az[n], u.box) ? -1 : cell[n];
        for (int64_t n = 0; u.has_ramp && n < BLOCK; n++)
            cell[n] = frame.is_above(ax[n], ay[n], az[n], u.ramp) ? -1 : cell[n];
        const uint8_t* is_own = u.own ? u.own + b * u.S * u.N + begin : nullptr;
        for (int64_t n = 0; is_own && n < number; n++) cell[n] = is_own[n] ? -1 : cell[n];
        int32_t* slot = own.slot.data() + begin;
        float *distance = own.distance.data() + begin, *weight = own.weight.data() + begin;
        const float* elevation = u.elevation + b * cells;
        const uint8_t* known = u.validity + b * cells;
        for (int64_t n = 0; n < number; n++) {
            const int64_t c = std::max(cell[n], 0);
            slot[n] = known[c] ? cell[n] : -1, weight[n] = share[n], distance[n] = std::fabs(az[n] - elevation[c]);
        }
    }

    void fuse(const Channel& channel) {
        for_each(int(ranges), parts.num_threads, [&](int range) {
            if (channel.C == 1) fuse_cells<1>(channel, range);
            else if (channel.C == 3) fuse_cells<3>(channel, range);
            else fuse_cells<0>(channel, range);
        });
    }

    // Fuse the points of a range of cells; SIZE is C, or 0 for any.
    template <int SIZE> void fuse_cells(const Channel& channel, int64_t range) {
        const int64_t C = SIZE ? SIZE : channel.C, stride = C + 1;
        const int64_t begin = range << shift, end = std::min(cells, (range + 1) << shift);
        const int64_t first = own.place[range * parts.number], last = own.place[(range + 1) * parts.number];
        if (first == last) return;
        static thread_local std::vector<float> memory;  // kept, as is `Scratch`; zero between two calls
        static thread_local std::vector<int32_t> hit;   // cells
        memory.resize(std::max<size_t>(memory.size(), (end - begin) * stride));
        hit.resize(std::max<size_t>(hit.size(), last - first + 1));
        const int64_t number = add_points<SIZE>(channel, first, last, memory.data() - begin * stride, hit.data());
        float *values = channel.values + b * cells * C, *weight = channel.weight + b * cells;
        for (int64_t n = 0; n < number; n++) {
            const int64_t c = hit[n];
            float* sum = memory.data() + (c - begin) * stride;
            if (!(sum[C] > 0)) continue;  // points that weigh nothing
            for (int64_t k = 0; k < C; k++)
                values[c * C + k] =
                    channels::combine(channel.kind, values[c * C + k], weight[c], sum[k], sum[C], channel.rate);
            weight[c] += sum[C];
            if (channel.age) channel.age[b * cells + c] = 0;
            std::fill(sum, sum + stride, 0.0f);
        }
    }

    // Add points, by their places in `order`, to the sums of their cells: C values, and the total of the weights, which
    // are zero before. Note the cells, and return how many there are.
    template <int SIZE>
    int64_t add_points(const Channel& channel, int64_t first, int64_t last, float* sums, int32_t* hit) const {
        const int64_t C = SIZE ? SIZE : channel.C;
        const bool weighted = channels::is_weighted(channel.kind), is_maximum = channel.kind == channels::MAXIMUM;
        const float* const features = channel.features + b * u.S * u.N * C;
        int64_t number = 0;
        for (int64_t n = first; n < last; n++) {
            const int64_t m = own.order[n];
            const float* x = features + m * C;
            float zero = 0;  // NaN where a value is not finite
            for (int64_t k = 0; k < C; k++) zero += x[k] * 0;
            const float w = weighted ? own.weight[m] : 1.0f;
            if (!(own.distance[m] <= channel.tolerance) || zero != 0) continue;
            float* sum = sums + own.slot[m] * (C + 1);
            hit[number] = own.slot[m], number += sum[C] == 0;
            for (int64_t k = 0; k < C; k++)
                sum[k] = !is_maximum ? sum[k] + w * x[k] : sum[C] > 0 ? std::max(sum[k], x[k]) : x[k];
            sum[C] += w;
        }
        return number;
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
