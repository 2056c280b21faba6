// Counts what updates and reads of a stream allocate after a map was created: none is allowed. The config has a filter,
// `smooth`, whose layer may allocate when it is made, but not when it is read again. With levels, new surfaces may
// allocate: the first instants, as many as the last argument says, are not counted, and the map is reset after them.
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <new>
#include <torchelev.hpp>

static long allocations = 0;

void* operator new(size_t size) {
    allocations++;
    if (void* memory = std::malloc(size)) return memory;
    throw std::bad_alloc();
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, size_t) noexcept { std::free(memory); }

extern "C" void* __real_calloc(size_t number, size_t size);
extern "C" void* __wrap_calloc(size_t number, size_t size) {
    allocations++;
    return __real_calloc(number, size);
}

struct Head {
    double dt, T_map_base[16];
    int32_t num_sensors, num_points;
};

static void read(const torchelev::Map& map, const char* layer, std::vector<float>& values) {
    float sampled;
    const double at[] = {0.1, 0.2};
    torchelev::check(torchelev_map_layer(map.get(), layer, values.data(), values.size()));
    torchelev::check(torchelev_map_sample(map.get(), layer, "bilinear", at, 1, &sampled, nullptr));
}

int main(int, char** arguments) try {
    const torchelev_limits limits{std::atol(arguments[2]), 3, std::atoi(arguments[3])};
    torchelev::Map map(arguments[1], limits);
    torchelev::HeightScan ground(map, "isaac_lab");
    torchelev::HeightScan inpaint(map, "{\"pattern\": [[0.3, 0.2], [-0.4, 0.1]], \"fill\": \"inpaint\"}");
    Head head;
    int64_t rows, columns;
    const int free_instants = std::atoi(arguments[4]);
    torchelev::check(torchelev_map_size(map.get(), &rows, &columns, nullptr));
    std::vector<float> values(size_t(rows * columns));
    std::vector<double> poses(48);
    std::vector<float> points(3 * size_t(limits.max_points));
    std::vector<float> variance(limits.max_points, 1e-4f);
    std::vector<double> covariance(3 * 36, 0.0);
    for (int number = 0; std::fread(&head, sizeof head, 1, stdin) == 1; number++) {
        const size_t S = size_t(head.num_sensors), N = size_t(head.num_points);
        if (std::fread(poses.data(), 8, 16 * S, stdin) != 16 * S ||
            std::fread(points.data(), 4, 3 * S * N, stdin) != 3 * S * N)
            return 2;
        torchelev::Pose base;
        std::copy_n(head.T_map_base, 16, base.begin());
        const bool is_odd = number % 2, is_counted = number >= free_instants;
        if (number == free_instants) map.reset();
        const long before = allocations;
        map.update({head.num_sensors, head.num_points, points.data(), poses.data(), head.T_map_base, nullptr, head.dt,
                    is_odd ? variance.data() : nullptr, is_odd ? covariance.data() : nullptr});
        ground(map, base);
        inpaint(map, base);
        if (number % 7 == 6) map.move(base);
        read(map, "elevation", values);
        if (free_instants) read(map, "ceiling", values);
        if (is_counted && allocations != before) return std::printf("instant %d: %ld allocations\n", number, allocations - before), 1;
        read(map, "smooth", values);
        const long first = allocations;
        read(map, "smooth", values);
        if (allocations != first) return std::printf("a filter's layer is made twice\n"), 1;
    }
    std::printf("none\n");
} catch (const torchelev::Error& error) {
    std::printf("%s\n", error.what());
    return 3;
}
