// Visibility clean-up and the upper bound on a CPU: stage.py.

#include <atomic>
#include <cmath>

#include "stages/visibility/clear.h"
#include "stages/visibility/rays.h"

namespace {

using namespace visibility;

// What a thread keeps from map to map.
struct VisibilityMemory {
    GroundMemory ground;
    HorizonMemory horizon;
    TableMemory table;
    CellsMemory cells;
};

// Apply the rays of one sensor; return how many cells they clear.
int64_t apply_rays(const Sensor& sensor, VisibilityMemory& memory) {
    const Extent extent = sensor.extent();
    if (!(extent.farthest > sensor.s.resolution)) return 0;  // no ray reaches a cell beside the sensor's
    const Ground ground(sensor, extent, memory.ground);
    const Horizon horizon(sensor, ground, extent.farthest, memory.horizon);
    Table table(sensor.u, extent.farthest, memory.table);
    AcceptedRays(sensor, ground, horizon).put_into(table);
    table.finish();
    return Cells(sensor, extent, table, memory.cells).apply();
}

// Forget the bounds of known cells, side by side.
void unbind(uint8_t* __restrict bounded, const uint8_t* __restrict known, int64_t size) {
    for (int64_t k = 0; k < size; k++) bounded[k] = bounded[k] & ~known[k];
}

// Forget the bounds of known cells. Only this scan's points made cells known: in large maps others are not looked at.
void unbind_known(Update& u) {
    if (u.cells() <= 64 * u.measurement.number)
        return u.each(u.cells(), int64_t(1) << 20, [&](int64_t, int64_t first, int64_t last) {
            unbind(u.state.bounded + first, u.state.validity + first, last - first);
        });
    locate(u, u.settings.visibility.resolution);
    for (int64_t n = 0; n < u.measurement.number; n++)
        if (const int32_t k = u.measurement.slot[n]; k >= 0) unbind(u.state.bounded + k, u.state.validity + k, 1);
}

int64_t count_words(const uint8_t* bounded, const uint8_t* known, int64_t size) {
    int64_t number = 0, k = 0;
    for (; k + 8 <= size; k += 8) {
        uint64_t bounds, knows;
        std::memcpy(&bounds, bounded + k, 8), std::memcpy(&knows, known + k, 8);
        number += __builtin_popcountll(bounds & ~knows);
    }
    for (; k < size; k++) number += bounded[k] & !known[k];
    return number;
}

}  // namespace

extern "C" void run_clear_seen_through(Update& u) {
    if (!u.settings.visibility.has_rays) return;
    int64_t number = 0;
    for (int64_t k = 0; k < u.measurement.sensors; k++)
        number += apply_rays(Sensor(u, k), u.memory.get<VisibilityMemory>());
    unbind_known(u);
    *u.state.statistics.cleared_seen_through = number;
}

// Count the unknown cells that have an upper bound.
extern "C" void run_count_bounded(Update& u) {
    std::atomic<int64_t> number{0};
    u.each(u.cells(), 1 << 20, [&](int64_t, int64_t first, int64_t last) {
        number += count_words(u.state.bounded + first, u.state.validity + first, last - first);
    });
    *u.state.statistics.cells_bounded = number;
}
