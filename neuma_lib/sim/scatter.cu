// Functions of scatter.py that all threads of a warp call together, one particle per thread.
// Bits of a run in a thread: 0-7 the lane after its last member, 8-15 the number of halving steps for the longest run of
// the warp, 16 whether this thread is the first member, which adds the sum.
//// run
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    const int before = __shfl_up_sync(all, cell, 1);
    const bool first = lane == 0 || before != cell;
    const unsigned firsts = __ballot_sync(all, first);
    const unsigned later = lane == 31 ? 0u : firsts >> (lane + 1);
    const int stop = later ? lane + __ffs(later) : 32;
    int steps = 0;
    for (int d = 1; d < 32; d *= 2)
        if (__any_sync(all, lane + d < stop)) ++steps;
    return stop | (steps << 8) | ((first && cell >= 0) ? 1 << 16 : 0);

//// deposit
    // Adds COMPONENTS of the four numbers of a node, 16 bytes at a time if VECTOR.
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    const int stop = run & 0xff;
    const int steps = (run >> 8) & 0xff;
    float sum[3][4];
    for (int k = 0; k < 3; ++k)
        for (int a = 0; a < 4; ++a) sum[k][a] = value.data[k][a];
    for (int s = 0, d = 1; s < steps; ++s, d *= 2) {
        const bool same = lane + d < stop;
        #pragma unroll
        for (int k = 0; k < 3; ++k)
            #pragma unroll
            for (int a = 0; a < COMPONENTS; ++a) {
                const float other = __shfl_down_sync(all, sum[k][a], d);
                sum[k][a] += same ? other : 0.0f;
            }
    }
    if (run >> 16) {
        float* node = (float*)((char*)rows.data + (size_t)index * rows.strides[0] + (size_t)row * rows.strides[1]);
        #pragma unroll
        for (int k = 0; k < 3; ++k, node += 4) {
#if VECTOR && defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
            asm volatile("red.global.add.v4.f32 [%0], {%1, %2, %3, %4};"
                         :: "l"(node), "f"(sum[k][0]), "f"(sum[k][1]), "f"(sum[k][2]), "f"(sum[k][3]) : "memory");
#else
            for (int a = 0; a < COMPONENTS; ++a) atomicAdd(node + a, sum[k][a]);
#endif
        }
    }
