// The disagreement taken out of variances, and put in again: stage.py.

#include "stages/chosen_cells.h"
#include "stages/disagreement/equation.h"

namespace {

// Change the variance of each cell by `change(variance, d2)`, where d2 [m^2] is 0 in unknown cells.
template <class Change> void change_variance(Update& u, const Change& change) {
    const float d = *u.state.statistics.disagreement, d2 = d * d;
    if (d == 0) return;
    float* variance = u.state.variance;
    for_chosen(u, u.state.validity, [&](int64_t k, Flags known, auto count) {
        store(variance + k, change(load(variance + k, count), zero_unless(known, splat(d2))), count);
    });
}

}  // namespace

extern "C" void run_add_disagreement(Update& u) {
    change_variance(u, [](Lanes variance, Lanes d2) { return variance + d2; });
    u.on_failure = nullptr;
}

extern "C" void run_subtract_disagreement(Update& u) {
    const DisagreementSettings& s = u.settings.disagreement;
    change_variance(u, [&](Lanes variance, Lanes d2) { return disagreement::without(variance, d2, s); });
    u.on_failure = run_add_disagreement;
}
