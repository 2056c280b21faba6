// Work on several threads.
#pragma once

#include <atomic>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

// Call `work(k)` for each k below `count`, by so many threads, of which the caller is one, or fewer if there are no
// more. What a call throws is thrown again at the end, once.
template <class Work> void for_each(int count, int num_threads, const Work& work) {
    std::atomic<int> next{0};
    std::mutex mutex;
    std::exception_ptr failure;
    auto run = [&] {
        try {
            for (int k; (k = next++) < count;) work(k);
        } catch (...) {
            next = count;
            const std::lock_guard<std::mutex> lock(mutex);
            if (!failure) failure = std::current_exception();
        }
    };
    std::vector<std::thread> helpers;
    try {
        for (int k = 1; k < num_threads && k < count; k++) helpers.emplace_back(run);
    } catch (const std::exception&) {
    }
    run();
    for (std::thread& helper : helpers) helper.join();
    if (failure) std::rethrow_exception(failure);
}

// Tell whether `work()` ended without an exception, which must not reach C.
template <class Work> bool succeeds(const Work& work) {
    try {
        work();
        return true;
    } catch (...) {
        return false;
    }
}
