// Work on several threads.
#pragma once

#include <atomic>
#include <cstdint>
#include <exception>
#include <mutex>
#include <stdexcept>
#include <thread>
#include <vector>

// GOMP_parallel of torch's OpenMP, which calls a function on each thread of a team. Threads of our own would compete for
// the cores with that team, whose threads spin between operations.
typedef void (*Parallel)(void (*function)(void*), void* data, unsigned num_threads, unsigned flags);
inline Parallel team = nullptr;
extern "C" [[gnu::weak]] void use_team(Parallel parallel) { team = parallel; }

// Call `run()` on `num_threads` threads, the caller included. Without a team, on at most `count`, or as many as can
// start.
template <class Run> void on_threads(int count, int num_threads, Run& run) {
    if (team && num_threads > 1 && count > 1) {  // a smaller team would end the other threads
        team([](void* data) { (*static_cast<Run*>(data))(); }, &run, num_threads, 0);
        return;
    }
    std::vector<std::thread> helpers;
    try {
        for (int k = 1; k < num_threads && k < count; k++) helpers.emplace_back([&run] { run(); });
    } catch (const std::exception&) {
    }
    run();
    for (std::thread& helper : helpers) helper.join();
}

// Call `work(k, own)` for each k below `count`, where `own` is what `make()` returned to its thread. What a call throws
// is thrown again at the end, once.
template <class Make, class Work> void for_each(int count, int num_threads, const Make& make, const Work& work) {
    std::atomic<int> next{0};
    std::mutex mutex;
    std::exception_ptr failure;
    auto run = [&] {
        try {
            auto own = make();
            for (int k; (k = next++) < count;) work(k, own);
        } catch (...) {
            next = count;
            const std::lock_guard<std::mutex> lock(mutex);
            if (!failure) failure = std::current_exception();
        }
    };
    on_threads(count, num_threads, run);
    if (failure) std::rethrow_exception(failure);
}

template <class Work> void for_each(int count, int num_threads, const Work& work) {
    for_each(count, num_threads, [] { return 0; }, [&](int k, int) { work(k); });
}

// Calls `work(part, first, last)` for parts of 0 to `size`, which may run side by side.
struct Parts {
    int64_t number;
    int num_threads;

    template <class Work> void operator()(int64_t size, const Work& work) const {
        for_each(int(number), num_threads, [&](int64_t k) { work(k, size * k / number, size * (k + 1) / number); });
    }
};

// Call `work(b, threads, own)` for each environment, where `own` is as in `for_each`: a thread for each where there are
// `per_thread` of them for every thread, else all threads for one after the other.
template <class Make, class Work>
void for_environments(int64_t B, int num_threads, const Make& make, const Work& work, int per_thread = 1) {
    if (B >= per_thread * num_threads) {
        for_each(int(B), num_threads, make, [&](int64_t b, auto& own) { work(b, 1, own); });
    } else {
        auto own = make();
        for (int64_t b = 0; b < B; b++) work(b, num_threads, own);
    }
}

template <class Work> void for_environments(int64_t B, int num_threads, const Work& work, int per_thread = 1) {
    auto call = [&](int64_t b, int threads, int) { work(b, threads); };
    for_environments(B, num_threads, [] { return 0; }, call, per_thread);
}

inline int64_t checked(int64_t index, int64_t size) {
    if (uint64_t(index) >= uint64_t(size)) throw std::out_of_range("index");
    return index;
}

// Do the work; return 0, or 1 if an index was out of range, or 2 without memory. No exception may reach C.
template <class Work> int code_of(const Work& work) {
    try {
        work();
        return 0;
    } catch (const std::out_of_range&) {
        return 1;
    } catch (...) {
        return 2;
    }
}
