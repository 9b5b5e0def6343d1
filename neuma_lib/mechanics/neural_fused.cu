// Kernels of neural_fused.py: bodies of functions in parts, with constants defined by that module.

// Hardware instructions. The tests replace this part by an emulation.
//// machine
    const int thread = threadIdx.x, lane = thread & 31, warp = thread >> 5;
    char* pool = (char*)&shared.data.ptr[0];
    const unsigned start = (unsigned)__cvta_generic_to_shared(pool);
    const unsigned pool_address = (start + 127u) & ~127u;
    pool += pool_address - start;
    auto mma = [](float* c, const unsigned* a, const unsigned* b) {
        asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
            "{%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
            : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
    };
    auto matrices = [&](unsigned* r, int offset) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
            : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3]) : "r"(pool_address + offset) : "memory");
    };
    auto transposed = [&](unsigned* r, int offset) {
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
            : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3]) : "r"(pool_address + offset) : "memory");
    };
    auto pack = [](float x0, float x1) {
        unsigned pair;
        asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(pair) : "f"(x1), "f"(x0));
        return pair;
    };
    auto unpack = [](unsigned pair, float& x0, float& x1) {
        asm("{ .reg .f16 low, high; mov.b32 {low, high}, %2; cvt.f32.f16 %0, low; cvt.f32.f16 %1, high; }"
            : "=f"(x0), "=f"(x1) : "r"(pair));
    };
    auto power_of_two = [](float x) {
        float y;
        asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
        return y;
    };
    auto root = [](float x) {
        float y;
        asm("sqrt.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
        return y;
    };
    auto prefetch = [](const float* x) { asm volatile("prefetch.global.L1 [%0];" : : "l"(x)); };
    auto warp_max = [](unsigned x) { return __reduce_max_sync(0xffffffffu, x); };

// Fragments of mma.m16n8k16, with g = lane / 4 and t = lane % 4: the accumulator c has rows g (0, 1) and g + 8 (2, 3)
// and columns 2t, 2t + 1. The left operand has these rows and columns in a[0], a[1] and columns + 8 in a[2], a[3], so
// that two adjacent accumulators form one left operand.
//// tools
    typedef float Pack;
    typedef float Real;
    const int WIDTH = 1;
    #define LANE(x, l) (x)
    // two units in the last place suffice for products of 11 bits
    #define SQRT(x) (HALF ? root(x) : sqrtf(x))
    #define RECIPROCAL(x) DIVIDE(1.0f, x)
    #define RECIPROCAL_ROOT(x) DIVIDE(1.0f, SQRT(x))
    #define DIVIDE(x, y) (HALF ? __fdividef(x, y) : (x) / (y))
    const int g = lane >> 2, t = lane & 3;
    // Row of this thread in the warp and in the block. If a warp has 16 rows, both of its halves compute the same rows.
    const int warp_rows = 16 * TILES, warp_row = lane & (warp_rows - 1), block_row = warp_rows * warp + warp_row;
    // Byte offset of a chunk of eight halves in a matrix with 64 or 16 columns
    auto at64 = [](int row, int chunk) { return row * ROW64 + ((chunk ^ (row & 7)) << 4); };
    auto at16 = [](int row, int chunk) { return row * ROW16 + ((chunk ^ ((row >> 2) & 1)) << 4); };

    // With HALF there are no low parts.
    auto split = [&](float x0, float x1, unsigned& high, unsigned& low) {
        float y0, y1;
        high = pack(x0, x1);
        if (HALF) return;
        unpack(high, y0, y1);
        low = pack(x0 - y0, x1 - y1);
    };
    // Powers of two that scale numbers with this exponent to [2^14, 2^15), and back.
    auto scales = [](unsigned largest, float& up, float& down) {
        unsigned exponent = largest >> 23;
        exponent = exponent < 15u ? 15u : exponent;
        up = __uint_as_float((268u - exponent) << 23);
        down = __uint_as_float((exponent - 14u) << 23);
    };
    auto clear = [](auto& c) {
        #pragma unroll
        for (int i = 0; i < (int)(sizeof(c) / sizeof(float)); ++i) ((float*)c)[i] = 0.0f;
    };
    // c[m][n + q] += a[m] b[q], small terms first
    auto multiply = [&](auto& c, int n, const auto& high, const auto& low, const auto& b) {
        const int M = sizeof(c) / sizeof(c[0]), Q = sizeof(b) / sizeof(b[0]);
        if (!HALF) {
            #pragma unroll
            for (int q = 0; q < Q; ++q)
                #pragma unroll
                for (int m = 0; m < M; ++m) mma(c[m][n + q], low[m], b[q]);
            #pragma unroll
            for (int q = 0; q < Q; ++q)
                #pragma unroll
                for (int m = 0; m < M; ++m) mma(c[m][n + q], high[m], b[q] + 2);
        }
        #pragma unroll
        for (int q = 0; q < Q; ++q)
            #pragma unroll
            for (int m = 0; m < M; ++m) mma(c[m][n + q], high[m], b[q]);
    };
    // Left operand of columns 16 j to 16 j + 15 from accumulators x
    auto fragments = [&](const auto& x, int j, float up, auto& high, auto& low) {
        #pragma unroll
        for (int m = 0; m < TILES; ++m)
            #pragma unroll
            for (int k = 0; k < 4; ++k) {
                const float* c = x[m][2 * j + (k >> 1)] + 2 * (k & 1);
                split(c[0] * up, c[1] * up, high[m][k], low[m][k]);
            }
    };
    // Rows of this warp in a matrix with 16 columns, as left operand
    auto load16 = [&](int matrix, auto& high, auto& low) {
        #pragma unroll
        for (int m = 0; m < TILES; ++m) {
            const int place = matrix + at16(warp_rows * warp + 16 * m + (lane & 15), lane >> 4);
            matrices(high[m], place);
            if (!HALF) matrices(low[m], place + LOW16);
        }
    };
    auto store16 = [&](int matrix, const float* x, float up) {
        #pragma unroll
        for (int chunk = 0; chunk < 2; ++chunk) {
            unsigned high[4], low[4];
            #pragma unroll
            for (int k = 0; k < 4; ++k) {
                const float* pair = x + 8 * chunk + 2 * k;
                split(pair[0] * up, pair[1] * up, high[k], low[k]);
            }
            char* place = pool + matrix + at16(block_row, chunk);
            *(uint4*)place = make_uint4(high[0], high[1], high[2], high[3]);
            if (!HALF) *(uint4*)(place + LOW16) = make_uint4(low[0], low[1], low[2], low[3]);
        }
    };
    // Columns 16 j to 16 j + 15 of the rows of this warp in a matrix with 64 columns
    auto stage = [&](int matrix, int j, const auto& high, const auto& low) {
        #pragma unroll
        for (int m = 0; m < TILES; ++m)
            #pragma unroll
            for (int k = 0; k < 4; ++k) {
                const int row = warp_rows * warp + 16 * m + g + 8 * (k & 1);
                char* place = pool + matrix + at64(row, 2 * j + (k >> 1)) + 4 * t;
                *(unsigned*)place = high[m][k];
                if (!HALF) *(unsigned*)(place + LOW64) = low[m][k];
            }
    };
    // Right operands of an even number of tiles: place(q, part) is the offset of this lane's chunk in the high (part 0)
    // or low part of tile q. One load reads both parts of a tile, or the high parts of two tiles.
    auto right = [&](auto load, auto& b, auto place) {
        const int Q = sizeof(b) / sizeof(b[0]);
        if (HALF)
            #pragma unroll
            for (int q = 0; q < Q; q += 2) {
                unsigned both[4];
                load(both, place(q + (lane >> 4), 0));
                #pragma unroll
                for (int k = 0; k < 4; ++k) b[q + (k >> 1)][k & 1] = both[k];
            }
        else
            #pragma unroll
            for (int q = 0; q < Q; ++q) load(b[q], place(q, lane >> 4));
    };
    // Tiles of 8 columns from tile n, rows 16 k to 16 k + 15, of W^T and of W
    auto weights_T = [&](int matrix, int low, int k, int n, auto& b) {
        right(matrices, b, [&](int q, int part) {
            return matrix + part * low + at64(8 * (n + q) + (lane & 7), 2 * k + ((lane >> 3) & 1));
        });
    };
    auto weights = [&](int matrix, int low, int k, int n, auto& b) {
        right(transposed, b, [&](int q, int part) { return matrix + part * low + at64(16 * k + (lane & 15), n + q); });
    };
    auto layer0 = [&](const auto& high, const auto& low, int n, auto& c, int to) {
        unsigned b[sizeof(c[0]) / sizeof(c[0][0]) < 4 ? 2 : 4][4];
        right(matrices, b, [&](int q, int part) {
            return W0_AT + part * W0_LOW + at16(8 * (n + q) + (lane & 7), (lane >> 3) & 1);
        });
        multiply(c, to, high, low, b);
    };
    // Standard normal distribution function with tail 2^q(|x|), error 5e-8
    auto normal_cdf = [&](float x) {
        const float u = fabsf(x);
        float q = -2.3349487037194194e-06f;
        q = fmaf(q, u, 3.373783692950383e-05f);
        q = fmaf(q, u, -1.61294054123573e-04f);
        q = fmaf(q, u, -1.917027257150039e-04f);
        q = fmaf(q, u, 7.126863580197096e-03f);
        q = fmaf(q, u, -5.253361165523529e-02f);
        q = fmaf(q, u, -4.591982960700989e-01f);
        q = fmaf(q, u, -1.1511059999465942f);
        const float tail = power_of_two(fmaf(q, u, -1.0f));
        return x < 0.0f ? tail : 1.0f - tail;
    };
    // derivative of gelu(x) = x cdf(x)
    auto gelu_slope = [&](float x, float cdf) {
        return fmaf(x * 0.3989422804014327f, power_of_two(x * x * -0.7213475204444817f), cdf);
    };
    auto largest = [](float sofar, float x) { return fmaxf(sofar, fabsf(x)); };
    auto warp_scales = [&](float magnitude, float& up, float& down) {
        scales(warp_max(__float_as_uint(magnitude)), up, down);
    };
    // X = sym(Y), with y (9) the stored output of the lane's row
    auto output_of_row = [&](const float* y, float* X) {
        #pragma unroll
        for (int i = 0; i < 3; ++i)
            #pragma unroll
            for (int j = 0; j < 3; ++j) X[3 * i + j] = 0.5f * (y[3 * i + j] + y[3 * j + i]);
    };
    auto put_rows = [&](float* rows, const auto& c, int columns, float factor) {
        #pragma unroll
        for (int m = 0; m < TILES; ++m)
            #pragma unroll
            for (int n = 0; n < 2; ++n)
                #pragma unroll
                for (int k = 0; k < 4; ++k) {
                    const int column = 8 * n + 2 * t + (k & 1);
                    if (column < columns) rows[ROW_STRIDE * (16 * m + g + 8 * (k >> 1)) + column] = c[m][n][k] * factor;
                }
    };
    // c = a b, with strides that allow to transpose either factor
    auto matmul = [](const float* a, const float* b, float* c, int a_row, int a_column, int b_row, int b_column) {
        #pragma unroll
        for (int i = 0; i < 3; ++i)
            #pragma unroll
            for (int j = 0; j < 3; ++j) {
                float sum = 0.0f;
                #pragma unroll
                for (int k = 0; k < 3; ++k) sum = fmaf(a[i * a_row + k * a_column], b[k * b_row + j * b_column], sum);
                c[3 * i + j] = sum;
            }
    };
    #define NN 3, 1, 3, 1
    #define NT 3, 1, 1, 3
    #define TN 1, 3, 3, 1
    float down0 = 0.0f, down1 = 0.0f, down2 = 0.0f;

// Opens the loop over tiles of ROWS rows and stores the features and, in the first iteration, the weights.
//// features
    for (int tile = blockIdx.x; tile * ROWS < n; tile += gridDim.x) {
        __syncthreads();
        const bool first = tile == (int)blockIdx.x;
        // rows past the end repeat the last row, without gradient and result
        const bool used = tile * ROWS + block_row < n;
        const int row = used ? tile * ROWS + block_row : n - 1;
        float f[9], R[9], V[9], z[16], sums[3];
        #pragma unroll
        for (int k = 0; k < 9; ++k) f[k] = ((const float*)F)[9 * (size_t)row + k];
        {PREFETCH}
        float w0[W0_LOADS], w1[2 * W1_LOADS], w2[2 * W2_LOADS];
        if (first) {
            #pragma unroll
            for (int k = 0; k < W0_LOADS; ++k) {
                const int i = thread + THREADS * k;
                w0[k] = i < W1_START ? ((const float*)W0)[i] : 0.0f;
            }
            #pragma unroll
            for (int k = 0; k < W1_LOADS; ++k) {
                const float2 pair = ((const float2*)W1)[thread + THREADS * k];
                w1[2 * k] = pair.x;
                w1[2 * k + 1] = pair.y;
            }
            #pragma unroll
            for (int k = 0; k < W2_LOADS; ++k) {
                const int i = thread + THREADS * k;
                const float2 pair = 2 * i < WEIGHTS - W2_START ? ((const float2*)W2)[i] : make_float2(0.0f, 0.0f);
                w2[2 * k] = pair.x;
                w2[2 * k + 1] = pair.y;
            }
        }
        {
            Pack a[9];
            for (int k = 0; k < 9; ++k) a[k] = f[k];
            {GRAM}
            {SVD}
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) R[3 * i + j] = u0[i] * v0[j] + u1[i] * v1[j] + u2[i] * v2[j];
            for (int k = 0; k < 3; ++k) {
                V[k] = v0[k];
                V[3 + k] = v1[k];
                V[6 + k] = v2[k];
                z[k] = s[k] - 1.0f;
                z[13 + k] = 0.0f;
            }
            for (int k = 0; k < 9; ++k) z[3 + k] = gram[k] - (k % 4 == 0 ? 1.0f : 0.0f);
            z[12] = det - 1.0f;
            sums[0] = s[1] + s[2];
            sums[1] = s[0] + s[2];
            sums[2] = s[0] + s[1];
        }
        float up, down_z;
        {
            float size = 0.0f;
            #pragma unroll
            for (int k = 0; k < FEATURES; ++k) size = largest(size, z[k]);
            warp_scales(size, up, down_z);
            store16(Z_AT, z, up);
        }
        if (first) {
            float size0 = 0.0f, size1 = 0.0f, size2 = 0.0f;
            #pragma unroll
            for (int k = 0; k < W0_LOADS; ++k) size0 = largest(size0, w0[k]);
            #pragma unroll
            for (int k = 0; k < 2 * W1_LOADS; ++k) size1 = largest(size1, w1[k]);
            #pragma unroll
            for (int k = 0; k < 2 * W2_LOADS; ++k) size2 = largest(size2, w2[k]);
            unsigned* peaks = (unsigned*)(pool + PEAKS_AT);
            const unsigned peak0 = warp_max(__float_as_uint(size0)), peak1 = warp_max(__float_as_uint(size1)),
                           peak2 = warp_max(__float_as_uint(size2));
            if (lane == 0) {
                peaks[warp] = peak0;
                peaks[WARPS + warp] = peak1;
                peaks[2 * WARPS + warp] = peak2;
            }
            __syncthreads();
            auto peak = [&](int k) {
                unsigned sofar = 0;
                #pragma unroll
                for (int w = 0; w < WARPS; ++w) sofar = max(sofar, peaks[WARPS * k + w]);
                return sofar;
            };
            float up0, up1, up2;
            scales(peak(0), up0, down0);
            scales(peak(1), up1, down1);
            scales(peak(2), up2, down2);
            auto put_half = [&](int o, int i, float x) {
                unsigned high, low;
                split(x, 0.0f, high, low);
                char* place = pool + W0_AT + at16(o, i >> 3) + 2 * (i & 7);
                *(unsigned short*)place = (unsigned short)high;
                if (!HALF) *(unsigned short*)(place + W0_LOW) = (unsigned short)low;
            };
            #pragma unroll
            for (int k = 0; k < W0_LOADS; ++k) {
                const int i = thread + THREADS * k;
                if (i < W1_START) put_half(i / FEATURES, i % FEATURES, w0[k] * up0);
            }
            if (thread < HIDDEN)
                for (int i = FEATURES; i < 16; ++i) put_half(thread, i, 0.0f);
            auto put_pair = [&](int matrix, int part, int pair, float x0, float x1) {
                unsigned high, low;
                split(x0, x1, high, low);
                char* place = pool + matrix + at64(pair >> 5, (pair & 31) >> 2) + 4 * (pair & 3);
                *(unsigned*)place = high;
                if (!HALF) *(unsigned*)(place + part) = low;
            };
            #pragma unroll
            for (int k = 0; k < W1_LOADS; ++k) put_pair(W1_AT, W1_LOW, thread + THREADS * k, w1[2 * k] * up1, w1[2 * k + 1] * up1);
            #pragma unroll
            for (int k = 0; k < W2_LOADS; ++k) put_pair(W2_AT, W2_LOW, thread + THREADS * k, w2[2 * k] * up2, w2[2 * k + 1] * up2);
            __syncthreads();
        }
        __syncwarp();

// Both kernels: the first two products, with h0 in x and the unscaled input of the second gelu in y.
//// layers
        unsigned high[TILES][4], low[TILES][4];
        float x[TILES][8][4], y[TILES][8][4], up_h0, down_h0, down;
        clear(x);
        load16(Z_AT, high, low);
        layer0(high, low, 0, x, 0);
        layer0(high, low, 4, x, 4);
        auto activate = [&](auto& c, float factor) {
            float magnitude = 0.0f;
            #pragma unroll
            for (int i = 0; i < (int)(sizeof(c) / sizeof(float)); ++i) {
                float& a = ((float*)c)[i];
                a *= factor;
                a *= normal_cdf(a);
                magnitude = largest(magnitude, a);
            }
            return magnitude;
        };
        float size = activate(x, down_z * down0);
        warp_scales(size, up_h0, down_h0);
        clear(y);
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            fragments(x, j, up_h0, high, low);
            #pragma unroll
            for (int n8 = 0; n8 < 8; n8 += 4) {
                unsigned b[4][4];
                weights_T(W1_AT, W1_LOW, j, n8, b);
                multiply(y, n8, high, low, b);
            }
        }

//// evaluate
        size = activate(y, down_h0 * down1);
        warp_scales(size, up, down);
        float Y[TILES][2][4];
        clear(Y);
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            unsigned b[2][4];
            fragments(y, j, up, high, low);
            weights_T(W2_AT, W2_LOW, j, 0, b);
            multiply(Y, 0, high, low, b);
        }
        float* rows = (float*)(pool + ROW_AT + 4 * warp_rows * ROW_STRIDE * warp);
        put_rows(rows, Y, OUTPUTS, down * down2);
        __syncwarp();
        float X[9], P[9], result[9];
        output_of_row(rows + ROW_STRIDE * warp_row, X);
        matmul(R, X, P, NN);
        if (ELASTIC)
            matmul(P, f, result, NT);
        else
            for (int k = 0; k < 9; ++k) result[k] = fmaf(factor, P[k], f[k]);
        if (used && lane < warp_rows)
            for (int k = 0; k < 9; ++k) ((float*)out)[9 * (size_t)row + k] = result[k];
    }

// Backward only: stores values that are needed again at the end, which frees registers for the layers.
//// put_down
        float* state = (float*)(pool + STATE_AT) + block_row;
        float* downs = (float*)(pool + DOWNS_AT);
        // downs: inverse scales of the activations of each warp
        enum { OF_Z, OF_H0, OF_H1, OF_GY, OF_G1, OF_G0 };
        auto publish = [&](int which, float value) {
            if (lane == 0) downs[WARPS * which + warp] = value;
        };
        #pragma unroll
        for (int k = 0; k < 9; ++k) {
            state[ROWS * (STATE_R + k)] = R[k];
            state[ROWS * (STATE_V + k)] = V[k];
        }
        #pragma unroll
        for (int k = 0; k < 3; ++k) state[ROWS * (STATE_TURN + k)] = sums[k];
        publish(OF_Z, down_z);

// With g the gradient of the result, B = R^T grad_P and grad_Y = sym(B). The rotation contributes R skew(V kappa) to
// grad_F, kappa_i = m_i / (sigma_j + sigma_k), m = Vh axial(B X). M - M^T is skew(m) for M = Vh (B X) V.
//// vjp
        publish(OF_H0, down_h0);
        // y becomes gelu' of the second layer, x becomes h1
        size = 0.0f;
        float factor_a = down_h0 * down1;
        #pragma unroll
        for (int i = 0; i < (int)(sizeof(x) / sizeof(float)); ++i) {
            const float a = ((float*)y)[i] * factor_a, cdf = normal_cdf(a);
            ((float*)x)[i] = a * cdf;
            ((float*)y)[i] = gelu_slope(a, cdf);
            size = largest(size, a * cdf);
        }
        warp_scales(size, up, down);
        publish(OF_H1, down);
        float* rows = (float*)(pool + S0_AT + warp_rows * ROW64 * warp);
        {
            float Y[TILES][2][4];
            clear(Y);
            #pragma unroll
            for (int j = 0; j < 4; ++j) {
                unsigned b[2][4];
                fragments(x, j, up, high, low);
                stage(S1_AT, j, high, low);
                weights_T(W2_AT, W2_LOW, j, 0, b);
                multiply(Y, 0, high, low, b);
            }
            put_rows(rows, Y, OUTPUTS, down * down2);
        }
        __syncwarp();
        float down_gy;
        {
            float G[9], X[9], B[9], C[9], T[9], gy[16];
            output_of_row(rows + ROW_STRIDE * warp_row, X);
            #pragma unroll
            for (int k = 0; k < 9; ++k) {
                R[k] = state[ROWS * (STATE_R + k)];
                V[k] = state[ROWS * (STATE_V + k)];
                f[k] = ((const float*)F)[9 * (size_t)row + k];
                G[k] = used ? ((const float*)grad_out)[9 * (size_t)row + k] : 0.0f;
            }
            if (ELASTIC)
                matmul(G, f, C, NN);
            else
                for (int k = 0; k < 9; ++k) C[k] = factor * G[k];
            matmul(R, C, B, TN);
            size = 0.0f;
            #pragma unroll
            for (int i = 0; i < 3; ++i)
                #pragma unroll
                for (int j = 0; j < 3; ++j) {
                    gy[3 * i + j] = 0.5f * (B[3 * i + j] + B[3 * j + i]);
                    size = largest(size, gy[3 * i + j]);
                }
            for (int k = 9; k < 16; ++k) gy[k] = 0.0f;
            warp_scales(size, up, down_gy);
            publish(OF_GY, down_gy);
            store16(GY_AT, gy, up);

            matmul(B, X, C, NN);
            const float axial[3] = {C[7] - C[5], C[2] - C[6], C[3] - C[1]};
            float turn[3] = {0.0f, 0.0f, 0.0f};
            #pragma unroll
            for (int i = 0; i < 3; ++i) {
                float sum = state[ROWS * (STATE_TURN + i)];
                if (fabsf(sum) < FLOOR) sum = sum < 0.0f ? -FLOOR : FLOOR;
                const float kappa = DIVIDE(V[3 * i] * axial[0] + V[3 * i + 1] * axial[1] + V[3 * i + 2] * axial[2], sum);
                #pragma unroll
                for (int j = 0; j < 3; ++j) turn[j] = fmaf(kappa, V[3 * i + j], turn[j]);
            }
            const float skew[9] = {0.0f, -turn[2], turn[1], turn[2], 0.0f, -turn[0], -turn[1], turn[0], 0.0f};
            matmul(R, skew, T, NN);
            if (ELASTIC) {
                matmul(R, X, B, NN);
                matmul(G, B, C, TN);
            } else
                for (int k = 0; k < 9; ++k) C[k] = G[k];
            __syncwarp();
            #pragma unroll
            for (int k = 0; k < 9; ++k) state[ROWS * (STATE_TURN + k)] = T[k] + C[k];
        }
        __syncthreads();

        // total[n] += sum over the rows of the block of G^T H; gradient and input give offsets of (row, chunk)
        auto outer = [&](auto gradient, int low_g, auto input, auto& total, int which_g, int which_h) {
            const int N = sizeof(total) / sizeof(total[0]), Q = N < 4 ? N : 4;
            // as many concurrent products as registers allow
            const int UNROLL = TILES > 1 ? 1 : N > 2 ? 2 : 4;
            clear(total);
            #pragma unroll UNROLL
            for (int w = 0; w < WARPS; ++w) {
                float c[1][N][4];
                clear(c);
                #pragma unroll
                for (int k = 0; k < TILES; ++k) {
                    unsigned a[1][4], a_low[1][4], b[Q][4];
                    const int place = gradient(
                        warp_rows * w + 16 * k + (lane & 7) + ((lane >> 4) << 3), (lane >> 3) & 1);
                    transposed(a[0], place);
                    if (!HALF) transposed(a_low[0], place + low_g);
                    #pragma unroll
                    for (int n8 = 0; n8 < N; n8 += Q) {
                        right(transposed, b, [&](int q, int part) {
                            return input(warp_rows * w + 16 * k + (lane & 15), n8 + q, part);
                        });
                        multiply(c, n8, a, a_low, b);
                    }
                }
                const float both = downs[WARPS * which_g + w] * downs[WARPS * which_h + w];
                #pragma unroll
                for (int i = 0; i < 4 * N; ++i)
                    ((float*)total)[i] = fmaf(((float*)c)[i], both, ((float*)total)[i]);
            }
        };
        auto part64 = [&](int matrix) {
            return [=](int r, int chunk, int part) { return matrix + LOW64 * part + at64(r, chunk); };
        };
        auto part16 = [&](int matrix) {
            return [=](int r, int chunk, int part) { return matrix + LOW16 * part + at16(r, chunk); };
        };
        // four warps share the 64 columns of a gradient or, for a product with 16 columns, those of the other factor
        const int slice = warp & 3;
        auto slice64 = [&](int matrix) {
            return [=](int r, int chunk) { return matrix + at64(r, 2 * slice + chunk); };
        };
        float* partial = (float*)partials + (size_t)blockIdx.x * WEIGHTS;
        const bool alone = first && fresh;
        auto add = [&](int i, float value) { partial[i] = alone ? value : partial[i] + value; };
        // Adds pairs (2k, 2k + 1) of total[n] at place(n, k) unless that is negative. Old values are loaded before the
        // product that fills the total.
        auto add_pairs = [&](auto& total, auto place, auto product) {
            const int N = sizeof(total) / sizeof(total[0]);
            float2 before[N][2];
            #pragma unroll
            for (int n8 = 0; n8 < N; ++n8)
                #pragma unroll
                for (int k = 0; k < 2; ++k) {
                    const int i = place(n8, k);
                    before[n8][k] = alone || i < 0 ? make_float2(0.0f, 0.0f) : *(const float2*)(partial + i);
                }
            product();
            #pragma unroll
            for (int n8 = 0; n8 < N; ++n8)
                #pragma unroll
                for (int k = 0; k < 2; ++k) {
                    const int i = place(n8, k);
                    const float* pair = total[n8] + 2 * k;
                    if (i >= 0)
                        *(float2*)(partial + i) = make_float2(before[n8][k].x + pair[0], before[n8][k].y + pair[1]);
                }
        };
        if (warp == slice) {
            float total[2][4];
            auto place = [&](int n8, int k) {
                const int o = g + 8 * k, i = 16 * slice + 8 * n8 + 2 * t;
                return o < OUTPUTS ? W2_START + HIDDEN * o + i : -1;
            };
            add_pairs(total, place, [&] {
                outer([&](int r, int chunk) { return GY_AT + at16(r, chunk); }, LOW16,
                      [&](int r, int chunk, int part) { return part64(S1_AT)(r, 2 * slice + chunk, part); }, total,
                      OF_GY, OF_H1);
            });
        }
        // y becomes g1, the gradient before the second gelu
        load16(GY_AT, high, low);
        size = 0.0f;
        factor_a = down_gy * down2;
        #pragma unroll
        for (int n8 = 0; n8 < 8; n8 += 4) {
            unsigned b[4][4];
            float c[TILES][4][4];
            clear(c);
            weights(W2_AT, W2_LOW, 0, n8, b);
            multiply(c, 0, high, low, b);
            #pragma unroll
            for (int m = 0; m < TILES; ++m)
                #pragma unroll
                for (int i = 0; i < 16; ++i) {
                    float& value = ((float*)y[m][n8])[i];
                    value *= ((float*)c[m])[i] * factor_a;
                    size = largest(size, value);
                }
        }
        warp_scales(size, up, down);
        publish(OF_G1, down);
        __syncthreads();
        clear(x);
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            fragments(y, j, up, high, low);
            stage(S1_AT, j, high, low);
            #pragma unroll
            for (int n8 = 0; n8 < 8; n8 += 4) {
                unsigned b[4][4];
                weights(W1_AT, W1_LOW, j, n8, b);
                multiply(x, n8, high, low, b);
            }
        }
        // recomputes the first layer, four tiles at a time; x becomes g0
        {
            const float factor_g = down * down1;
            unsigned z_high[TILES][4], z_low[TILES][4];
            load16(Z_AT, z_high, z_low);
            factor_a = down_z * down0;
            size = 0.0f;
            #pragma unroll
            for (int n8 = 0; n8 < 8; n8 += 4) {
                float c[TILES][4][4];
                clear(c);
                layer0(z_high, z_low, n8, c, 0);
                #pragma unroll
                for (int m = 0; m < TILES; ++m)
                    #pragma unroll
                    for (int i = 0; i < 16; ++i) {
                        float& a = ((float*)c[m])[i];
                        a *= factor_a;
                        const float cdf = normal_cdf(a);
                        float& value = ((float*)x[m][n8])[i];
                        value *= factor_g * gelu_slope(a, cdf);
                        size = largest(size, value);
                        a *= cdf;
                    }
                #pragma unroll
                for (int j = 0; j < 2; ++j) {
                    fragments(c, j, up_h0, high, low);
                    stage(S0_AT, n8 / 2 + j, high, low);
                }
            }
        }
        warp_scales(size, up, down);
        publish(OF_G0, down);
        __syncthreads();
        {
            const int count = 32 / WARPS, start = warp / 4 * count;
            float total[count][4];
            auto place = [&](int n8, int k) {
                return W1_START + HIDDEN * (16 * slice + g + 8 * k) + 8 * (start + n8) + 2 * t;
            };
            add_pairs(total, place, [&] {
                outer(slice64(S1_AT), LOW64,
                      [&](int r, int chunk, int part) { return part64(S0_AT)(r, start + chunk, part); }, total, OF_G1,
                      OF_H0);
            });
        }
        __syncthreads();
        {
            float gz[TILES][2][4];
            clear(gz);
            #pragma unroll
            for (int j = 0; j < 4; ++j) {
                unsigned b[2][4];
                fragments(x, j, up, high, low);
                stage(S1_AT, j, high, low);
                right(transposed, b, [&](int q, int part) {
                    return W0_AT + part * W0_LOW + at16(16 * j + (lane & 15), q);
                });
                multiply(gz, 0, high, low, b);
            }
            put_rows(rows, gz, FEATURES, down * down0);
        }
        __syncthreads();
        if (warp == slice) {
            float total[2][4];
            outer(slice64(S1_AT), LOW64, part16(Z_AT), total, OF_G0, OF_Z);
            #pragma unroll
            for (int n8 = 0; n8 < 2; ++n8)
                #pragma unroll
                for (int k = 0; k < 4; ++k) {
                    const int o = 16 * slice + g + 8 * (k >> 1), i = 8 * n8 + 2 * t + (k & 1);
                    if (i < FEATURES) add(FEATURES * o + i, total[n8][k]);
                }
        }
        if (used && lane < warp_rows) {
            const float* gz = rows + ROW_STRIDE * warp_row;
            float S[9], D[9], T[9];
            #pragma unroll
            for (int k = 0; k < 9; ++k) {
                R[k] = state[ROWS * (STATE_R + k)];
                V[k] = state[ROWS * (STATE_V + k)];
                f[k] = ((const float*)F)[9 * (size_t)row + k];
                T[k] = state[ROWS * (STATE_TURN + k)];
            }
            #pragma unroll
            for (int i = 0; i < 3; ++i)
                #pragma unroll
                for (int j = 0; j < 3; ++j) S[3 * i + j] = gz[i] * V[3 * i + j];
            matmul(V, S, D, TN);
            matmul(R, D, S, NN);
            for (int k = 0; k < 9; ++k) T[k] += S[k];
            #pragma unroll
            for (int i = 0; i < 3; ++i)
                #pragma unroll
                for (int j = 0; j < 3; ++j) D[3 * i + j] = gz[3 + 3 * i + j] + gz[3 + 3 * j + i];
            matmul(f, D, S, NN);
            #pragma unroll
            for (int i = 0; i < 3; ++i)
                #pragma unroll
                for (int j = 0; j < 3; ++j) {
                    const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
                    const float cofactor = f[3 * i1 + j1] * f[3 * i2 + j2] - f[3 * i1 + j2] * f[3 * i2 + j1];
                    ((float*)grad_F)[9 * (size_t)row + 3 * i + j] = fmaf(gz[12], cofactor, T[3 * i + j] + S[3 * i + j]);
                }
        }
    }

//// end
    #undef LANE
    #undef SQRT
    #undef RECIPROCAL
    #undef RECIPROCAL_ROOT
    #undef DIVIDE
    #undef NN
    #undef NT
    #undef TN

// Separate kernel: one block sums 32 columns of (blocks, WEIGHTS).
//// add
    __shared__ float sums[32][33];
    const int lane = threadIdx.x & 31, group = threadIdx.x >> 5;
    float sum = 0.0f;
    for (int b = group; b < blocks; b += 32)
        sum += ((const float*)partials)[(size_t)b * WEIGHTS + 32 * blockIdx.x + lane];
    sums[group][lane] = sum;
    __syncthreads();
    sum = sums[lane][group];
    for (int offset = 16; offset > 0; offset >>= 1) sum += __shfl_down_sync(0xffffffffu, sum, offset);
    const int i = 32 * blockIdx.x + group;
    float* total = i < W1_START ? (float*)total0 + i
        : i < W2_START ? (float*)total1 + i - W1_START : (float*)total2 + i - W2_START;
    if (lane == 0) *total += sum;
