// Threads that share the work of updates. They look for the next piece for a moment, then sleep.
#pragma once

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

#include "kernels/threads.h"

class Team {
    std::mutex busy, mutex;  // of one job; of what follows
    std::condition_variable begins, ends;
    std::vector<std::thread> helpers;
    void (*function)(void*) = nullptr;
    void* data = nullptr;
    std::atomic<unsigned> wanted{0}, running{0};  // helpers that shall begin; that work

    // Look for a moment whether something holds: waking up takes as long as many a piece of an update.
    template <class Holds>
    static void watch(const Holds& holds) {
        using Clock = std::chrono::steady_clock;
        for (const auto end = Clock::now() + std::chrono::microseconds(100); !holds() && Clock::now() < end;)
            std::this_thread::yield();
    }

    void help() {
        std::unique_lock<std::mutex> lock(mutex);
        while (true) {
            begins.wait(lock, [&] { return wanted > 0; });
            wanted--, running++;
            lock.unlock();
            function(data);
            lock.lock();
            if (--running == 0) ends.notify_all();
            lock.unlock();
            watch([&] { return wanted > 0; });
            lock.lock();
        }
    }

  public:
    // Have so many threads at least, the callers of `run` not counted.
    void grow(size_t number) {
        const std::lock_guard<std::mutex> lock(busy);
        while (helpers.size() < number) helpers.emplace_back([this] { help(); });
    }

    // Call the function on up to `num_threads` threads, the caller included; on the caller alone while others work.
    void run(void (*call)(void*), void* argument, unsigned num_threads) {
        const std::unique_lock<std::mutex> only(busy, std::try_to_lock);
        if (!only || helpers.empty()) return call(argument);
        {
            const std::lock_guard<std::mutex> lock(mutex);
            function = call, data = argument;
            wanted = std::min<unsigned>(num_threads - 1, unsigned(helpers.size()));
        }
        begins.notify_all();
        call(argument);
        watch([&] { return running == 0; });
        std::unique_lock<std::mutex> lock(mutex);
        wanted = 0;  // who has not begun finds nothing left to do
        ends.wait(lock, [&] { return running == 0; });
    }

    // The team of this process. Never destroyed: helpers sleep until the process ends. A forked child, which has none of
    // them, gets another team.
    static Team*& shared() {
        static Team* team = [] {
            pthread_atfork(nullptr, nullptr, [] { shared() = new Team; });
            return new Team;
        }();
        return team;
    }

    // Let updates run on the shared team, unless they run on another one.
    static void use() {
        static std::once_flag once;
        std::call_once(once, [] {
            if (!team)
                use_team([](void (*call)(void*), void* data, unsigned n, unsigned) { shared()->run(call, data, n); });
        });
    }
};
