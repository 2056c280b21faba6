// A robot before a step of 15 cm: its map, and the 187 heights that a policy reads.
#include <cstdio>
#include <torchelev.hpp>

namespace {

torchelev::Pose pose(double x, double z) { return {1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, z, 0, 0, 0, 1}; }

// Points every 3 cm of ground that is 15 cm higher from x = 1 m on, seen from (x, 0, z).
std::vector<float> look(double x, double z) {
    std::vector<float> points;
    for (double a = -2; a < 2; a += 0.03)
        for (double b = -2; b < 2; b += 0.03)
            points.insert(points.end(), {float(a), float(b), float((x + a > 1) * 0.15 - z)});
    return points;
}

}  // namespace

int main(int count, char** arguments) try {
    if (count != 2) return std::fprintf(stderr, "usage: %s map.json\n", arguments[0]), 2;
    torchelev::Map map(arguments[1]);
    torchelev::HeightScan scan(map, "isaac_lab");
    for (int k = 0; k < 10; k++) {
        const auto T_map_base = pose(0.05 * k, 0.5);
        map.update(look(0.05 * k, 0.5), T_map_base, T_map_base, 0.02);
    }
    const std::vector<float>& heights = scan(map, pose(0.45, 0.5));
    for (int y = 0; y < 11; y++)
        for (int x = 0; x < 17; x++) std::printf("%6.2f%s", heights[17 * y + x], x < 16 ? "" : "\n");
    std::printf("points used: %lld\n", static_cast<long long>(map.statistics().points_used));
} catch (const torchelev::Error& error) {
    return std::fprintf(stderr, "%s\n", error.what()), 1;
}
