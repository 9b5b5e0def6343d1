"""The neural constitutive law as one CUDA kernel forward and one backward: features, network, stress.

The twin in :mod:`neuma_lib.mechanics.neural` writes every activation to memory and launches a dozen kernels; here
only F is read and only the result written, and the backward pass computes the activations again.

A warp owns 32 rows. Each lane computes the features of one row; the matrix products run on the tensor cores, two
tiles of 16 rows at a time; each lane ends with the output of its row. The accumulators of a layer hold a row in the
order in which the next layer wants its operand, so activations stay in registers between layers.

**Precision.** Each factor is scaled by a power of two (one a weight matrix, one an activation of a warp) and split
into two halves of 11 bits, x = hi + lo; lo hi + hi lo + hi hi, accumulated in float32, keeps 22 bits. That costs half
of the same split in TF32, and the scale replaces the exponent bits that float16 lacks.

**Weight gradients** are products over rows, G^T H. The warps of a block put G and H, already split, in shared memory
and each takes a slice of the result; blocks write their sums apart, and a second kernel adds them in a fixed order.
"""

from __future__ import annotations

from functools import cache

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import warp_stream
from neuma_lib.mechanics.law import Weights
from neuma_lib.mechanics.neural_kernels import GRAM
from neuma_lib.mechanics.singular_values_kernels import SVD

ROWS = 128
"""Rows, and threads, of a block: four warps."""
BLOCKS_PER_PROCESSOR = 2
WEIGHTS = 64 * 13 + 64 * 64 + 9 * 64

# Shared memory in bytes. A matrix of halves is its high parts and then its low parts. The 128-byte rows of a matrix
# with 64 columns, and the 32-byte rows of one with 16, hold chunks of eight halves in an order that depends on the
# row, so that ldmatrix, which reads one chunk of eight rows at once, meets every bank once.
LAYOUT = {
    "W0_AT": 0,  # (64, 16)
    "W1_AT": 4096,  # (64, 64)
    "W2_AT": 20480,  # (16, 64)
    "PEAKS_AT": 24576,  # largest weights, then the scales of the activations
    "Z_AT": 24832,  # features (128, 16)
    "ROW_AT": 33024,  # forward only: output of the network, by row
    "S0_AT": 33024,  # backward only: h0 (128, 64); before it, the output of the network and its gradient
    "GY_AT": 49408,  # (128, 16), in the second half of the former
    "S1_AT": 65792,  # h1, then g1, then g0 (128, 64)
    "STATE_AT": 98560,  # 27 floats a row
}
ALIGNMENT = 128
EVALUATE_BYTES = LAYOUT["ROW_AT"] + 13 * 4 * ROWS + ALIGNMENT
VJP_BYTES = LAYOUT["STATE_AT"] + 27 * 4 * ROWS + ALIGNMENT

# What the rest needs of the machine. The tests replace it by an emulation.
CUDA = r"""
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
    auto prefetch = [](const float* x) { asm volatile("prefetch.global.L1 [%0];" : : "l"(x)); };
    auto warp_max = [](unsigned x) { return __reduce_max_sync(0xffffffffu, x); };
"""

# Fragments of mma.m16n8k16, with g = lane / 4 and t = lane % 4: the accumulator c has rows g (0, 1) and g + 8 (2, 3)
# and columns 2t, 2t + 1; the left operand has the same rows and columns in a[0], a[1] and those plus 8 in a[2], a[3],
# so two accumulators side by side are one left operand.
TOOLS = r"""
    typedef float Pack;
    typedef float Real;
    const int WIDTH = 1;
    #define LANE(x, l) (x)
    #define SQRT(x) sqrtf(x)
    const int g = lane >> 2, t = lane & 3;
    auto at64 = [](int row, int chunk) { return row * 128 + ((chunk ^ (row & 7)) << 4); };
    auto at16 = [](int row, int chunk) { return row * 32 + ((chunk ^ ((row >> 2) & 1)) << 4); };

    auto split = [&](float x0, float x1, unsigned& high, unsigned& low) {
        float y0, y1;
        high = pack(x0, x1);
        unpack(high, y0, y1);
        low = pack(x0 - y0, x1 - y1);
    };
    // Powers of two that bring numbers of this exponent to [2^14, 2^15), and back.
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
    // c[m][n + q] += a[m] b[q], the small terms first
    auto multiply = [&](auto& c, int n, const auto& high, const auto& low, const auto& b) {
        const int M = sizeof(c) / sizeof(c[0]), Q = sizeof(b) / sizeof(b[0]);
        #pragma unroll
        for (int q = 0; q < Q; ++q)
            #pragma unroll
            for (int m = 0; m < M; ++m) mma(c[m][n + q], low[m], b[q]);
        #pragma unroll
        for (int q = 0; q < Q; ++q)
            #pragma unroll
            for (int m = 0; m < M; ++m) mma(c[m][n + q], high[m], b[q] + 2);
        #pragma unroll
        for (int q = 0; q < Q; ++q)
            #pragma unroll
            for (int m = 0; m < M; ++m) mma(c[m][n + q], high[m], b[q]);
    };
    // Left operand of columns 16 j to 16 j + 15 from accumulators x
    auto fragments = [&](const auto& x, int j, float up, auto& high, auto& low) {
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int k = 0; k < 4; ++k) {
                const float* c = x[m][2 * j + (k >> 1)] + 2 * (k & 1);
                split(c[0] * up, c[1] * up, high[m][k], low[m][k]);
            }
    };
    // Rows of this warp of a matrix with 16 columns, as left operand
    auto load16 = [&](int matrix, auto& high, auto& low) {
        #pragma unroll
        for (int m = 0; m < 2; ++m) {
            const int place = matrix + at16(32 * warp + 16 * m + (lane & 15), lane >> 4);
            matrices(high[m], place);
            matrices(low[m], place + 4096);
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
            char* place = pool + matrix + at16(thread, chunk);
            *(uint4*)place = make_uint4(high[0], high[1], high[2], high[3]);
            *(uint4*)(place + 4096) = make_uint4(low[0], low[1], low[2], low[3]);
        }
    };
    // Columns 16 j to 16 j + 15 of this warp's rows of a matrix with 64 columns
    auto stage = [&](int matrix, int j, const auto& high, const auto& low) {
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int k = 0; k < 4; ++k) {
                const int row = 32 * warp + 16 * m + g + 8 * (k & 1);
                char* place = pool + matrix + at64(row, 2 * j + (k >> 1)) + 4 * t;
                *(unsigned*)place = high[m][k];
                *(unsigned*)(place + 16384) = low[m][k];
            }
    };
    // Right operands: four tiles of 8 columns from tile n, rows 16 k to 16 k + 15; of W^T and of W
    auto weights_T = [&](int matrix, int part, int k, int n, auto& b) {
        #pragma unroll
        for (int q = 0; q < (int)(sizeof(b) / sizeof(b[0])); ++q)
            matrices(b[q], matrix + (lane >> 4) * part + at64(8 * (n + q) + (lane & 7), 2 * k + ((lane >> 3) & 1)));
    };
    auto weights = [&](int matrix, int part, int k, int n, auto& b) {
        #pragma unroll
        for (int q = 0; q < (int)(sizeof(b) / sizeof(b[0])); ++q)
            transposed(b[q], matrix + (lane >> 4) * part + at64(16 * k + (lane & 15), n + q));
    };
    auto layer0 = [&](const auto& high, const auto& low, int n, auto& c, int to) {
        unsigned b[sizeof(c[0]) / sizeof(c[0][0]) < 4 ? 2 : 4][4];
        #pragma unroll
        for (int q = 0; q < (int)(sizeof(b) / sizeof(b[0])); ++q)
            matrices(b[q], W0_AT + (lane >> 4) * 2048 + at16(8 * (n + q) + (lane & 7), (lane >> 3) & 1));
        multiply(c, to, high, low, b);
    };
    // Standard normal distribution function: 2^q(|x|) is its tail, to 5e-8
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
    // X = sym(Y), Y (9) in the lane's row of what the warp put down
    auto output_of_row = [&](const float* y, float* X) {
        #pragma unroll
        for (int i = 0; i < 3; ++i)
            #pragma unroll
            for (int j = 0; j < 3; ++j) X[3 * i + j] = 0.5f * (y[3 * i + j] + y[3 * j + i]);
    };
    auto put_rows = [&](float* rows, const auto& c, int columns, float factor) {
        #pragma unroll
        for (int m = 0; m < 2; ++m)
            #pragma unroll
            for (int n = 0; n < 2; ++n)
                #pragma unroll
                for (int k = 0; k < 4; ++k) {
                    const int column = 8 * n + 2 * t + (k & 1);
                    if (column < columns) rows[13 * (16 * m + g + 8 * (k >> 1)) + column] = c[m][n][k] * factor;
                }
    };
    // c = a b, with either transposed
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
"""

# Opens the loop over tiles of 128 rows, up to the features and, the first time, the weights in shared memory.
FEATURES = r"""
    for (int tile = blockIdx.x; tile * 128 < n; tile += gridDim.x) {
        __syncthreads();
        const bool first = tile == (int)blockIdx.x;
        // rows past the end repeat the last one, and have no gradient and no result
        const bool used = tile * 128 + thread < n;
        const int row = used ? tile * 128 + thread : n - 1;
        float f[9], R[9], V[9], z[16], sums[3];
        #pragma unroll
        for (int k = 0; k < 9; ++k) f[k] = ((const float*)F)[9 * (size_t)row + k];
        {PREFETCH}
        float w0[7], w1[32], w2[8];
        if (first) {
            #pragma unroll
            for (int k = 0; k < 7; ++k) {
                const int i = thread + 128 * k;
                w0[k] = i < 832 ? ((const float*)W0)[i] : 0.0f;
            }
            #pragma unroll
            for (int k = 0; k < 16; ++k) {
                const float2 pair = ((const float2*)W1)[thread + 128 * k];
                w1[2 * k] = pair.x;
                w1[2 * k + 1] = pair.y;
            }
            #pragma unroll
            for (int k = 0; k < 4; ++k) {
                const int i = thread + 128 * k;
                const float2 pair = i < 288 ? ((const float2*)W2)[i] : make_float2(0.0f, 0.0f);
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
            for (int k = 0; k < 13; ++k) size = largest(size, z[k]);
            warp_scales(size, up, down_z);
            store16(Z_AT, z, up);
        }
        if (first) {
            float size0 = 0.0f, size1 = 0.0f, size2 = 0.0f;
            #pragma unroll
            for (int k = 0; k < 7; ++k) size0 = largest(size0, w0[k]);
            #pragma unroll
            for (int k = 0; k < 32; ++k) size1 = largest(size1, w1[k]);
            #pragma unroll
            for (int k = 0; k < 8; ++k) size2 = largest(size2, w2[k]);
            unsigned* peaks = (unsigned*)(pool + PEAKS_AT);
            const unsigned peak0 = warp_max(__float_as_uint(size0)), peak1 = warp_max(__float_as_uint(size1)),
                           peak2 = warp_max(__float_as_uint(size2));
            if (lane == 0) {
                peaks[warp] = peak0;
                peaks[4 + warp] = peak1;
                peaks[8 + warp] = peak2;
            }
            __syncthreads();
            auto peak = [&](int k) {
                return max(max(peaks[k], peaks[k + 1]), max(peaks[k + 2], peaks[k + 3]));
            };
            float up0, up1, up2;
            scales(peak(0), up0, down0);
            scales(peak(4), up1, down1);
            scales(peak(8), up2, down2);
            auto put_half = [&](int o, int i, float x) {
                unsigned high, low;
                split(x, 0.0f, high, low);
                char* place = pool + W0_AT + at16(o, i >> 3) + 2 * (i & 7);
                *(unsigned short*)place = (unsigned short)high;
                *(unsigned short*)(place + 2048) = (unsigned short)low;
            };
            #pragma unroll
            for (int k = 0; k < 7; ++k) {
                const int i = thread + 128 * k;
                if (i < 832) put_half(i / 13, i % 13, w0[k] * up0);
            }
            if (thread < 64)
                for (int i = 13; i < 16; ++i) put_half(thread, i, 0.0f);
            auto put_pair = [&](int matrix, int part, int pair, float x0, float x1) {
                unsigned high, low;
                split(x0, x1, high, low);
                char* place = pool + matrix + at64(pair >> 5, (pair & 31) >> 2) + 4 * (pair & 3);
                *(unsigned*)place = high;
                *(unsigned*)(place + part) = low;
            };
            #pragma unroll
            for (int k = 0; k < 16; ++k) put_pair(W1_AT, 8192, thread + 128 * k, w1[2 * k] * up1, w1[2 * k + 1] * up1);
            #pragma unroll
            for (int k = 0; k < 4; ++k) put_pair(W2_AT, 2048, thread + 128 * k, w2[2 * k] * up2, w2[2 * k + 1] * up2);
            __syncthreads();
        }
        __syncwarp();
"""

# Both kernels: the first two products, with h0 in x and what the second layer is before its gelu, unscaled, in y.
LAYERS = r"""
        unsigned high[2][4], low[2][4];
        float x[2][8][4], y[2][8][4], up_h0, down_h0, down;
        clear(x);
        load16(Z_AT, high, low);
        layer0(high, low, 0, x, 0);
        layer0(high, low, 4, x, 4);
        auto activate = [&](auto& c, float factor) {
            float magnitude = 0.0f;
            #pragma unroll
            for (int i = 0; i < 64; ++i) {
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
                weights_T(W1_AT, 8192, j, n8, b);
                multiply(y, n8, high, low, b);
            }
        }
"""

EVALUATE = r"""
        size = activate(y, down_h0 * down1);
        warp_scales(size, up, down);
        float Y[2][2][4];
        clear(Y);
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            unsigned b[2][4];
            fragments(y, j, up, high, low);
            weights_T(W2_AT, 2048, j, 0, b);
            multiply(Y, 0, high, low, b);
        }
        float* rows = (float*)(pool + ROW_AT + 1664 * warp);
        put_rows(rows, Y, 9, down * down2);
        __syncwarp();
        float X[9], P[9], result[9];
        output_of_row(rows + 13 * lane, X);
        matmul(R, X, P, NN);
        if (ELASTIC)
            matmul(P, f, result, NT);
        else
            for (int k = 0; k < 9; ++k) result[k] = fmaf(factor, P[k], f[k]);
        if (used)
            for (int k = 0; k < 9; ++k) ((float*)out)[9 * (size_t)row + k] = result[k];
    }
"""

# Backward only: what the end needs again is put down, and registers are free for the layers.
PUT_DOWN = r"""
        float* state = (float*)(pool + STATE_AT) + thread;
        float* downs = (float*)(pool + PEAKS_AT) + 16;
        auto publish = [&](int which, float value) {
            if (lane == 0) downs[4 * which + warp] = value;
        };
        #pragma unroll
        for (int k = 0; k < 9; ++k) {
            state[128 * k] = R[k];
            state[128 * (9 + k)] = V[k];
        }
        #pragma unroll
        for (int k = 0; k < 3; ++k) state[128 * (18 + k)] = sums[k];
        publish(0, down_z);
"""

# With g the gradient of the result, B = R^T grad_P and grad_Y = sym(B). The rotation returns to F by
# R skew(V kappa), kappa_i = m_i / (sigma_j + sigma_k), m = Vh axial(B X); see ``input_adjoint`` of the twin, whose
# M - M^T is skew(m).
VJP = r"""
        publish(1, down_h0);
        // y turns from the second layer into gelu' there, x into h1
        size = 0.0f;
        float factor_a = down_h0 * down1;
        #pragma unroll
        for (int i = 0; i < 64; ++i) {
            const float a = ((float*)y)[i] * factor_a, cdf = normal_cdf(a);
            ((float*)x)[i] = a * cdf;
            ((float*)y)[i] = gelu_slope(a, cdf);
            size = largest(size, a * cdf);
        }
        warp_scales(size, up, down);
        publish(2, down);
        float* rows = (float*)(pool + S0_AT + 4096 * warp);
        {
            float Y[2][2][4];
            clear(Y);
            #pragma unroll
            for (int j = 0; j < 4; ++j) {
                unsigned b[2][4];
                fragments(x, j, up, high, low);
                stage(S1_AT, j, high, low);
                weights_T(W2_AT, 2048, j, 0, b);
                multiply(Y, 0, high, low, b);
            }
            put_rows(rows, Y, 9, down * down2);
        }
        __syncwarp();
        float down_gy;
        {
            float G[9], X[9], B[9], C[9], T[9], gy[16];
            output_of_row(rows + 13 * lane, X);
            #pragma unroll
            for (int k = 0; k < 9; ++k) {
                R[k] = state[128 * k];
                V[k] = state[128 * (9 + k)];
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
            publish(3, down_gy);
            store16(GY_AT, gy, up);

            matmul(B, X, C, NN);
            const float axial[3] = {C[7] - C[5], C[2] - C[6], C[3] - C[1]};
            float turn[3] = {0.0f, 0.0f, 0.0f};
            #pragma unroll
            for (int i = 0; i < 3; ++i) {
                float sum = state[128 * (18 + i)];
                if (fabsf(sum) < FLOOR) sum = sum < 0.0f ? -FLOOR : FLOOR;
                const float kappa = (V[3 * i] * axial[0] + V[3 * i + 1] * axial[1] + V[3 * i + 2] * axial[2]) / sum;
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
            #pragma unroll
            for (int k = 0; k < 9; ++k) state[128 * (18 + k)] = T[k] + C[k];
        }
        __syncthreads();

        // total[n] += sum over the block's rows of G^T H; gradient and input give places of (row, chunk)
        auto outer = [&](auto gradient, int low_g, auto input, auto& total, int which_g, int which_h) {
            const int N = sizeof(total) / sizeof(total[0]), Q = N < 4 ? N : 4;
            clear(total);
            #pragma unroll 1
            for (int w = 0; w < 4; ++w) {
                float c[1][N][4];
                clear(c);
                #pragma unroll
                for (int k = 0; k < 2; ++k) {
                    unsigned a[1][4], a_low[1][4], b[Q][4];
                    const int place = gradient(
                        32 * w + 16 * k + (lane & 7) + ((lane >> 4) << 3), (lane >> 3) & 1);
                    transposed(a[0], place);
                    transposed(a_low[0], place + low_g);
                    #pragma unroll
                    for (int n8 = 0; n8 < N; n8 += Q) {
                        #pragma unroll
                        for (int q = 0; q < Q; ++q)
                            transposed(b[q], input(32 * w + 16 * k + (lane & 15), n8 + q, lane >> 4));
                        multiply(c, n8, a, a_low, b);
                    }
                }
                const float both = downs[4 * which_g + w] * downs[4 * which_h + w];
                #pragma unroll
                for (int i = 0; i < 4 * N; ++i)
                    ((float*)total)[i] = fmaf(((float*)c)[i], both, ((float*)total)[i]);
            }
        };
        auto part64 = [&](int matrix) {
            return [=](int r, int chunk, int part) { return matrix + 16384 * part + at64(r, chunk); };
        };
        auto part16 = [&](int matrix) {
            return [=](int r, int chunk, int part) { return matrix + 4096 * part + at16(r, chunk); };
        };
        auto slice64 = [&](int matrix) {
            return [=](int r, int chunk) { return matrix + at64(r, 2 * warp + chunk); };
        };
        float* partial = (float*)partials + (size_t)blockIdx.x * WEIGHTS;
        auto add = [&](int i, float value) { partial[i] = first ? value : partial[i] + value; };
        auto add_pair = [&](int i, const float* values) {
            float2* place = (float2*)(partial + i);
            const float2 before = first ? make_float2(0.0f, 0.0f) : *place;
            *place = make_float2(before.x + values[0], before.y + values[1]);
        };
        {
            float total[2][4];
            outer([&](int r, int chunk) { return GY_AT + at16(r, chunk); }, 4096,
                  [&](int r, int chunk, int part) { return part64(S1_AT)(r, 2 * warp + chunk, part); }, total, 3, 2);
            #pragma unroll
            for (int n8 = 0; n8 < 2; ++n8)
                #pragma unroll
                for (int k = 0; k < 4; k += 2) {
                    const int o = g + 4 * k, i = 16 * warp + 8 * n8 + 2 * t;
                    if (o < 9) add_pair(4928 + 64 * o + i, total[n8] + k);
                }
        }
        // y turns into g1, the gradient before the second gelu
        load16(GY_AT, high, low);
        size = 0.0f;
        factor_a = down_gy * down2;
        #pragma unroll
        for (int n8 = 0; n8 < 8; n8 += 4) {
            unsigned b[4][4];
            float c[2][4][4];
            clear(c);
            weights(W2_AT, 2048, 0, n8, b);
            multiply(c, 0, high, low, b);
            #pragma unroll
            for (int m = 0; m < 2; ++m)
                #pragma unroll
                for (int i = 0; i < 16; ++i) {
                    float& value = ((float*)y[m][n8])[i];
                    value *= ((float*)c[m])[i] * factor_a;
                    size = largest(size, value);
                }
        }
        warp_scales(size, up, down);
        publish(4, down);
        __syncthreads();
        clear(x);
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            fragments(y, j, up, high, low);
            stage(S1_AT, j, high, low);
            #pragma unroll
            for (int n8 = 0; n8 < 8; n8 += 4) {
                unsigned b[4][4];
                weights(W1_AT, 8192, j, n8, b);
                multiply(x, n8, high, low, b);
            }
        }
        // the first layer once more, four tiles at a time; x turns into g0
        {
            const float factor_g = down * down1;
            unsigned z_high[2][4], z_low[2][4];
            load16(Z_AT, z_high, z_low);
            factor_a = down_z * down0;
            size = 0.0f;
            #pragma unroll
            for (int n8 = 0; n8 < 8; n8 += 4) {
                float c[2][4][4];
                clear(c);
                layer0(z_high, z_low, n8, c, 0);
                #pragma unroll
                for (int m = 0; m < 2; ++m)
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
        publish(5, down);
        __syncthreads();
        {
            float total[8][4];
            outer(slice64(S1_AT), 16384, part64(S0_AT), total, 4, 1);
            #pragma unroll
            for (int n8 = 0; n8 < 8; ++n8)
                #pragma unroll
                for (int k = 0; k < 4; k += 2)
                    add_pair(832 + 64 * (16 * warp + g + 4 * k) + 8 * n8 + 2 * t, total[n8] + k);
        }
        __syncthreads();
        {
            float gz[2][2][4];
            clear(gz);
            #pragma unroll
            for (int j = 0; j < 4; ++j) {
                unsigned b[2][4];
                fragments(x, j, up, high, low);
                stage(S1_AT, j, high, low);
                #pragma unroll
                for (int q = 0; q < 2; ++q)
                    transposed(b[q], W0_AT + (lane >> 4) * 2048 + at16(16 * j + (lane & 15), q));
                multiply(gz, 0, high, low, b);
            }
            put_rows(rows, gz, 13, down * down0);
        }
        __syncthreads();
        {
            float total[2][4];
            outer(slice64(S1_AT), 16384, part16(Z_AT), total, 5, 0);
            #pragma unroll
            for (int n8 = 0; n8 < 2; ++n8)
                #pragma unroll
                for (int k = 0; k < 4; ++k) {
                    const int o = 16 * warp + g + 8 * (k >> 1), i = 8 * n8 + 2 * t + (k & 1);
                    if (i < 13) add(13 * o + i, total[n8][k]);
                }
        }
        if (used) {
            const float* gz = rows + 13 * lane;
            float S[9], D[9], T[9];
            #pragma unroll
            for (int k = 0; k < 9; ++k) {
                R[k] = state[128 * k];
                V[k] = state[128 * (9 + k)];
                f[k] = ((const float*)F)[9 * (size_t)row + k];
                T[k] = state[128 * (18 + k)];
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
"""

END = r"""
    #undef LANE
    #undef SQRT
    #undef NN
    #undef NT
    #undef TN
"""

# One block sums 32 columns of (blocks, WEIGHTS).
ADD = r"""
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
    float* total = i < 832 ? (float*)total0 + i : i < 4928 ? (float*)total1 + i - 832 : (float*)total2 + i - 4928;
    if (lane == 0) *total += sum;
"""


def source(kind: str, backward: bool, machine: str = CUDA) -> str:
    """C++ text of the body of a kernel for ``kind`` "elasticity" or "plasticity"."""
    floor = torch.finfo(torch.float32).eps ** 0.5
    values = {**LAYOUT, "WEIGHTS": WEIGHTS, "SWEEPS": 3}
    constants = "".join(f"    const int {name} = {value};\n" for name, value in values.items())
    constants += f"    const bool ELASTIC = {str(kind == 'elasticity').lower()};\n    const float FLOOR = {floor!r}f;\n"
    prefetch = "prefetch((const float*)grad_out + 9 * (size_t)row);" if backward else ""
    features = FEATURES.replace("{GRAM}", GRAM).replace("{SVD}", SVD).replace("{PREFETCH}", prefetch)
    body = PUT_DOWN + LAYERS + VJP if backward else LAYERS + EVALUATE
    return constants + machine + TOOLS + features + body + END


# Arrays are handed over as addresses: Warp's array objects would cost more time than the launch.
@cache
def evaluate_kernel(kind: str):
    """Kernel (F, W0, W1, W2, factor, n, out) over blocks of :data:`ROWS` threads."""

    @wp.func_native(source(kind, backward=False))
    def evaluate_rows(
        F: wp.uint64,
        W0: wp.uint64,
        W1: wp.uint64,
        W2: wp.uint64,
        factor: float,
        n: int,
        out: wp.uint64,
        shared: wp.tile(dtype=wp.uint8, shape=(EVALUATE_BYTES,)),
    ): ...

    @wp.kernel(
        enable_backward=False, module="unique", launch_bounds=(ROWS, BLOCKS_PER_PROCESSOR), grid_stride=False
    )
    def neural_evaluate(
        F: wp.uint64, W0: wp.uint64, W1: wp.uint64, W2: wp.uint64, factor: float, n: int, out: wp.uint64
    ):
        shared = wp.tile_empty(shape=(EVALUATE_BYTES,), dtype=wp.uint8, storage="shared")
        evaluate_rows(F, W0, W1, W2, factor, n, out, shared)

    return neural_evaluate


@cache
def vjp_kernel(kind: str):
    """Kernel (F, W0, W1, W2, grad_out, factor, n, grad_F, partials (blocks, WEIGHTS)) over blocks as above."""

    @wp.func_native(source(kind, backward=True))
    def vjp_rows(
        F: wp.uint64,
        W0: wp.uint64,
        W1: wp.uint64,
        W2: wp.uint64,
        grad_out: wp.uint64,
        factor: float,
        n: int,
        grad_F: wp.uint64,
        partials: wp.uint64,
        shared: wp.tile(dtype=wp.uint8, shape=(VJP_BYTES,)),
    ): ...

    @wp.kernel(
        enable_backward=False, module="unique", launch_bounds=(ROWS, BLOCKS_PER_PROCESSOR), grid_stride=False
    )
    def neural_vjp(
        F: wp.uint64,
        W0: wp.uint64,
        W1: wp.uint64,
        W2: wp.uint64,
        grad_out: wp.uint64,
        factor: float,
        n: int,
        grad_F: wp.uint64,
        partials: wp.uint64,
    ):
        shared = wp.tile_empty(shape=(VJP_BYTES,), dtype=wp.uint8, storage="shared")
        vjp_rows(F, W0, W1, W2, grad_out, factor, n, grad_F, partials, shared)

    return neural_vjp


@cache
def add_kernel():
    """Kernel (partials (blocks, WEIGHTS), blocks, three accumulators) that adds sums over the blocks."""

    @wp.func_native(ADD.replace("WEIGHTS", str(WEIGHTS)))
    def add_columns(
        partials: wp.uint64, blocks: int, total0: wp.uint64, total1: wp.uint64, total2: wp.uint64
    ): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def neural_add(partials: wp.uint64, blocks: int, total0: wp.uint64, total1: wp.uint64, total2: wp.uint64):
        add_columns(partials, blocks, total0, total1, total2)

    return neural_add


@cache
def _device(device: torch.device) -> wp.Device:
    return wp.device_from_torch(device)


@cache
def supported(device: torch.device, dtype: torch.dtype) -> bool:
    """Whether these kernels run there: float32 on a GPU with float16 tensor cores and enough shared memory."""
    if device.type != "cuda" or dtype != torch.float32:
        return False
    there = _device(device)
    return there.arch >= 80 and there.max_shared_memory_per_block >= VJP_BYTES + 4 * ROWS


def _launch(kernel, blocks: int, threads: int, device: torch.device, *inputs) -> None:
    inputs = [x.data_ptr() if isinstance(x, Tensor) else x for x in inputs]
    wp.launch(
        kernel,
        dim=blocks * threads,
        inputs=inputs,
        block_dim=threads,
        device=_device(device),
        stream=warp_stream(device),
    )


def _blocks(rows: int, device: torch.device) -> int:
    return min(-(-rows // ROWS), BLOCKS_PER_PROCESSOR * _device(device).sm_count)


def _packed(weights: Weights) -> list[Tensor]:
    """Weights as the kernels read them: no gaps, and pairs of numbers at multiples of 8 bytes."""
    weights = [w.detach().contiguous() for w in weights]
    return [w.clone() if w.data_ptr() % 8 else w for w in weights]


@torch.no_grad()
def evaluate(F: Tensor, weights: Weights, kind: str, factor: float, out: Tensor | None = None) -> Tensor:
    """The law of ``kind`` at F (n, 3, 3); plasticity is F + factor R X. See :class:`Constitutive`."""
    F = F.detach().contiguous()
    result = out if out is not None and out.is_contiguous() else torch.empty_like(F)
    if len(F):
        W, blocks = _packed(weights), _blocks(len(F), F.device)
        _launch(evaluate_kernel(kind), blocks, ROWS, F.device, F, *W, factor, len(F), result)
    return result if out is None or out is result else out.copy_(result)


@torch.no_grad()
def vjp(
    F: Tensor,
    weights: Weights,
    grad_out: Tensor,
    kind: str,
    factor: float,
    grad_F: Tensor | None = None,
    grad_weights: Weights | None = None,
) -> tuple[Tensor, Weights]:
    """Gradients of F and, added to ``grad_weights``, of the weights. See :class:`Constitutive`."""
    F, grad_out = F.detach().contiguous(), grad_out.contiguous()
    result = grad_F if grad_F is not None and grad_F.is_contiguous() else torch.empty_like(F)
    W = _packed(weights)
    totals = tuple(torch.zeros_like(w) for w in W) if grad_weights is None else grad_weights
    if len(F):
        blocks = _blocks(len(F), F.device)
        partials = F.new_empty(blocks, WEIGHTS)
        _launch(vjp_kernel(kind), blocks, ROWS, F.device, F, *W, grad_out, factor, len(F), result, partials)
        sums = [total if total.is_contiguous() else total.contiguous() for total in totals]
        _launch(add_kernel(), WEIGHTS // 32, 1024, F.device, partials, blocks, *sums)
        for total, summed in zip(totals, sums, strict=True):
            if total is not summed:
                total.copy_(summed)
    return (result if grad_F is None or grad_F is result else grad_F.copy_(result)), totals
