// Functions of gather.py. REAL is the scalar type, VECTOR whether a GPU loads a node in one instruction.
//// node
    typedef REAL Real;
    struct alignas(16) Node { Real c[4]; };
    #define EACH for (int a = 0; a < 4; ++a)
    #define OF(x) (x).c[a]
    // On a GPU the compiler loads single numbers if the fourth is not used. The load is not volatile, because kernels
    // that read these nodes do not write them.
    auto load = [](const Node* place) {
#if VECTOR && defined(__CUDA_ARCH__)
        Node node;
        asm("ld.global.v4.f32 {%0, %1, %2, %3}, [%4];"
            : "=f"(node.c[0]), "=f"(node.c[1]), "=f"(node.c[2]), "=f"(node.c[3]) : "l"(place));
        return node;
#else
        return *place;
#endif
    };
    const char* place = (const char*)rows.data + (size_t)index * rows.strides[0] + (size_t)row * rows.strides[1];
    const Node* first = (const Node*)place;

//// gather
    Node sums[4] = {}, along, across;
    #pragma unroll
    for (int i = 0; i < 3; ++i)
        #pragma unroll
        for (int j = 0; j < 3; ++j) {
            const Node* line = first + (i * n + j) * n;
            const Node node[3] = {load(line), load(line + 1), load(line + 2)};
            EACH OF(along) = OF(node[0]) * wk[0] + OF(node[1]) * wk[1] + OF(node[2]) * wk[2];
            EACH OF(across) = OF(node[0]) * wd_k[0] + OF(node[1]) * wd_k[1] + OF(node[2]) * wd_k[2];
            EACH OF(sums[0]) = OF(sums[0]) + OF(along) * (wi[i] * wj[j]);
            EACH OF(sums[1]) = OF(sums[1]) + OF(along) * (wd_i[i] * wj[j]);
            EACH OF(sums[2]) = OF(sums[2]) + OF(along) * (wi[i] * wd_j[j]);
            EACH OF(sums[3]) = OF(sums[3]) + OF(across) * (wi[i] * wj[j]);
        }
    wp::mat_t<4, 4, Real> result;
    for (int s = 0; s < 4; ++s)
        for (int k = 0; k < 4; ++k) result.data[s][k] = ((const Real*)&sums[s])[k];

//// three
    wp::mat_t<3, 4, Real> result;
    for (int s = 0; s < 3; ++s) {
        const Node node = load(first + s);
        for (int k = 0; k < 4; ++k) result.data[s][k] = ((const Real*)&node)[k];
    }

//// end
    return result;
#undef EACH
#undef OF
