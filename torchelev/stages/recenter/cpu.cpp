// The window follows the robot by whole cells, in place: stage.py.

#include <algorithm>
#include <cmath>
#include <cstring>

#include "kernels/update.h"
#include "stages/recenter/equation.h"

namespace {

struct Shift {
    int64_t rows, columns;  // [cells] by which the window moves
};

// Give cell (i, j) of H x W cells what was at (i, j) + shift, or `blank` if that lies outside.
template <class Value> void move(Value* layer, int64_t H, int64_t W, const Shift& by, Value blank) {
    // All rows that stay move at once, though what passes their ends is wrong until it becomes blank.
    const int64_t offset = by.rows * W + by.columns, size = H * W;
    const int64_t begin = std::clamp(-offset, int64_t(0), size), end = std::clamp(size - offset, begin, size);
    std::memmove(layer + begin, layer + begin + offset, (end - begin) * sizeof(Value));
    const int64_t first = std::clamp(-by.columns, int64_t(0), W), last = std::clamp(W - by.columns, first, W);
    const int64_t top = std::clamp(-by.rows, int64_t(0), H), bottom = std::clamp(H - by.rows, top, H);
    std::fill(layer, layer + top * W, blank), std::fill(layer + bottom * W, layer + size, blank);
    if (first == 0 && last == W) return;
    for (Value* row = layer + top * W; row < layer + bottom * W; row += W)
        std::fill(row, row + first, blank), std::fill(row + last, row + W, blank);
}

void move_layers(Update& u, const Shift& by) {
    const MapState& state = u.state;
    float* const numbers[] = {state.elevation,   state.support,    state.challenger, state.time,
                              state.upper_bound, state.gradient_x, state.gradient_y, state.traversability};
    uint8_t* const bytes[] = {state.validity, state.challenger_support, state.bounded, state.has_normal, state.rated};
    const int64_t H = u.sizes.H, W = u.sizes.W;
    u.each(14, H * W < 65536 ? 14 : 1, [&](int64_t, int64_t begin, int64_t end) {
        for (int64_t k = begin; k < end; k++) {
            if (k < 8) move(numbers[k], H, W, by, 0.0f);
            if (k == 8) move(state.variance, H, W, by, 1.0f);
            if (k > 8) move(bytes[k - 9], H, W, by, uint8_t(0));
        }
    });
}

}  // namespace

extern "C" void run_recenter(Update& u) {
    const Measurement& m = u.measurement;
    if (!m.moves) return;
    const int64_t size[2] = {u.sizes.H, u.sizes.W}, largest = std::max(size[0], size[1]);
    int64_t shift[2];
    for (int axis = 0; axis < 2; axis++) {
        const int64_t corner = m.anchor[axis] +
                               int64_t(recentering::first_cell(m.base[axis], size[axis], u.settings.recenter.resolution));
        shift[axis] = std::clamp(corner - u.state.corner[axis], -largest, largest);
        u.state.corner[axis] = corner;
    }
    if (shift[0] || shift[1]) move_layers(u, {shift[0], shift[1]});
    *u.state.base_height = m.base[2];
}
