// Runs the text of a CUDA kernel on the CPU: every thread of a block is a fiber, and the collective instructions
// follow the PTX ISA lane by lane. Shared memory starts as NaN, and addresses are checked. Slow and obvious.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>
#include <ucontext.h>

namespace emulator {

const int THREADS = 128, WARP = 32;
std::vector<char> memory;
char* shared;
int pool_bytes;

struct Index {
    int x;
};
Index block, grid, current;
ucontext_t scheduler, fibers[THREADS];
bool finished[THREADS];

void yield() { swapcontext(&fibers[current.x], &scheduler); }

struct Barrier {
    int size, arrived = 0;
    long generation = 0;
    void wait()
    {
        const long mine = generation;
        if (++arrived == size) {
            arrived = 0;
            ++generation;
        }
        while (generation == mine) yield();
    }
};
Barrier whole {THREADS}, warps[THREADS / WARP] = {{WARP}, {WARP}, {WARP}, {WARP}};

// What a lane hands to the others of its warp. Two sets in turn: none is overwritten while another lane reads it.
struct Slot {
    unsigned a[4], b[2], value;
    const char* address;
};
Slot slots[2][THREADS];
long calls[THREADS];

template <class Fill> Slot* exchange(Fill fill)
{
    const int me = current.x;
    Slot* set = slots[calls[me]++ % 2];
    fill(set[me]);
    warps[me / WARP].wait();
    return set + me / WARP * WARP;
}

[[noreturn]] void fail(const char* what)
{
    fprintf(stderr, "block %d thread %d: %s\n", block.x, current.x, what);
    exit(1);
}

float half_of(unsigned pair, int which)
{
    const uint16_t bits = pair >> (16 * which);
    _Float16 x;
    memcpy(&x, &bits, 2);
    return float(x);
}

unsigned pack(float x0, float x1)
{
    const _Float16 x[2] = {_Float16(x0), _Float16(x1)};
    unsigned pair;
    memcpy(&pair, x, 4);
    return pair;
}

float towards_zero(double x)
{
    const float y = float(x);
    return std::fabs(double(y)) > std::fabs(x) ? std::nextafter(y, 0.0f) : y;
}

// mma.m16n8k16: tensor cores truncate what they accumulate
void mma(float* c, const unsigned* a, const unsigned* b)
{
    const Slot* lanes = exchange([&](Slot& s) {
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
    if (address < shared || address + 16 > shared + pool_bytes) fail("ldmatrix outside of shared memory");
    if ((address - shared) % 16) fail("ldmatrix at an address that is no multiple of 16");
    const Slot* lanes = exchange([&](Slot& s) { s.address = address; });
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

unsigned warp_max(unsigned x)
{
    const Slot* lanes = exchange([&](Slot& s) { s.value = x; });
    unsigned largest = 0;
    for (int l = 0; l < WARP; ++l) largest = lanes[l].value > largest ? lanes[l].value : largest;
    return largest;
}

std::function<void()> kernel;

void run_thread()
{
    kernel();
    finished[current.x] = true;
    yield();
}

void launch(int blocks, int shared_bytes, std::function<void()> body)
{
    const size_t stack = 1 << 18;
    std::vector<char> stacks(stack * THREADS);
    memory.assign(shared_bytes + 128, char(0xff));
    shared = (char*)((uintptr_t(memory.data()) + 127) / 128 * 128);
    pool_bytes = shared_bytes;
    kernel = body;
    grid.x = blocks;
    for (block.x = 0; block.x < blocks; ++block.x) {
        memset(shared, 0xff, shared_bytes);
        for (int i = 0; i < THREADS; ++i) {
            finished[i] = false;
            getcontext(&fibers[i]);
            fibers[i].uc_stack.ss_sp = &stacks[stack * i];
            fibers[i].uc_stack.ss_size = stack;
            makecontext(&fibers[i], run_thread, 0);
        }
        // One warp, chosen at random, runs until it waits for the others, its lanes in another order every time: what
        // lacks a barrier goes wrong.
        for (int left = THREADS, idle = 0; left > 0;) {
            const int warp = rand() % (THREADS / WARP);
            for (long before = -1; before != warps[warp].generation;) {
                before = warps[warp].generation;
                const int stride = 2 * (rand() % WARP) + 1, offset = rand() % WARP;
                for (int i = 0; i < WARP; ++i) {
                    current.x = WARP * warp + (i * stride + offset) % WARP;
                    if (finished[current.x]) continue;
                    swapcontext(&scheduler, &fibers[current.x]);
                    left -= finished[current.x];
                    idle = finished[current.x] ? 0 : idle;
                }
            }
            if (++idle > 1000000) fail("threads wait for one another");
        }
    }
}

template <class T> std::vector<T> read(const char* folder, const char* name)
{
    char path[4096];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE* file = fopen(path, "rb");
    if (!file) fail(path);
    fseek(file, 0, SEEK_END);
    std::vector<T> data(ftell(file) / sizeof(T));
    rewind(file);
    if (fread(data.data(), sizeof(T), data.size(), file) != data.size()) fail(path);
    fclose(file);
    return data;
}

void write(const char* folder, const char* name, const std::vector<float>& data)
{
    char path[4096];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE* file = fopen(path, "wb");
    if (!file || fwrite(data.data(), 4, data.size(), file) != data.size()) fail(path);
    fclose(file);
}

}  // namespace emulator

#define threadIdx emulator::current
#define blockIdx emulator::block
#define gridDim emulator::grid
#define __syncthreads() emulator::whole.wait()
#define __syncwarp() emulator::warps[emulator::current.x / emulator::WARP].wait()

struct uint4 {
    unsigned x, y, z, w;
};
struct float2 {
    float x, y;
};
inline uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }
inline float2 make_float2(float x, float y) { return {x, y}; }
inline unsigned max(unsigned a, unsigned b) { return a > b ? a : b; }
inline unsigned __float_as_uint(float x)
{
    unsigned bits;
    memcpy(&bits, &x, 4);
    return bits;
}
inline float __uint_as_float(unsigned bits)
{
    float x;
    memcpy(&x, &bits, 4);
    return x;
}

// Stands for the text ``CUDA`` of neuma_lib.mechanics.neural_fused
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
    auto prefetch = [](const float*) {};                                                                             \
    auto warp_max = [](unsigned x) { return emulator::warp_max(x); };
