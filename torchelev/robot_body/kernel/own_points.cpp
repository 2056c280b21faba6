// The points on the robots' links, of many robots and sensors.

#include "robot_body/kernel/own_points.h"

#include "kernels/threads.h"

// `_OwnPoints` of own_kernel.py.
struct OwnPoints {
    const float* points;                      // (B, S, N, 3) [m] sensor frame
    const double* T_map_sensor;               // (B, S, 4, 4)
    const double *T_map_base, *T_base_links;  // (B, 4, 4), (B, K, 4, 4)
    uint8_t* own;                             // (B, S, N)
    robot_body::Body body;
    int64_t B, S, N, K;
};

extern "C" int find_own_points(const OwnPoints* all, int num_threads) {
    return code_of([&] {
        const auto make = [] { return robot_body::Posed(); };
        for_each(int(all->B * all->S), all->B * all->S * all->N > 4096 ? num_threads : 1, make,
                 [&](int64_t k, robot_body::Posed& posed) {
                     const int64_t b = k / all->S;
                     posed.pose(all->body, all->T_map_sensor + 16 * k, all->T_map_base + 16 * b,
                                all->T_base_links + 16 * b * all->K);
                     posed.find(all->points + 3 * k * all->N, all->N, all->body.depth_tolerance, all->own + k * all->N);
                 });
    });
}
