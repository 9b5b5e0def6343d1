// Runs the text of a CUDA kernel on the CPU: every thread of a block is a fiber, and the instructions of a warp follow
// the PTX ISA lane by lane. Warps and their lanes run in random order, each as far as it can, so a forgotten barrier
// gives wrong results (unless a vote or shuffle stands in its place, which wait here too); dynamic shared memory starts
// as NaN, its addresses are checked, and lanes of a warp that wait at different lines are an error. Slow and obvious.
#pragma once
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <vector>

using std::max;
using std::min;

namespace {
namespace emulator {

const int WARP = 32, STACK = 1 << 18;

struct Barrier {
    int size, arrived;
    long generation;
};
// What a lane hands to the others of its warp, and where: the line of the call.
struct Slot {
    unsigned a[4], b[2], value;
    const char* address;
    int line;
};
struct Thread {
    ucontext_t context;
    std::unique_ptr<char[]> stack;
    bool finished;
    long calls;
};
struct Index {
    int x;
};

std::vector<Thread> threads;
std::vector<Slot> slots[2];  // in turn: none is overwritten while another lane reads it
std::vector<Barrier> warps;
Barrier whole;
Index block, grid, current;
ucontext_t scheduler;
std::function<void()> kernel;
char* shared;
int shared_size;
const char* failure;

void yield() { swapcontext(&threads[current.x].context, &scheduler); }

[[noreturn]] void fail(const char* what)
{
    fprintf(stderr, "block %d thread %d: %s\n", block.x, current.x, what);
    failure = what;
    for (;;) yield();
}

void wait(Barrier& barrier)
{
    const long mine = barrier.generation;
    if (++barrier.arrived == barrier.size) {
        barrier.arrived = 0;
        ++barrier.generation;
    }
    while (barrier.generation == mine) yield();
}

// Waits for the lanes of the warp; what each of them brought.
template <class Fill> const Slot* exchange(int line, Fill fill)
{
    const int me = current.x;
    std::vector<Slot>& set = slots[threads[me].calls++ % 2];
    set[me].line = line;
    fill(set[me]);
    wait(warps[me / WARP]);
    const Slot* lanes = &set[me / WARP * WARP];
    for (int l = 0; l < WARP; ++l)
        if (lanes[l].line != line) fail("lanes of a warp wait at different lines");
    return lanes;
}

void enter()
{
    kernel();
    threads[current.x].finished = true;
    for (;;) yield();
}

// Runs `body` on `blocks` blocks of `size` threads, a multiple of 32. Whether that failed.
bool launch(int blocks, int size, int shared_bytes, std::function<void()> body)
{
    const int alignment = 128;
    std::vector<char> memory(shared_bytes + alignment);
    shared = (char*)((uintptr_t(memory.data()) + alignment - 1) / alignment * alignment);
    shared_size = shared_bytes;
    kernel = body;
    failure = nullptr;
    grid.x = blocks;
    threads.resize(size);
    for (auto& set : slots) set.resize(size);
    for (Thread& thread : threads)
        if (!thread.stack) thread.stack.reset(new char[STACK]);
    srand(0);
    for (block.x = 0; block.x < blocks; ++block.x) {
        memset(shared, 0xff, shared_bytes);
        whole = {size, 0, 0};
        warps.assign(size / WARP, {WARP, 0, 0});
        for (Thread& thread : threads) {
            thread.finished = false;
            thread.calls = 0;
            getcontext(&thread.context);
            thread.context.uc_stack.ss_sp = thread.stack.get();
            thread.context.uc_stack.ss_size = STACK;
            makecontext(&thread.context, enter, 0);
        }
        // One warp, chosen at random, runs until it waits for the others, its lanes in another order every time.
        for (int left = size, idle = 0; left > 0;) {
            const int warp = rand() % (size / WARP);
            for (long before = -1; before != warps[warp].generation;) {
                before = warps[warp].generation;
                const int stride = 2 * (rand() % WARP) + 1, offset = rand() % WARP;
                for (int i = 0; i < WARP; ++i) {
                    current.x = WARP * warp + (i * stride + offset) % WARP;
                    Thread& thread = threads[current.x];
                    if (thread.finished) continue;
                    swapcontext(&scheduler, &thread.context);
                    if (failure) return true;
                    left -= thread.finished;
                    idle = thread.finished ? 0 : idle;
                }
            }
            if (++idle > 100000) {
                fprintf(stderr, "block %d: threads wait for one another\n", block.x);
                return true;
            }
        }
    }
    return false;
}

template <class To, class From> To bits(From x)
{
    static_assert(sizeof(To) == sizeof(From), "as many bits");
    To y;
    memcpy(&y, &x, sizeof y);
    return y;
}

float half_of(unsigned pair, int which) { return float(bits<_Float16>(uint16_t(pair >> (16 * which)))); }

unsigned pack(float x0, float x1)
{
    return bits<uint16_t>(_Float16(x0)) | unsigned(bits<uint16_t>(_Float16(x1))) << 16;
}

float towards_zero(double x)
{
    const float y = float(x);
    return std::fabs(double(y)) > std::fabs(x) ? std::nextafter(y, 0.0f) : y;
}

// mma.m16n8k16: tensor cores truncate what they accumulate
void mma(float* c, const unsigned* a, const unsigned* b)
{
    const Slot* lanes = exchange(__LINE__, [&](Slot& s) {
        memcpy(s.a, a, 16);
        memcpy(s.b, b, 8);
    });
    const int lane = current.x % WARP, group = lane / 4, member = lane % 4;
    for (int i = 0; i < 4; ++i) {
        const int row = group + (i >= 2 ? 8 : 0), column = 2 * member + i % 2;
        double sum = c[i];
        for (int k = 0; k < 16; ++k) {
            const Slot& left = lanes[row % 8 * 4 + k % 8 / 2];
            const Slot& right = lanes[column * 4 + k % 8 / 2];
            const int a_register = (row >= 8 ? 1 : 0) + (k >= 8 ? 2 : 0), b_register = k >= 8;
            sum += double(half_of(left.a[a_register], k % 2)) * half_of(right.b[b_register], k % 2);
        }
        c[i] = towards_zero(sum);
    }
}

// ldmatrix.x4: lane l holds the address of row l % 8 of matrix l / 8
void matrices(unsigned* r, const char* address, bool transposed)
{
    if (address < shared || address + 16 > shared + shared_size) fail("ldmatrix outside of shared memory");
    if ((address - shared) % 16) fail("ldmatrix at an address that is no multiple of 16");
    const Slot* lanes = exchange(__LINE__, [&](Slot& s) { s.address = address; });
    const int lane = current.x % WARP, group = lane / 4, member = lane % 4;
    for (int i = 0; i < 4; ++i) {
        uint16_t halves[2];
        for (int k = 0; k < 2; ++k) {
            const int row = transposed ? 2 * member + k : group, column = transposed ? group : 2 * member + k;
            memcpy(&halves[k], lanes[8 * i + row].address + 2 * column, 2);
        }
        memcpy(&r[i], halves, 4);
    }
}

const Slot* gather(unsigned value, int line)
{
    return exchange(line, [&](Slot& s) { s.value = value; });
}

unsigned warp_max(unsigned x)
{
    const Slot* lanes = gather(x, __LINE__);
    unsigned largest = 0;
    for (int l = 0; l < WARP; ++l) largest = max(largest, lanes[l].value);
    return largest;
}

unsigned ballot(bool value, int line)
{
    const Slot* lanes = gather(value, line);
    unsigned mask = 0;
    for (int l = 0; l < WARP; ++l) mask |= lanes[l].value << l;
    return mask;
}

template <class T> T shuffle(T value, int step, int line)
{
    static_assert(sizeof(T) <= sizeof(Slot::b), "at most 8 bytes");
    const Slot* lanes = exchange(line, [&](Slot& s) { memcpy(s.b, &value, sizeof value); });
    memcpy(&value, lanes[current.x % WARP ^ step].b, sizeof value);
    return value;
}

}  // namespace emulator

struct float2 {
    float x, y;
};
struct alignas(16) float4 {
    float x, y, z, w;
};
struct uint4 {
    unsigned x, y, z, w;
};
float2 make_float2(float x, float y) { return {x, y}; }
float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }
unsigned __float_as_uint(float x) { return emulator::bits<unsigned>(x); }
float __uint_as_float(unsigned x) { return emulator::bits<float>(x); }
int __float_as_int(float x) { return emulator::bits<int>(x); }
float __int_as_float(int x) { return emulator::bits<float>(x); }
int __ffs(unsigned x) { return x ? __builtin_ctz(x) + 1 : 0; }
int __clz(unsigned x) { return x ? __builtin_clz(x) : 32; }
float __fdividef(float a, float b) { return a / b; }
void atomicAdd(float* at, float value) { *at += value; }

// A Warp array, as far as the kernels use it.
template <class T> struct Array {
    T* data;
};

}  // namespace

#define __shared__ static
#define threadIdx emulator::current
#define blockIdx emulator::block
#define gridDim emulator::grid
#define __syncthreads() emulator::wait(emulator::whole)
#define __syncwarp() (void)emulator::gather(0, __LINE__)
#define __ballot_sync(mask, value) emulator::ballot(value, __LINE__)
#define __any_sync(mask, value) (emulator::ballot(value, __LINE__) != 0)
#define __shfl_xor_sync(mask, value, step) emulator::shuffle(value, step, __LINE__)

// Stands for the part "machine" of neural_fused.cu
#define EMULATED_MACHINE                                                                                             \
    const int thread = threadIdx.x, lane = thread & 31, warp = thread >> 5;                                          \
    char* const pool = emulator::shared;                                                                             \
    auto mma = [](float* c, const unsigned* a, const unsigned* b) { emulator::mma(c, a, b); };                       \
    auto matrices = [&](unsigned* r, int offset) { emulator::matrices(r, pool + offset, false); };                   \
    auto transposed = [&](unsigned* r, int offset) { emulator::matrices(r, pool + offset, true); };                  \
    auto pack = [](float x0, float x1) { return emulator::pack(x0, x1); };                                           \
    auto unpack = [](unsigned pair, float& x0, float& x1) {                                                          \
        x0 = emulator::half_of(pair, 0);                                                                             \
        x1 = emulator::half_of(pair, 1);                                                                             \
    };                                                                                                               \
    auto power_of_two = [](float x) { return std::exp2(x); };                                                        \
    auto root = [](float x) { return std::sqrt(x); };                                                                \
    auto prefetch = [](const float*) {};                                                                             \
    auto warp_max = [](unsigned x) { return emulator::warp_max(x); };
