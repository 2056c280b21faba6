// Threads that share the work of updates, and sleep between them.
#pragma once

#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

class Team {
    std::mutex busy, mutex;  // of one job; of what follows
    std::condition_variable begins, ends;
    std::vector<std::thread> helpers;
    void (*function)(void*) = nullptr;
    void* data = nullptr;
    unsigned wanted = 0, running = 0;  // helpers that shall begin; that work
    bool leaves = false;

    void help() {
        std::unique_lock<std::mutex> lock(mutex);
        while (true) {
            begins.wait(lock, [&] { return leaves || wanted > 0; });
            if (leaves) return;
            wanted--, running++;
            lock.unlock();
            function(data);
            lock.lock();
            if (--running == 0) ends.notify_all();
        }
    }

  public:
    ~Team() {
        {
            const std::lock_guard<std::mutex> lock(mutex);
            leaves = true;
        }
        begins.notify_all();
        for (std::thread& helper : helpers) helper.join();
    }

    // Have so many threads at least, the callers of `run` not counted.
    void grow(size_t number) {
        const std::lock_guard<std::mutex> lock(busy);
        while (helpers.size() < number) helpers.emplace_back([this] { help(); });
    }

    // Call the function on up to `num_threads` threads, the caller included; on the caller alone while another one runs.
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
        std::unique_lock<std::mutex> lock(mutex);
        wanted = 0;  // who has not begun finds nothing left to do
        ends.wait(lock, [&] { return running == 0; });
    }

    static Team& shared() {
        static Team team;
        return team;
    }
};

extern "C" inline void run_on_shared_team(void (*call)(void*), void* argument, unsigned num_threads, unsigned) {
    Team::shared().run(call, argument, num_threads);
}
