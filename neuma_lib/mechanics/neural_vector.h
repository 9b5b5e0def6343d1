// Kernels of neural_vector.py: both directions of a network over blocks of BLOCK rows on a CPU. SVD, features and
// stress hold a row per SIMD lane, the layers an output per lane. The module defines constants and polynomials.

// Features are sigma - 1 (3), F^T F - I (9, row-major) and det F - 1 (1). The SVD scales a[], so this part precedes it.
//// gram
    Pack gram[9], det;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) gram[3 * i + j] = a[i] * a[j] + a[3 + i] * a[3 + j] + a[6 + i] * a[6 + j];
    det = a[0] * (a[4] * a[8] - a[5] * a[7]) - a[1] * (a[3] * a[8] - a[5] * a[6])
        + a[2] * (a[3] * a[7] - a[4] * a[6]);

// Tiles of matrix products, in registers: ROWS rows times COLUMNS packs.
//// tools
    // 512 bits of consecutive numbers of a row
    typedef Real Vector __attribute__((vector_size(64)));
    const int SPAN = 64 / sizeof(Real);
    const int MANTISSA = sizeof(Real) == 4 ? 23 : 52;
    const Real ROUND = sizeof(Real) == 4 ? Real(12582912.0) : Real(6755399441055744.0);
#if defined(__AVX512F__)
    const int WIDE_COLUMNS = 4, NARROW_ROWS = 16, GROUP = 8;
#else
    const int WIDE_COLUMNS = 1, NARROW_ROWS = 4, GROUP = 2;
#endif
    struct Square { enum { ROWS = 4, COLUMNS = WIDE_COLUMNS }; };
    struct Five { enum { ROWS = 5, COLUMNS = WIDE_COLUMNS }; };
    struct Six { enum { ROWS = 6, COLUMNS = WIDE_COLUMNS }; };
    struct Narrow { enum { ROWS = NARROW_ROWS, COLUMNS = 1 }; };
    // out[r][c] = sum_k x[r row + k step] w[k][c] for r < rows and c < columns, or += if `adds`
    auto product = [](auto tile, int rows, int columns, int depth, const Real* x, int row, int step, const Real* w,
                      Real* out, bool adds) __attribute__((always_inline)) {
        const int M = decltype(tile)::ROWS, N = decltype(tile)::COLUMNS;
        for (int first = 0; first < columns; first += N * SPAN)
            for (int r = 0; r < rows; r += M) {
                Vector sum[M][N];
                const Real* const from = x + r * row;
                Vector* const to = (Vector*)(out + r * columns + first);
                _Pragma("unroll") for (int m = 0; m < M; ++m)
                    _Pragma("unroll") for (int c = 0; c < N; ++c)
                        sum[m][c] = adds ? to[m * columns / SPAN + c] : Vector{};
                _Pragma("nounroll") for (int k = 0; k < depth; ++k) {
                    const Vector* const right = (const Vector*)(w + k * columns + first);
                    _Pragma("unroll") for (int m = 0; m < M; ++m)
                        _Pragma("unroll") for (int c = 0; c < N; ++c) sum[m][c] += from[m * row + k * step] * right[c];
                }
                _Pragma("unroll") for (int m = 0; m < M; ++m)
                    _Pragma("unroll") for (int c = 0; c < N; ++c) to[m * columns / SPAN + c] = sum[m][c];
            }
    };
    // x[i] becomes gelu(x[i]) = x[i] Phi(x[i]), slope[i] its derivative Phi + x phi. Phi - 1/2 is x times a polynomial
    // in t in [-1, 1], phi is 2^k times a polynomial in r in [-1/2, 1/2]. Groups of vectors hide latency.
    auto gelu = [&](bool differentiate, Real* x, Real* slope) __attribute__((always_inline)) {
        typedef decltype(Vector{} < Vector{}) Bits;
        for (int i = 0; i < BLOCK * HIDDEN / SPAN; i += GROUP) {
            Vector* const values = (Vector*)x + i;
            Vector a[GROUP], t[GROUP], distribution[GROUP], density[GROUP];
            auto polynomial = [&](const auto& coefficients, Vector* value) __attribute__((always_inline)) {
                const int terms = sizeof(coefficients) / sizeof(Real);
                _Pragma("unroll") for (int j = 0; j < GROUP; ++j) value[j] = t[j] * coefficients[0] + coefficients[1];
                _Pragma("unroll") for (int k = 2; k < terms; ++k)
                    _Pragma("unroll") for (int j = 0; j < GROUP; ++j) value[j] = value[j] * t[j] + coefficients[k];
            };
            _Pragma("unroll") for (int j = 0; j < GROUP; ++j) {
                a[j] = values[j] > RANGE ? Vector{} + RANGE : values[j];
                a[j] = a[j] < -RANGE ? Vector{} - RANGE : a[j];
                t[j] = a[j] * a[j] * (Real(2) / (RANGE * RANGE)) - Real(1);
            }
            polynomial(DISTRIBUTION, distribution);
            _Pragma("unroll") for (int j = 0; j < GROUP; ++j) distribution[j] = a[j] * distribution[j] + Real(0.5);
            if (differentiate) {
                Bits k[GROUP];
                _Pragma("unroll") for (int j = 0; j < GROUP; ++j) {
                    const Vector exponent = a[j] * a[j] * Real(-0.72134752044448170);  // of 2
                    // adding ROUND rounds to an integer, which is then in the last bits
                    const Vector shifted = exponent + ROUND;
                    t[j] = exponent - (shifted - ROUND);
                    k[j] = (Bits)shifted << MANTISSA;
                }
                polynomial(DENSITY, density);
                _Pragma("unroll") for (int j = 0; j < GROUP; ++j)
                    ((Vector*)slope)[i + j] = a[j] * (Vector)((Bits)density[j] + k[j]) + distribution[j];
            }
            _Pragma("unroll") for (int j = 0; j < GROUP; ++j) values[j] = values[j] * distribution[j];
        }
    };
    // Symmetric matrices as their diagonal and the elements 01, 02 and 12
    const int ROW_OF[OUTPUTS] = {0, 1, 2, 0, 0, 1}, COLUMN_OF[OUTPUTS] = {0, 1, 2, 1, 2, 2};
    auto element = [&](int k) { return 3 * ROW_OF[k] + COLUMN_OF[k]; };
    auto mirrored = [&](int k) { return 3 * COLUMN_OF[k] + ROW_OF[k]; };
    auto load = [&](uint64_t array, size_t first, int used, Pack* x) {
        const Real* const p = (const Real*)array + 9 * first;
        for (int l = 0; l < WIDTH; ++l)
            for (int k = 0; k < 9; ++k) LANE(x[k], l) = p[9 * (l < used ? l : 0) + k];
    };
    auto store = [&](uint64_t array, size_t first, int used, const Pack* x) {
        Real* const p = (Real*)array + 9 * first;
        for (int l = 0; l < used; ++l)
            for (int k = 0; k < 9; ++k) p[9 * l + k] = LANE(x[k], l);
    };
    // c = a b, with strides that allow to transpose either factor
    auto matmul = [](const Pack* a, const Pack* b, Pack* c, int a_row, int a_column, int b_row, int b_column) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                c[3 * i + j] = a[i * a_row] * b[j * b_column] + a[i * a_row + a_column] * b[b_row + j * b_column] +
                               a[i * a_row + 2 * a_column] * b[2 * b_row + j * b_column];
    };
    #define NN 3, 1, 3, 1
    #define NT 3, 1, 1, 3
    #define TN 1, 3, 3, 1
    // Weights with merged rows or columns of symmetric pairs, each as left and as right factor.
    #define ALIGNED __attribute__((aligned(128)))
    Real w0_T[INPUTS * HIDDEN] ALIGNED;  // (10, 64)
    Real w1_T[HIDDEN * HIDDEN] ALIGNED;  // (64, 64)
    Real w2_T[HIDDEN * NARROW] ALIGNED;  // (64, 16)
    Real z[BLOCK * NARROW] ALIGNED;      // features, then their gradient
    Real y[BLOCK * NARROW] ALIGNED;      // X, then its gradient
    Real h0[BLOCK * HIDDEN] ALIGNED, h1[BLOCK * HIDDEN] ALIGNED;
    Real scratch[KEPT * BLOCK] ALIGNED;
    auto kept_of = [&](size_t begin) { return (Pack*)(cached ? (Real*)cache + begin * KEPT : scratch); };
    const Real* const W0_ = (const Real*)W0;
    const Real* const W1_ = (const Real*)W1;
    const Real* const W2_ = (const Real*)W2;
    for (int o = 0; o < HIDDEN; ++o) {
        const Real* const w = W0_ + FEATURES * o;
        for (int k = 0; k < 3; ++k) {
            w0_T[HIDDEN * k + o] = w[k];
            w0_T[HIDDEN * (3 + k) + o] = w[3 + element(k)];
            w0_T[HIDDEN * (6 + k) + o] = w[3 + element(3 + k)] + w[3 + mirrored(3 + k)];
        }
        w0_T[HIDDEN * 9 + o] = w[12];
        for (int i = 0; i < HIDDEN; ++i) w1_T[HIDDEN * i + o] = W1_[HIDDEN * o + i];
        for (int k = 0; k < NARROW; ++k) w2_T[NARROW * o + k] = Real(0);
        for (int k = 0; k < OUTPUTS; ++k)
            w2_T[NARROW * o + k] = Real(0.5) * (W2_[HIDDEN * element(k) + o] + W2_[HIDDEN * mirrored(k) + o]);
    }
    // Features of the packs of a block. kept[KEPT] of a pack receives U, V, s and X, or has them if `again`.
    auto features = [&](size_t begin, Pack* kept, bool again) {
        for (int pack = 0; pack < BLOCK / WIDTH; ++pack, kept += KEPT) {
            const size_t first = begin + pack * WIDTH;
            // lanes after the last row repeat a row, without gradient
            const size_t start = first < (size_t)n ? first : n - 1;
            const int used = n - start < WIDTH ? n - start : WIDTH;
            Pack a[9], x[INPUTS];
            load(F, start, used, a);
            {GRAM}
            for (int k = 0; k < OUTPUTS; ++k) x[3 + k] = gram[element(k)] - (k < 3 ? Real(1) : Real(0));
            x[9] = det - Real(1);
            if (!again) {
                {SVD}
                for (int k = 0; k < 3; ++k) {
                    kept[k] = u0[k];
                    kept[3 + k] = u1[k];
                    kept[6 + k] = u2[k];
                    kept[9 + k] = v0[k];
                    kept[12 + k] = v1[k];
                    kept[15 + k] = v2[k];
                    kept[18 + k] = s[k];
                }
            }
            for (int k = 0; k < 3; ++k) x[k] = kept[18 + k] - Real(1);
            for (int l = 0; l < WIDTH; ++l)
                for (int k = 0; k < INPUTS; ++k) z[NARROW * (pack * WIDTH + l) + k] = LANE(x[k], l);
        }
    };
    // R = U V^T and X of a pack, as for `features`
    auto rotation_and_output = [&](int pack, Pack* kept, bool again, Pack* R, Pack* X) {
        matmul(kept, kept + 9, R, 1, 3, 3, 1);
        if (!again)
            for (int l = 0; l < WIDTH; ++l)
                for (int k = 0; k < OUTPUTS; ++k) LANE(kept[21 + k], l) = y[NARROW * (pack * WIDTH + l) + k];
        for (int k = 0; k < OUTPUTS; ++k) X[element(k)] = X[mirrored(k)] = kept[21 + k];
    };

//// evaluate
    for (size_t begin = 0; begin < (size_t)n; begin += BLOCK) {
        Pack* const kept = kept_of(begin);
        features(begin, kept, false);
        product(Square(), BLOCK, HIDDEN, INPUTS, z, NARROW, 1, w0_T, h0, false);
        gelu(false, h0, nullptr);
        product(Square(), BLOCK, HIDDEN, HIDDEN, h0, HIDDEN, 1, w1_T, h1, false);
        gelu(false, h1, nullptr);
        product(Narrow(), BLOCK, NARROW, HIDDEN, h1, HIDDEN, 1, w2_T, y, false);
        for (int pack = 0; pack < BLOCK / WIDTH && begin + pack * WIDTH < (size_t)n; ++pack) {
            const size_t first = begin + pack * WIDTH;
            const int used = n - first < WIDTH ? n - first : WIDTH;
            Pack f[9], R[9], X[9], P[9], value[9];
            load(F, first, used, f);
            rotation_and_output(pack, kept + KEPT * pack, false, R, X);
            matmul(R, X, P, NN);
            if (elastic) matmul(P, f, value, NT);
            else for (int k = 0; k < 9; ++k) value[k] = f[k] + scale * P[k];
            store(out, first, used, value);
        }
    }

//// vjp
    Real w0[HIDDEN * NARROW] ALIGNED;   // (64, 16)
    Real w1[HIDDEN * HIDDEN] ALIGNED;   // (64, 64)
    Real w2[OUTPUTS * HIDDEN] ALIGNED;  // (6, 64)
    Real slope0[BLOCK * HIDDEN] ALIGNED, slope1[BLOCK * HIDDEN] ALIGNED;
    Real g0[BLOCK * HIDDEN] ALIGNED, g1[BLOCK * HIDDEN] ALIGNED;
    // gradients of w0_T, w1 and w2
    Real sum0[INPUTS * HIDDEN] ALIGNED = {}, sum1[HIDDEN * HIDDEN] ALIGNED = {}, sum2[OUTPUTS * HIDDEN] ALIGNED = {};
    for (int o = 0; o < HIDDEN; ++o) {
        for (int k = 0; k < NARROW; ++k) w0[NARROW * o + k] = k < INPUTS ? w0_T[HIDDEN * k + o] : Real(0);
        for (int k = 0; k < OUTPUTS; ++k) w2[HIDDEN * k + o] = w2_T[NARROW * o + k];
        for (int i = 0; i < HIDDEN; ++i) w1[HIDDEN * o + i] = W1_[HIDDEN * o + i];
    }
    for (size_t begin = 0; begin < (size_t)n; begin += BLOCK) {
        Pack* const kept = kept_of(begin);
        features(begin, kept, cached);
        product(Square(), BLOCK, HIDDEN, INPUTS, z, NARROW, 1, w0_T, h0, false);
        gelu(true, h0, slope0);
        product(Square(), BLOCK, HIDDEN, HIDDEN, h0, HIDDEN, 1, w1_T, h1, false);
        gelu(true, h1, slope1);
        if (!cached) product(Narrow(), BLOCK, NARROW, HIDDEN, h1, HIDDEN, 1, w2_T, y, false);
        Pack direct[BLOCK / WIDTH][9], grad_R[BLOCK / WIDTH][9];
        for (int pack = 0; pack < BLOCK / WIDTH; ++pack) {
            const size_t first = begin + pack * WIDTH;
            Pack g[9], R[9], X[9], P[9], grad_P[9], grad_X[9];
            if (first < (size_t)n) {
                const int used = n - first < WIDTH ? n - first : WIDTH;
                load(grad_out, first, used, g);
                for (int l = used; l < WIDTH; ++l)
                    for (int k = 0; k < 9; ++k) LANE(g[k], l) = Real(0);
            } else for (int k = 0; k < 9; ++k) g[k] = Pack{};
            rotation_and_output(pack, kept + KEPT * pack, cached, R, X);
            if (elastic) {
                Pack f[9];
                const size_t start = first < (size_t)n ? first : n - 1;
                load(F, start, n - start < WIDTH ? n - start : WIDTH, f);
                matmul(g, f, grad_P, NN);
                matmul(R, X, P, NN);
                matmul(g, P, direct[pack], TN);
            } else for (int k = 0; k < 9; ++k) {
                grad_P[k] = scale * g[k];
                direct[pack][k] = g[k];
            }
            matmul(grad_P, X, grad_R[pack], NN);
            matmul(R, grad_P, grad_X, TN);
            for (int k = 3; k < OUTPUTS; ++k) grad_X[element(k)] += grad_X[mirrored(k)];
            for (int l = 0; l < WIDTH; ++l)
                for (int k = 0; k < OUTPUTS; ++k) y[NARROW * (pack * WIDTH + l) + k] = LANE(grad_X[element(k)], l);
        }
        product(Six(), OUTPUTS, HIDDEN, BLOCK, y, 1, NARROW, h1, sum2, true);
        product(Square(), BLOCK, HIDDEN, OUTPUTS, y, NARROW, 1, w2, g1, false);
        for (int i = 0; i < BLOCK * HIDDEN / SPAN; ++i) ((Vector*)g1)[i] *= ((Vector*)slope1)[i];
        product(Square(), HIDDEN, HIDDEN, BLOCK, g1, 1, HIDDEN, h0, sum1, true);
        product(Square(), BLOCK, HIDDEN, HIDDEN, g1, HIDDEN, 1, w1, g0, false);
        for (int i = 0; i < BLOCK * HIDDEN / SPAN; ++i) ((Vector*)g0)[i] *= ((Vector*)slope0)[i];
        product(Five(), INPUTS, HIDDEN, BLOCK, z, 1, NARROW, g0, sum0, true);
        product(Narrow(), BLOCK, NARROW, HIDDEN, g0, HIDDEN, 1, w0, z, false);
        for (int pack = 0; pack < BLOCK / WIDTH && begin + pack * WIDTH < (size_t)n; ++pack) {
            const size_t first = begin + pack * WIDTH;
            const int used = n - first < WIDTH ? n - first : WIDTH;
            const Pack* const u = kept + KEPT * pack;
            const Pack* const v = u + 9;
            const Pack* const s = v + 9;
            Pack f[9], gz[INPUTS], M[9], T[9], K[9], G[9];
            load(F, first, used, f);
            for (int l = 0; l < WIDTH; ++l)
                for (int k = 0; k < INPUTS; ++k) LANE(gz[k], l) = z[NARROW * (pack * WIDTH + l) + k];
            // rotation and singular values: U K V^T, K_ij = (M_ij - M_ji) / (s_i + s_j), M = U^T grad_R V
            matmul(u, grad_R[pack], T, NN);
            matmul(T, v, M, NT);
            for (int i = 0; i < 3; ++i) {
                K[4 * i] = gz[i];
                for (int j = i + 1; j < 3; ++j) {
                    Pack total = s[i] + s[j];
                    const Pack low = total < Real(0) ? Pack{} - FLOOR : Pack{} + FLOOR;
                    total = total < FLOOR ? (total > -FLOOR ? low : total) : total;
                    K[3 * i + j] = (M[3 * i + j] - M[3 * j + i]) / total;
                    K[3 * j + i] = -K[3 * i + j];
                }
            }
            matmul(u, K, T, TN);
            matmul(T, v, M, NN);
            // F^T F: F (G + G^T)
            for (int k = 0; k < 3; ++k) G[4 * k] = gz[3 + k] + gz[3 + k];
            for (int k = 3; k < OUTPUTS; ++k) G[element(k)] = G[mirrored(k)] = gz[3 + k];
            matmul(f, G, T, NN);
            // det F: cofactors
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
                    const Pack cofactor = f[3 * i1 + j1] * f[3 * i2 + j2] - f[3 * i1 + j2] * f[3 * i2 + j1];
                    M[3 * i + j] += T[3 * i + j] + gz[9] * cofactor + direct[pack][3 * i + j];
                }
            if (adds) {
                Pack before[9];
                load(grad_F, first, used, before);
                for (int k = 0; k < 9; ++k) M[k] += before[k];
            }
            store(grad_F, first, used, M);
        }
    }
    Real* const G0 = (Real*)total0;
    Real* const G1 = (Real*)total1;
    Real* const G2 = (Real*)total2;
    for (int o = 0; o < HIDDEN; ++o) {
        Real* const w = G0 + FEATURES * o;
        for (int k = 0; k < 3; ++k) {
            const Real pair = sum0[HIDDEN * (6 + k) + o], half = Real(0.5) * sum2[HIDDEN * (3 + k) + o];
            w[k] += sum0[HIDDEN * k + o];
            w[3 + element(k)] += sum0[HIDDEN * (3 + k) + o];
            w[3 + element(3 + k)] += pair;
            w[3 + mirrored(3 + k)] += pair;
            G2[HIDDEN * element(k) + o] += sum2[HIDDEN * k + o];
            G2[HIDDEN * element(3 + k) + o] += half;
            G2[HIDDEN * mirrored(3 + k) + o] += half;
        }
        w[12] += sum0[HIDDEN * 9 + o];
    }
    for (int i = 0; i < HIDDEN * HIDDEN; ++i) G1[i] += sum1[i];

//// end
    #undef NN
    #undef NT
    #undef TN
    #undef ALIGNED
