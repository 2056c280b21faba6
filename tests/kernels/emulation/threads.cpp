// The threads of a block, one fiber each: they take turns, and change where they wait for each other.

#include <csetjmp>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include <link.h>
#include <sys/mman.h>
#include <ucontext.h>

#include "gpu.h"

uint3 threadIdx, blockIdx, blockDim, gridDim;

namespace emulation {
namespace {

constexpr int LANES = 32, MAX_THREADS = 1024;
constexpr size_t STACK = 256 << 10, PAGE = 4096;                // [bytes]
constexpr size_t MEMORY = 228 << 10, GUARD = 4 << 10;           // [bytes] that a block may share; beyond
constexpr unsigned char UNWRITTEN = 0x5a, BEYOND = 0xa5;        // what fills them

enum State { READY, AT_BARRIER, IN_WARP, RETURNED };

struct Fiber {
    ucontext_t start;
    jmp_buf place;
    bool is_started;
    State state;
    // What it waits for in its warp, and what it gets.
    const char* operation;
    unsigned mask;
    uint64_t bits;
    int source;
    Exchanged result;
};

alignas(128) unsigned char memory[MEMORY + GUARD];
Fiber fibers[MAX_THREADS];
jmp_buf scheduler;
int number, current, returned, at_barrier;
char failure[400], undefined[400];  // the latter for good: the sanitizer reports a line once
void (*body)(void**);
void** values;

void fail(const char* format, ...) {
    if (failure[0]) return;
    va_list arguments;
    va_start(arguments, format);
    std::vsnprintf(failure, sizeof failure, format, arguments);
    va_end(arguments);
}

void leave() {
    if (!_setjmp(fibers[current].place)) _longjmp(scheduler, 1);
}

void enter(int thread) {
    Fiber& fiber = fibers[thread];
    current = thread;
    threadIdx = {thread % blockDim.x, thread / blockDim.x % blockDim.y, thread / (blockDim.x * blockDim.y)};
    if (_setjmp(scheduler)) return;
    if (fiber.is_started) _longjmp(fiber.place, 1);
    fiber.is_started = true;
    setcontext(&fiber.start);
}

// Give the lanes that a thread waits for what they asked for, once all of them that have not returned do ask for it.
void complete(int thread) {
    const int first = thread / LANES * LANES;
    const Fiber& own = fibers[thread];
    const unsigned mask = own.mask;
    unsigned present = 0, votes = 0;
    for (int k = 0; k < LANES && first + k < number; k++) {
        const Fiber& fiber = fibers[first + k];
        if (!(mask >> k & 1) || fiber.state == RETURNED) continue;
        if (fiber.state != IN_WARP || fiber.mask != mask || fiber.operation != own.operation) return;
        present |= 1u << k;
        votes |= unsigned(fiber.bits != 0) << k;
    }
    for (int k = 0; k < LANES && first + k < number; k++) {
        Fiber& fiber = fibers[first + k];
        if (!(present >> k & 1)) continue;
        if (fiber.source < 0 || fiber.source >= LANES || !(present >> fiber.source & 1))
            return fail("%s: lane %d reads lane %d, which does not take part (mask %#x)", fiber.operation, k,
                        fiber.source, mask);
        fiber.result = {fibers[first + fiber.source].bits, votes};
        fiber.state = READY;
    }
}

// What a fiber does in each block: the kernel, whose end may be what other lanes wait for.
void work() {
    for (;;) {
        body(values);
        fibers[current].state = RETURNED;
        returned++;
        const int first = current / LANES * LANES;
        for (int k = first; k < first + LANES && k < number; k++)
            if (fibers[k].state == IN_WARP) complete(k);
        leave();
    }
}

// Begin anew: the first time, and after a failure has left fibers in the middle of their work.
void make_fibers() {
    static unsigned char* stacks = nullptr;
    if (!stacks) {
        void* all = mmap(nullptr, MAX_THREADS * STACK, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        if (all == MAP_FAILED) std::abort();
        stacks = static_cast<unsigned char*>(all);
        for (int k = 0; k < MAX_THREADS; k++) mprotect(stacks + k * STACK, PAGE, PROT_NONE);
    }
    for (int k = 0; k < MAX_THREADS; k++) {
        getcontext(&fibers[k].start);
        fibers[k].start.uc_stack.ss_sp = stacks + k * STACK;
        fibers[k].start.uc_stack.ss_size = STACK;
        fibers[k].is_started = false;
        makecontext(&fibers[k].start, work, 0);
    }
}

void release_barrier() {
    if (!at_barrier || at_barrier + returned < number) return;
    at_barrier = 0;
    for (int k = 0; k < number; k++)
        if (fibers[k].state == AT_BARRIER) fibers[k].state = READY;
}

void report_deadlock() {
    for (int k = 0; k < number; k++)
        if (fibers[k].state == IN_WARP)
            return fail("thread %d waits in %s (mask %#x) for lanes that never come; %d threads wait in __syncthreads, "
                        "%d have returned", k, fibers[k].operation, fibers[k].mask, at_barrier, returned);
}

// The shared memory of a fixed size: all that is `thread_local` in this library.
thread_local volatile char first_static;
struct Statics {
    void* address;
    size_t size;
};

int find_statics(dl_phdr_info* library, size_t, void* found) {
    bool is_own = false;
    size_t size = 0;
    for (int k = 0; k < library->dlpi_phnum; k++) {
        const ElfW(Phdr)& part = library->dlpi_phdr[k];
        const uintptr_t start = library->dlpi_addr + part.p_vaddr, own = reinterpret_cast<uintptr_t>(&find_statics);
        if (part.p_type == PT_LOAD) is_own |= start <= own && own < start + part.p_memsz;
        if (part.p_type == PT_TLS) size = part.p_memsz;
    }
    if (is_own) *static_cast<Statics*>(found) = {library->dlpi_tls_data, size};
    return is_own;
}

Statics statics() {
    Statics found{};
    first_static = 0;  // a library's thread_local memory is made at its first use
    dl_iterate_phdr(find_statics, &found);
    if (!found.address) std::abort();
    return found;
}

void run_block(size_t shared, bool is_backward, const Statics& fixed) {
    std::memset(fixed.address, UNWRITTEN, fixed.size);
    std::memset(memory, UNWRITTEN, shared);
    std::memset(memory + shared, BEYOND, GUARD);
    returned = at_barrier = 0;
    for (int k = 0; k < number; k++) fibers[k].state = READY;
    while (returned < number && !failure[0]) {
        bool moved = false;
        for (int k = 0; k < number && !failure[0]; k++) {
            const int thread = is_backward ? number - 1 - k : k;
            if (fibers[thread].state != READY) continue;
            moved = true;
            enter(thread);
            release_barrier();
        }
        if (!moved) report_deadlock();
    }
    for (size_t k = 0; k < GUARD; k++)
        if (memory[shared + k] != BEYOND) return fail("takes more shared memory than the %zu bytes it asks for", shared);
}

}  // namespace

void barrier() {
    fibers[current].state = AT_BARRIER;
    at_barrier++;
    leave();
}

int lane() { return current % LANES; }

void* shared_memory() { return memory; }

Exchanged exchange(const char* operation, unsigned mask, uint64_t bits, int source) {
    Fiber& fiber = fibers[current];
    fiber.state = IN_WARP, fiber.operation = operation, fiber.mask = mask, fiber.bits = bits, fiber.source = source;
    if (mask >> lane() & 1)
        complete(current);
    else
        fail("%s: lane %d is not in its own mask %#x", operation, lane(), mask);
    if (fiber.state != READY || failure[0]) leave();
    return fiber.result;
}

}  // namespace emulation

extern "C" void __ubsan_get_current_report_data(const char**, const char**, const char**, unsigned*, unsigned*, char**);

// What the sanitizer calls at undefined behaviour, such as an integer that overflows.
extern "C" void __ubsan_on_report() {
    const char *kind, *message, *file;
    unsigned line, column;
    char* address;
    __ubsan_get_current_report_data(&kind, &message, &file, &line, &column, &address);
    std::snprintf(emulation::undefined, sizeof emulation::undefined, "%s:%u: %s", file, line, message);
}

// Run a kernel's blocks one after the other; return what it did wrong, or null.
extern "C" const char* emulation_launch(void (*kernel)(void**), void** arguments, const unsigned* grid,
                                        const unsigned* block, size_t shared, int is_backward) {
    using namespace emulation;
    gridDim = {grid[0], grid[1], grid[2]}, blockDim = {block[0], block[1], block[2]};
    body = kernel, values = arguments, failure[0] = 0, number = int(block[0] * block[1] * block[2]);
    const unsigned blocks = grid[0] * grid[1] * grid[2];
    if (number > MAX_THREADS) fail("a block has at most %d threads, not %d", MAX_THREADS, number);
    if (shared > MEMORY) fail("a block shares at most %zu bytes, not %zu", MEMORY, shared);
    static bool is_ready = false;
    if (!is_ready) make_fibers(), is_ready = true;
    const Statics fixed = statics();
    for (unsigned k = 0; k < blocks && !failure[0]; k++) {
        const unsigned n = is_backward ? blocks - 1 - k : k;
        blockIdx = {n % grid[0], n / grid[0] % grid[1], n / (grid[0] * grid[1])};
        run_block(shared, is_backward, fixed);
    }
    if (failure[0]) is_ready = false;
    if (undefined[0]) return undefined;
    return failure[0] ? failure : nullptr;
}
