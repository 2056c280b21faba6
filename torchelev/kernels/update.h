// One map's update on a CPU: what each stage's `run_<stage>(Update&)` reads and writes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "generated.h"  // Sizes, MapState, StoredLevels, Inputs and Settings, derived from their Python declarations
#include "kernels/threads.h"

// Memory for numbers that are written before they are read; it only grows.
template <class T> class Buffer {
    std::unique_ptr<T[]> values;
    size_t room = 0;

  public:
    T* resize(size_t number) {
        if (number > room) values.reset(new T[number]), room = number;
        return values.get();
    }
    T* data() const { return values.get(); }
    T& operator[](size_t k) const { return values[k]; }
};

// What a thread keeps from map to map: one value of each type that a stage asks for.
class Memory {
    std::vector<std::pair<const void*, std::shared_ptr<void>>> parts;

  public:
    template <class T> T& get() {
        static const char key = 0;
        for (auto& [name, part] : parts)
            if (name == &key) return *static_cast<T*>(part.get());
        parts.emplace_back(&key, std::make_shared<T>());
        return *static_cast<T*>(parts.back().second.get());
    }
};

// One map's scan, as `Measurement` in state.py: M = S * N points in map axes. `run_measure` fills it in, up to `slot`.
struct Measurement {
    struct {
        int64_t finite, in_range, casts, used;
    } counts;                       // of points that pass one gate after the other
    int64_t number, sensors;        // M, S
    int64_t anchor[2];              // cell number that x = y = 0 stands for
    bool has_base, moves;           // a base pose was given; and its window follows, as the poses are sound
    float base[3];                  // [m]
    float dt;                       // [s]
    Buffer<float> origin;           // (S, 3) [m] of the sensors
    Buffer<float> x, y, z;          // (M) [m], x and y from `anchor`; zero where ignored
    Buffer<float> noise;            // (M) [m^2] variance of each height, without what the pose adds
    Buffer<float> of_pose;          // (M) [m^2] what the pose adds; only with `has_covariance`
    Buffer<uint8_t> used, casts;    // (M) measures the ground; its ray clears and bounds
    bool has_covariance;            // of the pose
    float pose_covariance[9];       // [m^2] of the first sensor's position
    // `locate` in stages/cells.h fills these in, once for all stages that follow `recenter`.
    bool is_located;
    Buffer<int32_t> slot;           // (M) flat cell number; -1 unless the point is used and inside the window
    int64_t inside, outside;        // used points inside and outside the window

    // Variance [m^2] of a point's height.
    float variance(int64_t k) const { return has_covariance ? noise[k] + of_pose[k] : noise[k]; }
};

struct Update;
typedef void (*Stage)(Update&);

struct Update {
    const Settings& settings;
    const Sizes& sizes;       // B, H, W, S, N, K, M, P, L: see structs.py
    MapState state;           // this map's: layers (H, W), numbers behind pointers
    Inputs inputs;            // this map's
    Measurement& measurement;
    Memory& memory;           // of this thread
    int threads;              // that may work on this map
    StoredLevels levels = {};    // this map's, of L surfaces; null without
    Stage on_failure = nullptr;  // puts back what a stage took out of the map for those that follow

    int64_t cells() const { return sizes.H * sizes.W; }

    // Call `work(part, first, last)` on parts of 0 to `size`, on all threads of this map if there are several times
    // `least`.
    template <class Work> void each(int64_t size, int64_t least, const Work& work) const {
        const int64_t parts = threads == 1 || size < 2 * least ? 1 : std::min(size / least, int64_t(4 * threads));
        Parts{parts, parts == 1 ? 1 : threads}(size, work);
    }
};

// What a thread keeps from update to update.
struct Own {
    Measurement measurement;
    Memory memory;
};

// Run the stages. One may fail without memory, with a part of its work done: what was taken out is then put back.
inline void run_stages(Update& one, const Stage* stages, int64_t num_stages) {
    try {
        for (int64_t k = 0; k < num_stages; k++) stages[k](one);
    } catch (...) {
        if (one.on_failure) one.on_failure(one);
        throw;
    }
}
