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

// On a CPU: one frame each. A row is a vector and a 3x3 matrix.
//// frames
    #pragma clang fp contract(on)
    typedef REAL Real;
    typedef Real Quad __attribute__((ext_vector_type(4), aligned(sizeof(Real))));
    #define INLINE __attribute__((always_inline))
    const int ROW = 12;
    struct Rows { Quad c[3]; };  // of a matrix; last lanes are arbitrary
    auto load3 = [](const Real* p) INLINE { return Quad{p[0], p[1], p[2], 0}; };
    auto load = [](const Real* p) INLINE { return *(const Quad*)p; };
    auto matrix = [&](const Real* p) INLINE { return Rows{{load(p), load(p + 3), load3(p + 6)}}; };
    auto store = [](Real* p, const Rows& a) INLINE {  // a matrix, in ascending order because stores overlap
        *(Quad*)p = a.c[0];
        *(Quad*)(p + 3) = a.c[1];
        for (int k = 0; k < 3; ++k) p[6 + k] = a.c[2][k];
    };
    auto transposed = [](const Rows& a) INLINE {
        Rows t;
        for (int i = 0; i < 3; ++i) t.c[i] = Quad{a.c[0][i], a.c[1][i], a.c[2][i], 0};
        return t;
    };
    auto product = [](const Rows& a, const Rows& b) INLINE {
        Rows r;
        for (int i = 0; i < 3; ++i) r.c[i] = a.c[i][0] * b.c[0] + a.c[i][1] * b.c[1] + a.c[i][2] * b.c[2];
        return r;
    };
    // Sum of weighted rows of the given number of vectors of four, by a row of a sparse matrix
    auto weighted_sum = [&](int i, const Real* rows, int row, Quad* sum) INLINE {
        const int* const starts = (const int*)indptr.data;
        const int* const sources = (const int*)indices.data;
        const Real* const factors = (const Real*)weights.data;
        for (int q = 0; 4 * q < row; ++q) sum[q] = Quad(0);
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const Real* const from = rows + (size_t)sources[k] * row;
            for (int q = 0; 4 * q < row; ++q) sum[q] += factors[k] * load(from + 4 * q);
        }
    };

//// forward
    Real* const rows = (Real*)scratch.data;
    for (int j = 0; j < particles; ++j) {
        const size_t from = (size_t)frame * particles + j;
        for (int k = 0; k < 3; ++k) rows[ROW * j + k] = x.data[3 * from + k] - x0.data[3 * j + k];
        for (int k = 0; k < 9; ++k) rows[ROW * j + 3 + k] = F.data[9 * from + k];
    }
    for (int g = 0; g < count; ++g) {
        const size_t to = (size_t)frame * count + g;
        Quad sum[3];
        weighted_sum(g, rows, ROW, sum);
        Real row[ROW];
        for (int q = 0; q < 3; ++q) *(Quad*)(row + 4 * q) = sum[q];
        if (sums.data)
            for (int q = 0; q < 3; ++q) *(Quad*)(sums.data + ROW * to + 4 * q) = sum[q];
        const Rows mean_F = matrix(row + 3), columns = transposed(mean_F);
        Quad shift = load(row);
        if (arms.data) {
            const Quad arm = load3(arms.data + 3 * g);
            shift += columns.c[0] * arm[0] + columns.c[1] * arm[1] + columns.c[2] * arm[2] - arm;
        }
        for (int k = 0; k < 3; ++k) moved.data[3 * to + k] = means.data[3 * g + k] + shift[k];
        store(stretched.data + 9 * to, product(product(mean_F, matrix(covars.data + 9 * g)), columns));
    }

//// backward
    Real* const rows = (Real*)scratch.data;
    const bool deforms = sums.data;
    const int row = deforms ? ROW : 4;
    for (int g = 0; g < count; ++g) {
        const size_t from = (size_t)frame * count + g;
        const Quad shift = load3(grad_moved.data + 3 * from);
        Real* const out = rows + (size_t)row * g;
        *(Quad*)out = shift;
        if (!deforms) continue;
        // of F A F^T: (G F A^T + G^T F A)
        const Rows mean_F = matrix(sums.data + ROW * from + 3), grad = matrix(grad_stretched.data + 9 * from);
        const Rows A = matrix(covars.data + 9 * g);
        const Rows one = product(grad, product(mean_F, transposed(A)));
        Rows total = product(transposed(grad), product(mean_F, A));
        for (int i = 0; i < 3; ++i) total.c[i] += one.c[i];
        if (arms.data)
            for (int i = 0; i < 3; ++i) total.c[i] += shift[i] * load3(arms.data + 3 * g);
        store(out + 3, total);
    }
    for (int j = 0; j < particles; ++j) {
        const size_t to = (size_t)frame * particles + j;
        Quad sum[3];
        if (deforms)
            weighted_sum(j, rows, ROW, sum);
        else
            weighted_sum(j, rows, 4, sum);
        for (int k = 0; k < 3; ++k) grad_x.data[3 * to + k] = sum[0][k];
        if (!deforms) continue;
        Real* const out = grad_F.data + 9 * to;
        out[0] = sum[0][3];
        *(Quad*)(out + 1) = sum[1];
        *(Quad*)(out + 5) = sum[2];
    }
