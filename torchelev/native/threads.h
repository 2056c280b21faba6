// Work on several threads.
#pragma once

#include <atomic>
#include <thread>
#include <vector>

// Call `work(k)` for each k below `count`, by so many threads, of which the caller is one.
template <class Work> void for_each(int count, int num_threads, const Work& work) {
    std::atomic<int> next{0};
    auto run = [&] {
        for (int k; (k = next++) < count;) work(k);
    };
    std::vector<std::thread> helpers;
    for (int k = 1; k < num_threads && k < count; k++) helpers.emplace_back(run);
    run();
    for (std::thread& helper : helpers) helper.join();
}
