// Functions of deformation_kernels.py. REAL is the scalar type. Four numbers are one access of 16 bytes on a GPU.
//// quad
    typedef REAL Real;
    struct alignas(16) Quad { Real c[4]; };
    Quad* quads = (Quad*)((char*)rows.data + (size_t)frame * rows.strides[0]);

//// get
    const Quad quad = quads[place];
    return wp::vec_t<4, Real>(quad.c[0], quad.c[1], quad.c[2], quad.c[3]);

//// put
    quads[place] = Quad{{value[0], value[1], value[2], value[3]}};

//// sum
    const int* sources = (const int*)indices.data;
    const Real* factors = (const Real*)weights.data;
    Real sum[4] = {};
    for (int k = start; k < stop; ++k) {
        const Real factor = factors[k];
        const Quad quad = quads[sources[k] * parts + part];
        #pragma unroll
        for (int a = 0; a < 4; ++a) sum[a] += factor * quad.c[a];
    }
    return wp::vec_t<4, Real>(sum[0], sum[1], sum[2], sum[3]);
