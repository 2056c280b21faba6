// Updates of B maps, one after the other through all stages, so that a map's layers stay in the cache between stages.

#include "kernels/update.h"

namespace {

// What a thread keeps.
struct Own {
    Measurement measurement;
    Memory memory;
};

}  // namespace

// Run stages in their order on maps and their inputs, in place. Returns what `code_of` does.
extern "C" int update_maps(const MapState* state, const Inputs* inputs, const Settings* settings, const Sizes* sizes,
                           const Stage* stages, int64_t num_stages, int num_threads) {
    auto make = [] { return std::make_unique<Own>(); };
    auto update = [&](int64_t b, int threads, std::unique_ptr<Own>& own) {
        Update one{*settings,           *sizes,      state->at(b, *sizes), inputs->at(b, *sizes),
                   own->measurement,    own->memory, threads};
        for (int64_t k = 0; k < num_stages; k++) stages[k](one);
    };
    return code_of([&] { for_environments(sizes->B, num_threads, make, update); });
}
