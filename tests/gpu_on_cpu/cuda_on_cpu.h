// Enough of CUDA C++ for g++ to compile the kernels of nurec_sim/render/gpu and run them, one block after the other.
//
// The threads of a block are coroutines on one processor thread. A barrier or a warp operation switches to the next one
// until all that take part have come; a block in which nobody can go on (a barrier that some threads never reach) ends
// the process with a message, which real hardware would not do.
#pragma once
#include <csetjmp>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ucontext.h>
#include <utility>
#include <vector>

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(threads)
#define __shared__ static

struct alignas(8) float2 { float x, y; };
struct float3 { float x, y, z; };
struct alignas(16) float4 { float x, y, z, w; };
static inline float2 make_float2(float x, float y) { return {x, y}; }
static inline float3 make_float3(float x, float y, float z) { return {x, y, z}; }
static inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

struct Index { int x, y, z; };
static Index threadIdx, blockIdx, blockDim, gridDim;

namespace emulator {
constexpr int most = 1024, stack_bytes = 1 << 16;

struct Barrier {
    int expected = 0, arrived = 0;
    unsigned generation = 0;
};
struct Thread {
    ucontext_t start;
    jmp_buf at;
    bool started = false, done = false;
};
struct Warp {
    Barrier barrier;
    uint32_t values[3][32];
    bool present[3][32];
};

static Thread threads[most];
static Warp warps[most / 32];
static Barrier block;
static int block_sums[3];
static jmp_buf scheduler;
static int current, moves;
static void (*body)(void*);
static void* body_data;

static void yield() {
    if (_setjmp(threads[current].at) == 0) _longjmp(scheduler, 1);
}
static bool release(Barrier& b) {
    if (b.arrived < b.expected) return false;
    b.arrived = 0, b.generation += 1, moves += 1;
    return true;
}
static void wait(Barrier& b) {
    unsigned generation = b.generation;
    b.arrived += 1;
    while (!release(b)) {
        yield();
        if (b.generation != generation) return;
    }
}
static void run() {
    body(body_data);
    threads[current].done = true;
    block.expected -= 1;
    warps[current / 32].barrier.expected -= 1;
    moves += 1;
    _longjmp(scheduler, 1);
}
// What each lane of the warp gave, and whether it took part. Three sides in turn: lanes may still read one while others
// write the next and clear the one after.
static std::pair<const uint32_t*, const bool*> gather(uint32_t mine) {
    Warp& warp = warps[threadIdx.x / 32];
    int lane = threadIdx.x % 32, side = warp.barrier.generation % 3;
    warp.values[side][lane] = mine;
    warp.present[side][lane] = true;
    memset(warp.present[(side + 1) % 3], 0, sizeof(warp.present[0]));
    wait(warp.barrier);
    return {warp.values[side], warp.present[side]};
}
static void run_block(int count) {
    static std::vector<char> stacks((size_t)most * stack_bytes);
    block = Barrier{count};
    memset(block_sums, 0, sizeof(block_sums));
    for (int w = 0; w < (count + 31) / 32; ++w) {
        warps[w] = Warp{};
        warps[w].barrier.expected = count - 32 * w < 32 ? count - 32 * w : 32;
    }
    for (int k = 0; k < count; ++k) threads[k].started = threads[k].done = false;
    for (volatile int left = count; left > 0;) {
        moves = 0;
        left = 0;
        for (volatile int k = 0; k < count; k = k + 1) {
            Thread& thread = threads[k];
            if (thread.done) continue;
            left = left + 1;
            current = k;
            threadIdx = {k, 0, 0};
            if (_setjmp(scheduler) != 0) continue;
            if (thread.started) _longjmp(thread.at, 1);
            thread.started = true;
            moves += 1;
            getcontext(&thread.start);
            thread.start.uc_stack.ss_sp = stacks.data() + (size_t)k * stack_bytes;
            thread.start.uc_stack.ss_size = stack_bytes;
            makecontext(&thread.start, run, 0);
            setcontext(&thread.start);
        }
        if (left > 0 && moves == 0) {
            fprintf(stderr, "block (%d, %d): a barrier that %d threads wait at is never reached by the others\n",
                    blockIdx.x, blockIdx.y, (int)left);
            abort();
        }
    }
}

template <class... A, size_t... I>
void call(void (*kernel)(A...), void** arguments, std::index_sequence<I...>) {
    kernel(*static_cast<A*>(arguments[I])...);
}
template <class... A>
void launch(void (*kernel)(A...), int grid_x, int grid_y, int count, void** arguments) {
    auto each = [&] { call(kernel, arguments, std::index_sequence_for<A...>{}); };
    body = [](void* f) { (*static_cast<decltype(each)*>(f))(); };
    body_data = &each;
    gridDim = {grid_x, grid_y, 1};
    blockDim = {count, 1, 1};
    for (int y = 0; y < grid_y; ++y) {
        for (int x = 0; x < grid_x; ++x) {
            blockIdx = {x, y, 0};
            run_block(count);
        }
    }
    body_data = nullptr;
}
}  // namespace emulator

template <class To, class From>
static inline To bits_as(From from) {
    static_assert(sizeof(To) == sizeof(From), "same size");
    To to;
    memcpy(&to, &from, sizeof(to));
    return to;
}
static inline float __int_as_float(int v) { return bits_as<float>(v); }
static inline int __float_as_int(float v) { return bits_as<int>(v); }
static inline unsigned __float_as_uint(float v) { return bits_as<unsigned>(v); }
static inline float __fdividef(float a, float b) { return a / b; }
static inline float inverse_root(float x) { return 1 / sqrtf(x); }
static inline void sine_cosine_pi(float x, float* sine, float* cosine) {
    *sine = sinf(3.14159265358979f * x), *cosine = cosf(3.14159265358979f * x);
}
static inline double sine_pi(double x) { return sin(3.14159265358979323846 * x); }
// By macro, as some C libraries have functions of these names.
#define __expf expf
#define rsqrtf inverse_root
#define sincospif sine_cosine_pi
#define sinpi sine_pi
static inline int __popc(unsigned v) { return __builtin_popcount(v); }
static inline int __ffs(unsigned v) { return __builtin_ffs(v); }

static inline int __syncthreads_count(int predicate) {
    int side = emulator::block.generation % 3;
    emulator::block_sums[side] += predicate != 0;
    emulator::block_sums[(side + 1) % 3] = 0;
    emulator::wait(emulator::block);
    return emulator::block_sums[side];
}
static inline void __syncthreads() { __syncthreads_count(0); }
static inline int __syncthreads_or(int predicate) { return __syncthreads_count(predicate) > 0; }
static inline unsigned __ballot_sync(unsigned, int predicate) {
    auto [values, present] = emulator::gather(predicate != 0);
    unsigned mask = 0;
    for (int lane = 0; lane < 32; ++lane) mask |= (unsigned)(present[lane] && values[lane]) << lane;
    return mask;
}
static inline int __any_sync(unsigned mask, int predicate) { return __ballot_sync(mask, predicate) != 0; }
static inline float __shfl_xor_sync(unsigned, float v, int bits) {
    int from = threadIdx.x % 32 ^ bits;
    return bits_as<float>(emulator::gather(bits_as<uint32_t>(v)).first[from]);
}
