// Kernels of structured_kernels.py for packs of rows, combined with the parts "types", "math" and "svd" of
// singular_values_kernels.h. Letters are those of structured.py.

// Functions of the network.
//// functions
#if defined(__CUDA_ARCH__)
    // Forces the weights to be read again, instead of keeping all of them in registers across layers and tiles.
    #define READ_AGAIN asm volatile("" : : : "memory");
#else
    #define READ_AGAIN
#endif
    const Real BEND_MAX = sizeof(Real) == 4 ? Real(1e37) : Real(1e300);
    // activation x / sqrt(1 + x^2), with r = 1 / sqrt(1 + x^2) and slope r^3
    auto bend = [&](auto& x, auto& r) {
        UNROLL for (int k = 0; k < (int)(sizeof(x) / sizeof(x[0])); ++k) {
            const Pack square = x[k] * x[k] + Real(1);
            r[k] = RECIPROCAL_ROOT(square > BEND_MAX ? zero + BEND_MAX : square);
            x[k] = x[k] * r[k];
        }
    };
    // y = W (x, bias)
    auto layer = [&](const Real* W, const auto& x, auto& y, Real bias) {
        const int N = sizeof(x) / sizeof(x[0]), M = sizeof(y) / sizeof(y[0]), PART = M < 8 ? M : 8;
        UNROLL for (int start = 0; start < M; start += PART) {
            READ_AGAIN
            Pack sum[PART];
            UNROLL for (int o = 0; o < PART; ++o) sum[o] = zero + bias * W[(start + o) * (N + 1) + N];
            UNROLL for (int i = 0; i < N; ++i)
                UNROLL for (int o = 0; o < PART; ++o) sum[o] = sum[o] + x[i] * W[(start + o) * (N + 1) + i];
            UNROLL for (int o = 0; o < PART; ++o) y[start + o] = sum[o];
        }
    };
    // x = W^T y without the bias
    auto layer_back = [](const Real* W, const auto& y, auto& x) {
        const int N = sizeof(x) / sizeof(x[0]), M = sizeof(y) / sizeof(y[0]), PART = N < 8 ? N : 8;
        UNROLL for (int start = 0; start < N; start += PART) {
            READ_AGAIN
            Pack sum[PART];
            UNROLL for (int i = 0; i < PART; ++i) sum[i] = y[0] * W[start + i];
            UNROLL for (int o = 1; o < M; ++o)
                UNROLL for (int i = 0; i < PART; ++i) sum[i] = sum[i] + y[o] * W[o * (N + 1) + start + i];
            UNROLL for (int i = 0; i < PART; ++i) x[start + i] = sum[i];
        }
    };

// Loop over rows: packs on a CPU, tiles of one row per thread on a GPU, where rows past the end repeat the last row
// without gradient and result.
//// rows
#if defined(__CUDA_ARCH__)
    const int thread = threadIdx.x;
    __shared__ Real W[WEIGHTS];
    for (int i = thread; i < WEIGHTS; i += THREADS)
#else
    Real W[WEIGHTS];
    for (int i = 0; i < WEIGHTS; ++i)
#endif
        W[i] = i < W1_START ? ((const Real*)W0)[i]
            : i < W2_START ? ((const Real*)W1)[i - W1_START] : ((const Real*)W2)[i - W2_START];
    const Real* const w0 = W;
    const Real* const w1 = W + W1_START;
    const Real* const w2 = W + W2_START;
#if defined(__CUDA_ARCH__)
    __syncthreads();
    for (int tile = blockIdx.x; tile * THREADS < n; tile += gridDim.x) {
        const int row = tile * THREADS + thread, used = row < n ? 1 : 0, first = used ? row : n - 1;
#else
    for (int first = 0; first < n; first += WIDTH) {
        const int used = n - first < WIDTH ? n - first : WIDTH;
#endif

// u[k], v[k] and s[k]. They are written to the cache if `cached` is 1 and read from it if it is 2. If it is 3, s[k] are the
// stretches after the return map that has written them, because it keeps u and v.
//// decompose
        Pack u[3][3], v[3][3], s[3];
        auto kept = [&](int k) -> Pack& {
            const int place = first / CACHED_WIDTH;
            return *(Pack*)((Real*)cache + (CACHED * place + k) * (size_t)CACHED_WIDTH + first % CACHED_WIDTH);
        };
        if (cached && first % CACHED_WIDTH == 0)
            Matrices::prefetch((Real*)cache + CACHED * (size_t)(first / CACHED_WIDTH + 1) * CACHED_WIDTH, CACHED * CACHED_WIDTH);
        if (cached > 1) {
            for (int k = 0; k < 3; ++k) {
                for (int i = 0; i < 3; ++i) {
                    u[k][i] = kept(3 * k + i);
                    v[k][i] = kept(9 + 3 * k + i);
                }
                s[k] = kept((cached == 2 ? 18 : 21) + k);
            }
        } else {
            Pack* const singular = s;
            Pack a[9];
            Matrices::load((const Real*)F + 9 * (size_t)first, used, a);
            {SVD}
            for (int k = 0; k < 3; ++k) {
                u[0][k] = u0[k];
                u[1][k] = u1[k];
                u[2][k] = u2[k];
                v[0][k] = v0[k];
                v[1][k] = v1[k];
                v[2][k] = v2[k];
                singular[k] = s[k];
            }
        }
        if (cached == 1)
            for (int k = 0; k < 3; ++k) {
                for (int i = 0; i < 3; ++i) {
                    kept(3 * k + i) = u[k][i];
                    kept(9 + 3 * k + i) = v[k][i];
                }
                kept(18 + k) = s[k];
            }

// Logarithmic strains e of c = max(s, STRETCH_MIN), rate = d e / d s, invariants z and network.
//// network
        Pack c[3], e[3], rate[3], dev[3];
        for (int k = 0; k < 3; ++k) {
            const auto inside = s[k] >= STRETCH_MIN;
            c[k] = inside ? s[k] : zero + STRETCH_MIN;
            e[k] = logarithm(c[k]);
            rate[k] = inside ? RECIPROCAL(c[k]) : zero;
        }
        const bool crushed = any(s[2] < STRETCH_MIN);
        const Pack trace = e[0] + e[1] + e[2];
        for (int k = 0; k < 3; ++k) dev[k] = e[k] - trace * THIRD_PART;
        const Pack square = dot(dev, dev), rounded = square + SMOOTH * SMOOTH, inverse_root = RECIPROCAL_ROOT(rounded);
        const Pack det = dev[0] * dev[1] * dev[2];
        const Pack root = rounded * inverse_root, inverse = inverse_root * inverse_root;
        Pack x[3] = {trace, DIVIDE(square, root + SMOOTH), LODE * det * inverse};
        for (int k = 0; k < 3; ++k) x[k] = x[k] * (Real(1) / STRAIN);
        Pack h0[HIDDEN], r0[HIDDEN], h1[HIDDEN], r1[HIDDEN], change[OUTPUTS], r2[OUTPUTS];
        layer(w0, x, h0, Real(1));
        bend(h0, r0);
        layer(w1, h0, h1, Real(1));
        bend(h1, r1);
        layer(w2, h1, change, Real(1));
        for (int k = 0; k < OUTPUTS; ++k) change[k] = change[k] * (Real(1) / LIMIT);
        bend(change, r2);
        for (int k = 0; k < OUTPUTS; ++k) change[k] = change[k] * LIMIT;
        // d (size, Lode part) / d e
        Pack cofactor[3], along[3], across[3];
        for (int k = 0; k < 3; ++k) {
            cofactor[k] = dev[(k + 1) % 3] * dev[(k + 2) % 3] + square * (Real(1) / Real(6));
            along[k] = dev[k] * inverse_root;
            across[k] = LODE * inverse * (cofactor[k] - Real(2) * det * inverse * dev[k]);
        }

// Divided differences of max(s, STRETCH_MIN) and of its logarithm over the pairs.
//// pairs
        Pack clamped[3], log_quotient[3];
        log_pairs(s, c, e, crushed, clamped, log_quotient);

// Principal stresses y of the form "stretch", with slope = d shear / d s and twist = d shear / d shift.
//// stretch
        Pack mean, mean_slope[3];
        if (kind == HENCKY) {
            const Real bulk = lam + Real(2) * mu * THIRD_PART;
            mean = bulk * trace;
            for (int k = 0; k < 3; ++k) mean_slope[k] = bulk * rate[k];
        } else {
            const Pack minors[3] = {s[1] * s[2], s[0] * s[2], s[0] * s[1]};
            const Pack J = s[0] * minors[0];
            if (kind == FIXED_COROTATED) {
                const Pack total = (s[0] - Real(1)) * s[0] + (s[1] - Real(1)) * s[1] + (s[2] - Real(1)) * s[2];
                mean = Real(2) * mu * THIRD_PART * total + lam * J * (J - Real(1));
                for (int k = 0; k < 3; ++k)
                    mean_slope[k] = Real(2) * mu * THIRD_PART * (Real(2) * s[k] - Real(1))
                        + lam * (Real(2) * J - Real(1)) * minors[k];
            } else {
                const auto inside = J >= STRETCH_MIN * STRETCH_MIN * STRETCH_MIN;
                const Pack bounded = inside ? J : zero + STRETCH_MIN * STRETCH_MIN * STRETCH_MIN;
                Pack total = zero;
                for (int k = 0; k < 3; ++k) total = total + (s[k] - Real(1)) * (s[k] + Real(1));
                mean = mu * THIRD_PART * total + lam * logarithm(bounded);
                for (int k = 0; k < 3; ++k)
                    mean_slope[k] = Real(2) * mu * THIRD_PART * s[k] + (inside ? DIVIDE(lam * minors[k], bounded) : zero);
            }
        }
        const Pack factor = exponential(change[0]), modulus = Real(2) * mu * exponential(change[1]);
        const Pack growth = exponential(change[2]), inverse_growth = RECIPROCAL(growth + Real(3));
        const Pack shift = Real(3) * (growth - Real(1)) * inverse_growth;
        Pack shear[3] = {zero, zero, zero}, slope[3] = {zero, zero, zero}, twist[3] = {zero, zero, zero};
        Pack quotient[3] = {zero, zero, zero};
        for (int term = 0; term < (kind == FIXED_COROTATED ? 2 : 1); ++term) {
            const Real power = kind == HENCKY ? Real(0) : term == 0 ? Real(2) : Real(1);
            const Real weight = kind != FIXED_COROTATED ? Real(1) : term == 0 ? Real(2) : Real(-1);
            Pack h[3], X[3];
            for (int k = 0; k < 3; ++k) {
                Pack value, derivative;
                h[k] = Real(0.5) * (shift + power) * e[k];
                X[k] = exponential(h[k]);
                sinhc(h[k], X[k], value, derivative);
                shear[k] = shear[k] + weight * e[k] * X[k] * value;
                slope[k] = slope[k] + weight * X[k] * X[k] * rate[k];
                twist[k] = twist[k] + Real(0.5) * weight * e[k] * e[k] * X[k] * (value + derivative);
            }
            for (int pair = 0; pair < 3; ++pair) {
                const int i = FIRST[pair], j = SECOND[pair];
                Pack value, derivative;
                sinhc(h[i] - h[j], DIVIDE(X[i], X[j]), value, derivative);
                quotient[pair] = quotient[pair] + weight * X[i] * X[j] * value * log_quotient[pair];
            }
            if (crushed && power > Real(0)) {
                const bool linear = power == Real(1);
                for (int k = 0; k < 3; ++k) {
                    const Pack below = s[k] >= STRETCH_MIN ? zero : one;
                    shear[k] = shear[k] + weight * (s[k] - c[k]) * (linear ? one : Real(0.5) * (s[k] + c[k]));
                    slope[k] = slope[k] + weight * below * (linear ? one : s[k]);
                }
                for (int pair = 0; pair < 3; ++pair) {
                    const int i = FIRST[pair], j = SECOND[pair];
                    quotient[pair] = quotient[pair]
                        + weight * (linear ? one - clamped[pair]
                                           : Real(0.5) * (s[i] + s[j] - (c[i] + c[j]) * clamped[pair]));
                }
            }
        }
        const Pack shear_mean = (shear[0] + shear[1] + shear[2]) * THIRD_PART;
        Pack y[3];
        for (int k = 0; k < 3; ++k) {
            shear[k] = shear[k] - shear_mean;
            y[k] = factor * mean + modulus * shear[k];
            quotient[k] = modulus * quotient[k];
        }

// From the gradient gy of y: g_change of the outputs, and g_s of the stretches without the path through the network.
//// stretch_vjp
        Pack g_change[OUTPUTS], g_s[3];
        {
            const Pack total = gy[0] + gy[1] + gy[2];
            Pack g_shift = zero;
            for (int k = 0; k < 3; ++k) {
                const Pack g_shear = modulus * (gy[k] - total * THIRD_PART);
                g_shift = g_shift + g_shear * twist[k];
                g_s[k] = factor * total * mean_slope[k] + g_shear * slope[k];
            }
            g_change[0] = factor * mean * total;
            g_change[1] = modulus * dot(gy, shear);
            g_change[2] = g_shift * Real(12) * growth * inverse_growth * inverse_growth;
        }

// Form "energy": psi[0] of volume and psi[1] of shear and their principal stresses, with derivatives by s, those of the
// stresses in the direction gy (zero in the forward kernel).
//// energy_parts
        Pack psi[2], stress[2][3], psi_slope[2][3], stress_slope[2][3];
        const Pack gy_total = gy[0] + gy[1] + gy[2];
        if (kind == HENCKY) {
            const Real bulk = lam + Real(2) * mu * THIRD_PART;
            psi[0] = Real(0.5) * bulk * trace * trace;
            psi[1] = mu * square;
            for (int k = 0; k < 3; ++k) {
                stress[0][k] = bulk * trace;
                stress[1][k] = Real(2) * mu * dev[k];
                psi_slope[0][k] = rate[k] * stress[0][k];
                psi_slope[1][k] = rate[k] * stress[1][k];
                stress_slope[0][k] = rate[k] * bulk * gy_total;
                stress_slope[1][k] = rate[k] * Real(2) * mu * (gy[k] - gy_total * THIRD_PART);
            }
        } else {
            const Pack minors[3] = {s[1] * s[2], s[0] * s[2], s[0] * s[1]};
            const Pack J = s[0] * minors[0];
            psi[1] = zero;
            if (kind == FIXED_COROTATED) {
                psi[0] = Real(0.5) * lam * (J - Real(1)) * (J - Real(1));
                for (int k = 0; k < 3; ++k) {
                    const Pack stretch = s[k] - Real(1);
                    psi[1] = psi[1] + mu * stretch * stretch;
                    stress[0][k] = lam * J * (J - Real(1));
                    stress[1][k] = Real(2) * mu * stretch * s[k];
                    psi_slope[0][k] = lam * (J - Real(1)) * minors[k];
                    psi_slope[1][k] = Real(2) * mu * stretch;
                    stress_slope[0][k] = lam * (Real(2) * J - Real(1)) * minors[k] * gy_total;
                    stress_slope[1][k] = Real(2) * mu * (s[k] + stretch) * gy[k];
                }
            } else {
                const auto inside = J >= STRETCH_MIN * STRETCH_MIN * STRETCH_MIN;
                const Pack bounded = inside ? J : zero + STRETCH_MIN * STRETCH_MIN * STRETCH_MIN;
                const Pack log_J = logarithm(bounded);
                psi[0] = Real(0.5) * lam * log_J * log_J;
                psi[1] = -mu * log_J;
                for (int k = 0; k < 3; ++k) {
                    const Pack log_slope = inside ? DIVIDE(minors[k], bounded) : zero;
                    const Pack strain = Real(0.5) * (s[k] - Real(1)) * (s[k] + Real(1));
                    psi[1] = psi[1] + mu * strain;
                    stress[0][k] = lam * log_J;
                    stress[1][k] = Real(2) * mu * strain;
                    psi_slope[0][k] = lam * log_J * log_slope;
                    psi_slope[1][k] = mu * (s[k] - log_slope);
                    stress_slope[0][k] = lam * log_slope * gy_total;
                    stress_slope[1][k] = Real(2) * mu * s[k] * gy[k];
                }
            }
        }

// Principal stresses y: those of the parts and d psi / d z through the network. d0, d1, d2 are the derivatives of psi
// by the arguments of the activations, b0 and b1 by their values.
//// energy
        Pack d0[HIDDEN], d1[HIDDEN], d2[OUTPUTS], b0[HIDDEN], b1[HIDDEN], dx[3], factor[OUTPUTS];
        for (int k = 0; k < OUTPUTS; ++k) {
            factor[k] = exponential(change[k]);
            d2[k] = factor[k] * psi[k] * r2[k] * r2[k] * r2[k];
        }
        layer_back(w2, d2, b1);
        for (int k = 0; k < HIDDEN; ++k) d1[k] = b1[k] * r1[k] * r1[k] * r1[k];
        layer_back(w1, d1, b0);
        for (int k = 0; k < HIDDEN; ++k) d0[k] = b0[k] * r0[k] * r0[k] * r0[k];
        layer_back(w0, d0, dx);
        for (int k = 0; k < 3; ++k) dx[k] = dx[k] * (Real(1) / STRAIN);
        Pack y[3], quotient[3];
        for (int k = 0; k < 3; ++k) {
            y[k] = factor[0] * stress[0][k] + factor[1] * stress[1][k];
            y[k] = y[k] + dx[0] + dx[1] * along[k] + dx[2] * across[k];
            const int i = FIRST[k], j = SECOND[k];
            const Pack plain = kind == HENCKY ? log_quotient[k]
                : kind == FIXED_COROTATED ? s[i] + s[j] - Real(1) : Real(0.5) * (s[i] + s[j]);
            const Pack through = dx[1] * inverse_root
                - dx[2] * LODE * inverse * (dev[THIRD[k]] + Real(2) * det * inverse);
            quotient[k] = Real(2) * mu * factor[1] * plain + through * log_quotient[k];
        }

// gy . y is the derivative of psi in the direction gy of e plus the scaled stresses of the parts: a tangent through the
// network (dots), followed by the adjoint of both. The part "network_vjp" adds b0 and b1, which then hold the
// contributions of the slopes of the activations.
//// energy_vjp
        Pack g_s[3], g_change[OUTPUTS];
        {
            Pack x_dot[3] = {gy_total, dot(gy, along), dot(gy, across)};
            for (int k = 0; k < 3; ++k) x_dot[k] = x_dot[k] * (Real(1) / STRAIN);
            Pack a0_dot[HIDDEN], a1_dot[HIDDEN], a2_dot[OUTPUTS], h0_dot[HIDDEN], h1_dot[HIDDEN];
            layer(w0, x_dot, a0_dot, Real(0));
            for (int k = 0; k < HIDDEN; ++k) h0_dot[k] = a0_dot[k] * r0[k] * r0[k] * r0[k];
            layer(w1, h0_dot, a1_dot, Real(0));
            for (int k = 0; k < HIDDEN; ++k) h1_dot[k] = a1_dot[k] * r1[k] * r1[k] * r1[k];
            layer(w2, h1_dot, a2_dot, Real(0));
            add_weights(d0, d1, d2, x_dot, h0_dot, h1_dot, Real(0));
            // the derivative of the slope r^3 of an activation is -3 h r^4
            for (int k = 0; k < HIDDEN; ++k) {
                b0[k] = Real(-3) * h0[k] * a0_dot[k] * b0[k] * r0[k] * r0[k] * r0[k] * r0[k];
                b1[k] = Real(-3) * h1[k] * a1_dot[k] * b1[k] * r1[k] * r1[k] * r1[k] * r1[k];
            }
            Pack dots[OUTPUTS];
            for (int k = 0; k < OUTPUTS; ++k) {
                dots[k] = a2_dot[k] * r2[k] * r2[k] * r2[k];
                g_change[k] = factor[k] * (dot(gy, stress[k]) + psi[k] * dots[k])
                    - Real(3) / (LIMIT * LIMIT) * change[k] * r2[k] * a2_dot[k] * factor[k] * psi[k];
            }
            // derivative of the Lode part along gy: LODE (A / R - 2 det B / R^2), R = rounded
            const Pack mean = gy_total * THIRD_PART;
            const Pack even[3] = {gy[0] - mean, gy[1] - mean, gy[2] - mean};
            const Pack B = dot(dev, even), A = dot(cofactor, even);
            for (int k = 0; k < 3; ++k) {
                const int i = (k + 1) % 3, j = (k + 2) % 3;
                const Pack A_slope = dev[i] * even[j] + dev[j] * even[i] + B * THIRD_PART;
                const Pack size_slope = inverse_root * (even[k] - B * inverse * dev[k]);
                const Pack lode_slope = LODE * inverse
                    * (A_slope - Real(2) * inverse * (A * dev[k] + cofactor[k] * B + det * even[k])
                       + Real(8) * inverse * inverse * det * B * dev[k]);
                g_s[k] = rate[k] * (dx[1] * size_slope + dx[2] * lode_slope);
                for (int part = 0; part < OUTPUTS; ++part)
                    g_s[k] = g_s[k]
                        + factor[part] * (stress_slope[part][k] + psi_slope[part][k] * dots[part]);
            }
        }

// Adjoint of the network: adds the gradients of its weights and of the stretches (g_s).
//// network_vjp
        Pack g0[HIDDEN], g1[HIDDEN], g2[OUTPUTS], gx[3];
        for (int k = 0; k < OUTPUTS; ++k) g2[k] = g_change[k] * r2[k] * r2[k] * r2[k];
        layer_back(w2, g2, g1);
        for (int k = 0; k < HIDDEN; ++k) g1[k] = g1[k] * r1[k] * r1[k] * r1[k]{PLUS_B1};
        layer_back(w1, g1, g0);
        for (int k = 0; k < HIDDEN; ++k) g0[k] = g0[k] * r0[k] * r0[k] * r0[k]{PLUS_B0};
        layer_back(w0, g0, gx);
        add_weights(g0, g1, g2, x, h0, h1, Real(1));
        for (int k = 0; k < 3; ++k)
            g_s[k] = g_s[k] + rate[k] * (Real(1) / STRAIN) * (gx[0] + gx[1] * along[k] + gx[2] * across[k]);

// Before the rows: sums over rows of products of a gradient g with an input, per weight. On a GPU the rows of a block
// are stored in shared memory, one column per number, and a thread sums the products of a few weights.
//// sums
#if defined(__CUDA_ARCH__)
    const int COLUMN = THREADS + 1, SHARE = (WEIGHTS + THREADS - 1) / THREADS;
    const int X_AT = 0, H0_AT = INPUTS, H1_AT = H0_AT + HIDDEN, G0_AT = H1_AT + HIDDEN, G1_AT = G0_AT + HIDDEN,
              G2_AT = G1_AT + HIDDEN;
    __shared__ Real pool[(G2_AT + OUTPUTS) * COLUMN];
    Real sums[SHARE];
    UNROLL for (int k = 0; k < SHARE; ++k) sums[k] = Real(0);
    auto add_weights = [&](const Pack* g0, const Pack* g1, const Pack* g2, const Pack* x, const Pack* h0,
                           const Pack* h1, Real bias) {
        Real* const mine = pool + threadIdx.x;
        UNROLL for (int k = 0; k < INPUTS; ++k) mine[(X_AT + k) * COLUMN] = x[k];
        UNROLL for (int k = 0; k < OUTPUTS; ++k) mine[(G2_AT + k) * COLUMN] = g2[k];
        UNROLL for (int k = 0; k < HIDDEN; ++k) {
            mine[(H0_AT + k) * COLUMN] = h0[k];
            mine[(H1_AT + k) * COLUMN] = h1[k];
            mine[(G0_AT + k) * COLUMN] = g0[k];
            mine[(G1_AT + k) * COLUMN] = g1[k];
        }
        __syncthreads();
        UNROLL for (int k = 0; k < SHARE; ++k) {
            const int i = threadIdx.x + THREADS * k;
            if (i >= WEIGHTS) continue;
            const int which = i < W1_START ? 0 : i < W2_START ? 1 : 2, columns = (which == 0 ? INPUTS : HIDDEN) + 1;
            const int place = i - (which == 0 ? 0 : which == 1 ? W1_START : W2_START), column = place % columns;
            const Real* g = pool + ((which == 0 ? G0_AT : which == 1 ? G1_AT : G2_AT) + place / columns) * COLUMN;
            const Real* h = pool + ((which == 0 ? X_AT : which == 1 ? H0_AT : H1_AT) + column) * COLUMN;
            const bool is_bias = column == columns - 1;
            Real sum = Real(0);
            for (int r = 0; r < THREADS; ++r) sum += g[r] * (is_bias ? bias : h[r]);
            sums[k] += sum;
        }
        __syncthreads();
    };
#else
    Pack sums[WEIGHTS];
    for (int i = 0; i < WEIGHTS; ++i) sums[i] = zero;
    auto add_layer = [](Pack* total, const auto& g, const auto& h, Real bias) {
        const int N = sizeof(h) / sizeof(h[0]), M = sizeof(g) / sizeof(g[0]);
        for (int o = 0; o < M; ++o) {
            for (int i = 0; i < N; ++i) total[o * (N + 1) + i] = total[o * (N + 1) + i] + g[o] * h[i];
            total[o * (N + 1) + N] = total[o * (N + 1) + N] + g[o] * bias;
        }
    };
    auto add_weights = [&](const auto& g0, const auto& g1, const auto& g2, const auto& x, const auto& h0,
                           const auto& h1, Real bias) {
        add_layer(sums, g0, x, bias);
        add_layer(sums + W1_START, g1, h0, bias);
        add_layer(sums + W2_START, g2, h1, bias);
    };
#endif

// After the rows: adds the sums to the gradients of the weights on a CPU, stores them per block on a GPU.
//// put_sums
#if defined(__CUDA_ARCH__)
    UNROLL for (int k = 0; k < SHARE; ++k) {
        const int i = threadIdx.x + THREADS * k;
        if (i < WEIGHTS) ((Real*)partials)[blockIdx.x * WEIGHTS + i] = sums[k];
    }
#else
    for (int i = 0; i < WEIGHTS; ++i) {
        Real sum = Real(0);
        for (int l = 0; l < WIDTH; ++l) sum += LANE(sums[i], l);
        Real* const total = i < W1_START ? (Real*)total0 + i
            : i < W2_START ? (Real*)total1 + i - W1_START : (Real*)total2 + i - W2_START;
        *total += sum;
    }
#endif

// Principal stretches y after the return, where `changed`. growing: slopes of threshold, friction and rate by change.
// share = D / q. Letters of structured.py: crush v, compaction k, dilatancy d, relaxed t1, after t', from_zero g.
//// plastic
        auto from_zero = [&](const Pack& x, Pack& risen, Pack& slope) {
            // expm1(2 h) = 2 exp(h) sinh(h) avoids cancellation
            const Pack h = Real(0.5) * GROWTH * (x > Real(0) ? x : zero), X = exponential(h);
            Pack value, derivative;
            sinhc(h, X, value, derivative);
            risen = RISE * Real(2) * h * X * value;
            slope = x >= Real(0) ? GROWTH * RISE * X * X : zero;
        };
        Pack value[3], growing[3];
        for (int k = 0; k < 3; ++k) {
            const Real constant = k == 0 ? threshold_base : k == 1 ? friction_base : rate_base;
            const Real unit = k == 0 ? COHESION_UNIT : Real(1);
            if (constant > Real(0)) {
                value[k] = constant * exponential(change[k]);
                growing[k] = value[k];
            } else {
                from_zero(change[k], value[k], growing[k]);
                value[k] = unit * value[k];
                growing[k] = unit * growing[k];
            }
        }
        Pack crush, crush_slope, dilation, dilation_slope, compaction, compaction_slope;
        from_zero(change[3], crush, crush_slope);
        from_zero(change[4], dilation, dilation_slope);
        from_zero(-change[4], compaction, compaction_slope);
        crush = crush * (Real(1) / LIMIT);
        dilation = dilation * (Real(1) / LIMIT);
        compaction = compaction * (Real(1) / LIMIT);
        const Pack tiny = zero + NORMAL_MIN;
        const Pack bounded = square > NORMAL_MIN ? square : tiny;
        const Pack inverse_norm = RECIPROCAL_ROOT(bounded), norm = bounded * inverse_norm;
        const Pack fluid = RECIPROCAL(one + value[2]), dilatancy = dilation * associated * value[1];
        const Pack relaxed = trace * (one - fluid * crush);
        const Pack shifted = kind == GRANULAR ? relaxed - Real(3) * value[0] : relaxed;
        const Pack pressure = kind == GRANULAR ? -shifted : shifted < Real(0) ? -shifted : zero;
        const Pack limit = (kind == GRANULAR ? zero : value[0]) + value[1] * pressure;
        const Pack beyond_apex = kind == GRANULAR ? shifted - dilatancy * norm : zero;
        const auto torn = beyond_apex > Real(0);
        const auto slips = (norm > limit) & (beyond_apex <= Real(0));
        const auto changed = torn | slips | (crush > Real(0));
        const bool moves = any(changed);
        const Pack held = RECIPROCAL(one + value[1] * dilatancy), slip = one - limit * inverse_norm;
        const Pack share = slips ? fluid * held * slip : zero;
        Pack y[3];
        for (int k = 0; k < 3; ++k) y[k] = s[k];
        if (moves) {
            const Pack apex = kind == GRANULAR ? exponential(value[0]) : one;
            const Pack after = relaxed * (one - compaction * share) - dilatancy * share * norm;
            for (int k = 0; k < 3; ++k) {
                const Pack returned = exponential(after * THIRD_PART + dev[k] * (one - share));
                y[k] = torn ? apex : changed ? returned : s[k];
            }
        }

//// deformation
        {
            for (int k = 0; k < (cached == 1 ? 3 : 0); ++k) kept(21 + k) = y[k];
            Pack f[9];
            Matrices::load((const Real*)F + 9 * (size_t)first, used, f);
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    const Pack moved = y[0] * u[0][i] * v[0][j] + y[1] * u[1][i] * v[1][j] + y[2] * u[2][i] * v[2][j];
                    f[3 * i + j] = changed ? moved : f[3 * i + j];
                }
            Matrices::prefetch((Real*)out + 9 * (size_t)(first + 2 * WIDTH), 9 * WIDTH);
            Matrices::store((Real*)out + 9 * (size_t)first, used, f);
        }

// K of grad_F = U K V^T with G = U^T g V, unless no row of the pack yields.
//// plastic_vjp
        Pack K[3][3], g_s[3], g_change[OUTPUTS];
        {
            Pack gv[3][3], G[3][3];
            for (int k = 0; k < 3; ++k)
                for (int i = 0; i < 3; ++i)
                    gv[k][i] = g[3 * i] * v[k][0] + g[3 * i + 1] * v[k][1] + g[3 * i + 2] * v[k][2];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) G[i][j] = dot(u[i], gv[j]);
            const Pack scale = torn ? zero : one - share;
            Pack ga[3];
            for (int k = 0; k < 3; ++k) ga[k] = changed ? G[k][k] * y[k] : zero;
            const Pack total = ga[0] + ga[1] + ga[2];
            const Pack g_after = torn ? zero : total * THIRD_PART;
            const Pack g_share = slips ? -(dot(ga, dev) + g_after * (relaxed * compaction + dilatancy * norm)) : zero;
            const Pack g_slip = g_share * fluid * held;
            const Pack g_limit = -(g_slip * inverse_norm);
            // d limit / d shifted
            const Pack pulled = kind == GRANULAR ? -value[1] : shifted < Real(0) ? -value[1] : zero;
            const Pack g_shifted = g_limit * pulled;
            const Pack g_relaxed = g_after * (one - compaction * share) + g_shifted;
            const Pack g_held = -(g_share * share * held);  // gradient of friction times dilatancy
            const Pack g_dilatancy = g_held * value[1] - g_after * share * norm;
            const Pack g_fluid = g_share * held * slip - g_relaxed * trace * crush;
            const Pack g_trace = g_relaxed * (one - fluid * crush);
            const Pack g_norm = g_slip * limit * inverse_norm * inverse_norm - g_after * dilatancy * share;
            g_change[0] = (kind == GRANULAR ? (torn ? total : Real(-3) * g_shifted) : g_limit) * growing[0];
            g_change[1] = (g_limit * pressure + g_held * dilatancy + g_dilatancy * dilation * associated) * growing[1];
            g_change[2] = -(g_fluid * fluid * fluid * growing[2]);
            g_change[3] = g_relaxed * trace * fluid * crush_slope * (Real(-1) / LIMIT);
            g_change[4] = (g_dilatancy * associated * value[1] * dilation_slope
                           + g_after * relaxed * share * compaction_slope) * (Real(1) / LIMIT);
            for (int k = 0; k < 3; ++k) {
                const Pack straight = torn ? zero : scale * (ga[k] - total * THIRD_PART);
                g_s[k] = rate[k] * (g_trace + straight + g_norm * inverse_norm * dev[k]);
            }
            for (int pair = 0; pair < 3; ++pair) {
                const int i = FIRST[pair], j = SECOND[pair];
                Pack sum = s[i] + s[j];
                sum = sum < Real(0) ? (sum < -EPS ? sum : zero - EPS) : (sum > EPS ? sum : zero + EPS);
                const Pack half = Real(0.5) * scale * (e[i] - e[j]);
                Pack middle, slope;
                sinhc(half, exponential(half), middle, slope);
                Pack product = y[i] * y[j];
                product = product > Real(0) ? product : zero;
                const Pack stretch = Real(0.5) * SQRT(product) * scale * middle * log_quotient[pair];
                const Pack turn = DIVIDE(Real(0.5) * (y[i] + y[j]), sum);
                K[i][j] = stretch * (G[i][j] + G[j][i]) + turn * (G[i][j] - G[j][i]);
                K[j][i] = stretch * (G[i][j] + G[j][i]) - turn * (G[i][j] - G[j][i]);
            }
        }

//// stress
        Pack tau[9];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j <= i; ++j)
                tau[3 * i + j] = tau[3 * j + i]
                    = y[0] * u[0][i] * u[0][j] + y[1] * u[1][i] * u[1][j] + y[2] * u[2][i] * u[2][j];
        Matrices::prefetch((Real*)out + 9 * (size_t)(first + 2 * WIDTH), 9 * WIDTH);
        Matrices::store((Real*)out + 9 * (size_t)first, used, tau);

// The gradient g of the result.
//// load_gradient
        Pack g[9];
        Matrices::load((const Real*)grad_out + 9 * (size_t)first, used, g, false);

// gy, and off = G + G^T by pairs for G = U^T g U
//// stress_gradient
        Pack gy[3], off[3];
        {
            Pack gu[3][3];
            for (int k = 0; k < 3; ++k)
                for (int i = 0; i < 3; ++i) {
                    gu[k][i] = zero;
                    for (int j = 0; j < 3; ++j) gu[k][i] = gu[k][i] + (g[3 * i + j] + g[3 * j + i]) * u[k][j];
                }
            for (int k = 0; k < 3; ++k) {
                gy[k] = Real(0.5) * dot(u[k], gu[k]);
                off[k] = dot(u[FIRST[k]], gu[SECOND[k]]);
            }
        }

// K of grad_F = U K V^T
//// stress_vjp
        Pack K[3][3];
        for (int pair = 0; pair < 3; ++pair) {
            const int i = FIRST[pair], j = SECOND[pair];
            Pack total = s[i] + s[j];
            total = total < Real(0) ? (total < -EPS ? total : zero - EPS) : (total > EPS ? total : zero + EPS);
            const Pack both = DIVIDE(quotient[pair] * off[pair], total);
            K[i][j] = both * s[j];
            K[j][i] = both * s[i];
        }

//// put_gradient
        {
            Pack KV[3][3];
            for (int k = 0; k < 3; ++k) K[k][k] = g_s[k];
            for (int k = 0; k < 3; ++k)
                for (int j = 0; j < 3; ++j) KV[k][j] = K[k][0] * v[0][j] + K[k][1] * v[1][j] + K[k][2] * v[2][j];
            for (int k = 0; k < 9; ++k) {
                const int i = k / 3, j = k % 3;
                const Pack value = u[0][i] * KV[0][j] + u[1][i] * KV[1][j] + u[2][i] * KV[2][j];
                {CHOOSE}
            }
        }

//// if_moves
#if !defined(__CUDA_ARCH__)
        if (moves)
#endif
        {

//// end_if
        }

//// no_gradient
        const Pack gy[3] = {zero, zero, zero};

//// store_gradient
        if (adds) {
            Pack before[9];
            Matrices::load((const Real*)grad_F + 9 * (size_t)first, used, before);
            for (int k = 0; k < 9; ++k) g[k] = g[k] + before[k];
        }
        Matrices::store((Real*)grad_F + 9 * (size_t)first, used, g);

//// end_rows
    }

//// end
    #undef READ_AGAIN

// Separate kernel on a GPU: a block of LANES times GROUPS threads adds one column per lane of partials (summands, WEIGHTS).
//// add
    __shared__ Real sums[GROUPS][LANES];
    const int lane = threadIdx.x % LANES, group = threadIdx.x / LANES, i = LANES * blockIdx.x + lane;
    Real sum = Real(0);
    for (int b = group; b < summands && i < WEIGHTS; b += GROUPS) sum += ((const Real*)partials)[b * WEIGHTS + i];
    sums[group][lane] = sum;
    __syncthreads();
    if (group == 0 && i < WEIGHTS) {
        for (int k = 1; k < GROUPS; ++k) sum += sums[k][lane];
        Real* const total = i < W1_START ? (Real*)total0 + i
            : i < W2_START ? (Real*)total1 + i - W1_START : (Real*)total2 + i - W2_START;
        *total += sum;
    }
