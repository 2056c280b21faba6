// Height scans of many robots: scan/reading.py. The points that are read decide what is computed, not the window.

#include "observations/kernel/scan_of_robot.h"

using namespace scans;

extern "C" int read_height_scans(const Scan* scan, int num_threads) {
    return code_of([&] {
        const int64_t M = scan->origins * scan->points;
        const int threads = scan->environments * M > FEW ? num_threads : 1;
        const auto make = [&] { return Robot(*scan); };
        for_each(int(scan->environments), threads, make, [](int64_t b, Robot& robot) {
            robot.b = b;
            robot.read_all();
        });
    });
}
