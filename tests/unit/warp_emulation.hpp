// Runs CUDA code of one warp on a CPU: 32 lanes as coroutines that wait for one another where the code says *_sync.
// Lanes run in turn between such points, each as far as it can, so a forgotten __syncwarp gives wrong results; lanes
// that wait at different points stop the program. For tests only.
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

#define __shared__ static

struct float2 { float x, y; };
struct alignas(16) float4 { float x, y, z, w; };
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
using std::max;
using std::min;

template <class T> struct Array { T* data; };

namespace emulation {
struct Lane {
    ucontext_t context;
    std::vector<char> stack = std::vector<char>(1 << 16);
    bool done;
    int site, phase;
};
inline Lane lanes[32];
inline ucontext_t scheduler;
inline int current;
inline uint32_t slots[2][32];
inline std::function<void(int)> body;

inline void enter() {
    body(current);
    lanes[current].done = true;
    swapcontext(&lanes[current].context, &scheduler);
}

inline void run(std::function<void(int)> work) {
    body = work;
    for (Lane& lane : lanes) {
        getcontext(&lane.context);
        lane.context.uc_stack.ss_sp = lane.stack.data();
        lane.context.uc_stack.ss_size = lane.stack.size();
        lane.context.uc_link = nullptr;
        lane.done = false;
        lane.site = lane.phase = 0;
        makecontext(&lane.context, enter, 0);
    }
    while (!lanes[0].done) {
        for (current = 0; current < 32; ++current) swapcontext(&scheduler, &lanes[current].context);
        for (Lane& lane : lanes)
            if (lane.done != lanes[0].done || (!lane.done && lane.site != lanes[0].site)) {
                std::fprintf(stderr, "lanes wait at different lines: %d and %d\n", lane.site, lanes[0].site);
                std::abort();
            }
    }
}

// Waits for all lanes; the values that they brought.
inline const uint32_t* gather(uint32_t value, int site) {
    const int self = current, phase = lanes[self].phase++ & 1;
    slots[phase][self] = value;
    lanes[self].site = site;
    swapcontext(&lanes[self].context, &scheduler);
    return slots[phase];
}

template <class T> T exchange(T value, int step, int site) {
    static_assert(sizeof(T) == 4);
    uint32_t bits;
    std::memcpy(&bits, &value, 4);
    const int from = current ^ step;
    bits = gather(bits, site)[from];
    std::memcpy(&value, &bits, 4);
    return value;
}

inline unsigned ballot(bool value, int site) {
    const uint32_t* all = gather(value, site);
    unsigned mask = 0;
    for (int k = 0; k < 32; ++k) mask |= unsigned(all[k] != 0) << k;
    return mask;
}
}  // namespace emulation

#define __syncwarp() (void)emulation::gather(0, __LINE__)
#define __ballot_sync(mask, value) emulation::ballot(value, __LINE__)
#define __any_sync(mask, value) (emulation::ballot(value, __LINE__) != 0)
#define __shfl_xor_sync(mask, value, step) emulation::exchange(value, step, __LINE__)
inline int __ffs(unsigned v) { return v ? __builtin_ctz(v) + 1 : 0; }
inline int __clz(unsigned v) { return v ? __builtin_clz(v) : 32; }
inline float __fdividef(float a, float b) { return a / b; }
inline float __int_as_float(int v) { float f; std::memcpy(&f, &v, 4); return f; }
inline int __float_as_int(float f) { int v; std::memcpy(&v, &f, 4); return v; }
inline void atomicAdd(float* at, float value) { *at += value; }
