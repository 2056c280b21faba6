// Heights of the surfaces of height fields at points: HeightField.height.

#include <algorithm>
#include <cstdint>

#include "kernels/threads.h"
#include "order.h"
#include "surfaces.h"

namespace {

constexpr int64_t FEW = 4096;  // points, which one thread reads before another one wakes up

// `_Query` of terrains/heights_kernel.py: points (B, M, 2) [m] on tiles of L fields (K, rows + 1, columns + 1), rim included.
struct Query {
    const float* const* fields;
    const int64_t* tiles;
    const float* points;
    float* heights;  // (L, B, M)
    int64_t L, K, B, M;
    int32_t rows, columns, surface;
    float resolution;
};

// Where points lie: the cell that counts, and the place from its first sample, in cells.
struct Place {
    Flags first;  // sample
    Lanes u, v;
};

inline Place find_place(const Query& query, Lanes x, Lanes y) {
    const Lanes limit = splat(3.4028234663852886e38f);
    x = pick(x == x, x / query.resolution, splat(0)), y = pick(y == y, y / query.resolution, splat(0));
    const Lanes across = smaller(larger(x, -limit), limit) + 0.5f * query.rows;
    const Lanes along = smaller(larger(y, -limit), limit) + 0.5f * query.columns;
    const Lanes i = floor_of(across), j = floor_of(along);
    const Flags row = integers(clamp(i, 0, query.rows - 1)), column = integers(clamp(j, 0, query.columns - 1));
    return {row * (query.columns + 1) + column, across - i, along - j};
}

template <Surface surface> void read(const Query& query, int64_t b) {
    const int64_t tile = checked(query.tiles[b], query.K), width = query.columns + 1;
    for (int64_t m = 0; m < query.M; m += LANES) {
        const int count = int(std::min<int64_t>(LANES, query.M - m));
        Lanes x{}, y{};
        for (int l = 0; l < count; l++) {
            const float* point = query.points + 2 * (b * query.M + m + l);
            x[l] = point[0], y[l] = point[1];
        }
        const Place place = find_place(query, x, y);
        for (int64_t field = 0; field < query.L; field++) {
            const float* samples = query.fields[field] + tile * (query.rows + 1) * width;
            const Lanes z = height<surface>(coefficients(samples, place.first, int(width)), place.u, place.v);
            store(query.heights + (field * query.B + b) * query.M + m, z, count);
        }
    }
}

}  // namespace

extern "C" int read_heights(const Query* query, int num_threads) {
    return code_of([&] {
        const int surface = query->surface, threads = query->B * query->M > FEW ? num_threads : 1;
        const auto work = surface == BILINEAR ? read<BILINEAR> : surface == RISING ? read<RISING> : read<FALLING>;
        const std::vector<int> order = order_by_tile(query->tiles, int(query->B));
        for_each(int(query->B), threads, [&](int64_t k) { work(*query, order[k]); });
    });
}
