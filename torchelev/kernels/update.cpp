// Updates of B maps, each through all stages at once, so that its layers stay in the cache between stages.

#include "kernels/update.h"

namespace {

// What threads keep from update to update: the operating system clears memory anew, page by page, which takes
// longer than the work.
class Kept {
    std::mutex mutex;
    std::vector<std::unique_ptr<Own>> unused;

  public:
    std::unique_ptr<Own> take() {
        const std::lock_guard<std::mutex> lock(mutex);
        if (unused.empty()) return std::make_unique<Own>();
        std::unique_ptr<Own> own = std::move(unused.back());
        unused.pop_back();
        return own;
    }
    void put(std::unique_ptr<Own> own) {
        const std::lock_guard<std::mutex> lock(mutex);
        unused.push_back(std::move(own));
    }
};

Kept* kept = new Kept;  // never destroyed: threads may update maps while the process ends

// An `Own` that is put back at the end.
struct Borrowed {
    std::unique_ptr<Own> own = kept->take();

    Borrowed() = default;
    Borrowed(Borrowed&&) = default;
    ~Borrowed() {
        if (own) kept->put(std::move(own));
    }
};

}  // namespace

// Leave what is kept to the parent of a forked process, a thread of which may hold the mutex.
extern "C" void forget_memory() { kept = new Kept; }

// Run stages in their order on maps and their inputs, in place. Returns what `code_of` does.
extern "C" int update_maps(const MapState* state, const Inputs* inputs, const StoredLevels* levels, const Settings* settings,
                           const Sizes* sizes, const Stage* stages, int64_t num_stages, int num_threads) {
    auto make = [] { return Borrowed(); };
    auto update = [&](int64_t b, int threads, Borrowed& borrowed) {
        Own& own = *borrowed.own;
        Update one{*settings,          *sizes,     state->at(b, *sizes), inputs->at(b, *sizes),
                   own.measurement,    own.memory, threads,              levels ? levels->at(b, *sizes) : StoredLevels{}};
        run_stages(one, stages, num_stages);
    };
    return code_of([&] { for_environments(sizes->B, num_threads, make, update); });
}
