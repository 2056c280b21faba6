// A loop of 50 Hz: reads a recorded stream (torchelev.runtime.stream) from standard input, maps it, writes each height
// scan as floats to standard output, and tells on standard error how long updates took.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <thread>
#include <torchelev.hpp>

namespace {

// One instant of the stream: a head, then T_map_sensor (S, 4, 4) as doubles and points (S, N, 3) as floats.
struct Head {
    double dt, T_map_base[16];
    int32_t num_sensors, num_points;
};

struct Instant {
    Head head;
    std::vector<double> T_map_sensor;
    std::vector<float> points;

    bool read() {
        if (std::fread(&head, sizeof head, 1, stdin) != 1) return false;
        if (head.num_sensors < 1 || head.num_points < 0) throw std::runtime_error("stream: no such number of points");
        T_map_sensor.resize(16 * size_t(head.num_sensors));
        points.resize(3 * size_t(head.num_sensors) * head.num_points);
        return std::fread(T_map_sensor.data(), 8, T_map_sensor.size(), stdin) == T_map_sensor.size() &&
               std::fread(points.data(), 4, points.size(), stdin) == points.size();
    }
    torchelev_input input() const {
        return {head.num_sensors, head.num_points, points.data(), T_map_sensor.data(), head.T_map_base, nullptr,
                head.dt,          nullptr,         nullptr};
    }
};

double quantile(const std::vector<double>& sorted, double q) { return sorted[size_t(q * double(sorted.size() - 1))]; }

}  // namespace

int main(int count, char** arguments) try {
    if (count < 3)
        return std::fprintf(stderr, "usage: %s map.json layout [threads [hertz [saved]]] < stream > scans\n",
                            arguments[0]),
               2;
    const int threads = count > 3 ? std::atoi(arguments[3]) : 1;
    const double hertz = count > 4 ? std::atof(arguments[4]) : 0;  // 0: as fast as it goes
    torchelev::Map map(arguments[1], {65536, 4, threads});
    torchelev::HeightScan scan(map, arguments[2]);
    using Clock = std::chrono::steady_clock;
    std::vector<double> times;  // [ms]
    Instant instant;
    for (auto next = Clock::now(); instant.read();) {
        if (hertz > 0) std::this_thread::sleep_until(next += std::chrono::nanoseconds(int64_t(1e9 / hertz)));
        const auto start = Clock::now();
        map.update(instant.input());
        torchelev::Pose T_map_base;
        std::copy_n(instant.head.T_map_base, 16, T_map_base.begin());
        const std::vector<float>& heights = scan(map, T_map_base);
        times.push_back(std::chrono::duration<double, std::milli>(Clock::now() - start).count());
        std::fwrite(heights.data(), 4, heights.size(), stdout);
    }
    if (count > 5) map.save(arguments[5]);
    if (times.empty()) return std::fprintf(stderr, "stream: empty\n"), 1;
    std::sort(times.begin(), times.end());
    std::fprintf(stderr, "%zu updates: p50 %.2f ms, p99 %.2f ms\n", times.size(), quantile(times, 0.5),
                 quantile(times, 0.99));
} catch (const std::exception& error) {
    return std::fprintf(stderr, "%s\n", error.what()), 1;
}
