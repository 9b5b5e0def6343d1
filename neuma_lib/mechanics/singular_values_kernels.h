// Kernels that start with the SVD of a pack of 3x3 matrices, one per SIMD lane on the CPU and one per thread on a GPU.
// The module replaces REAL, CPU_WIDTH and SWEEPS.

// Type `Pack`, its size `WIDTH`, and macros LANE, SQRT, RECIPROCAL, RECIPROCAL_ROOT and DIVIDE.
//// types
    typedef REAL Real;
#if defined(__CUDA_ARCH__)
    typedef Real Pack;
    const int WIDTH = 1;
    #define LANE(x, l) (x)
    #define SQRT(x) sqrt(x)
    #define RECIPROCAL(x) (Real(1) / (x))
    #define RECIPROCAL_ROOT(x) (Real(1) / SQRT(x))
    #define DIVIDE(x, y) ((x) / (y))
#else
    typedef Real Pack __attribute__((vector_size(CPU_WIDTH * sizeof(Real))));
    const int WIDTH = CPU_WIDTH;
    // Through memory, because inserting numbers into a pack of several registers is several times slower. A set lane
    // of a mask is not a number, so that it converts to true.
    #define LANE(x, l) ((Real*)&(x))[l]
    // In single precision from an estimate by Newton's method, with an error of one or two units in the last place for
    // normal numbers: in a third of the time of quotients and roots, for which a processor has a single unit.
    struct Newton {
        typedef decltype(Pack{} < Pack{}) Bits;  // as wide as Real
        typedef float Register __attribute__((vector_size(64)));
        static __attribute__((always_inline)) Pack reciprocal(const Pack& x) {
            if (sizeof(Real) == 8) return Real(1) / x;
            Pack r;
#if defined(__AVX512F__)
            for (int k = 0; k < (int)(sizeof(Pack) / 64); ++k)
                ((Register*)&r)[k] = __builtin_ia32_rcp14ps512_mask(((const Register*)&x)[k], Register{}, 0xffff);
#else
            r = (Pack)(0x7ef311c7 - (Bits)x);  // an error of 12 %
            for (int i = 0; i < 3; ++i) r = r * (Real(2) - x * r);
#endif
            return r + r * (Real(1) - x * r);
        }
        static __attribute__((always_inline)) Pack reciprocal_root(const Pack& x) {
            if (sizeof(Real) == 8) return Real(1) / __builtin_elementwise_sqrt(x);
            Pack r;
            const Pack half = Real(0.5) * x;
#if defined(__AVX512F__)
            for (int k = 0; k < (int)(sizeof(Pack) / 64); ++k)
                ((Register*)&r)[k] = __builtin_ia32_rsqrt14ps512_mask(((const Register*)&x)[k], Register{}, 0xffff);
#else
            r = (Pack)(0x5f3759df - ((Bits)x >> 1));  // an error of 3.5 %
            for (int i = 0; i < 2; ++i) r = r * (Real(1.5) - half * r * r);
#endif
            return r + r * (Real(0.5) - half * r * r);
        }
        static __attribute__((always_inline)) Pack root(const Pack& x) {
            if (sizeof(Real) == 8) return __builtin_elementwise_sqrt(x);
            const Real least = Real(2.35e-38);
            const Pack r = reciprocal_root(x > least ? x : Pack{} + least), y = x * r;
            return y + Real(0.5) * r * (x - y * y);
        }
        static __attribute__((always_inline)) Pack quotient(const Pack& x, const Pack& y) {
            if (sizeof(Real) == 8) return x / y;
            const Pack r = reciprocal(y), q = x * r;
            return q + r * (x - q * y);
        }
    };
    #define SQRT(x) Newton::root(x)
    #define RECIPROCAL(x) Newton::reciprocal(x)
    #define RECIPROCAL_ROOT(x) Newton::reciprocal_root(x)
    #define DIVIDE(x, y) Newton::quotient(x, y)
#endif

// Row-major 3x3 matrices of consecutive particles, for packs of 16 or more. Lanes after the last one, `used`, receive the
// first, or zeros. Also used by transfers.h.
//// matrices
    struct Matrices {
#if !defined(__CUDA_ARCH__)
        typedef Real Four __attribute__((vector_size(4 * sizeof(Real)), aligned(sizeof(Real))));
        typedef Real Eight __attribute__((vector_size(8 * sizeof(Real))));
        typedef Real Sixteen __attribute__((vector_size(16 * sizeof(Real)), aligned(sizeof(Real))));
        // Transposes 4 x 4 numbers in each quarter of the lanes.
        static __attribute__((always_inline)) void transpose(Sixteen* r) {
            #define PAIRS(a, b, i) __builtin_shufflevector(a, b, i, i + 16, i + 1, i + 17, i + 4, i + 20, i + 5, i + 21, \
                i + 8, i + 24, i + 9, i + 25, i + 12, i + 28, i + 13, i + 29)
            #define HALVES(a, b, i) __builtin_shufflevector(a, b, i, i + 1, i + 16, i + 17, i + 4, i + 5, i + 20, i + 21, \
                i + 8, i + 9, i + 24, i + 25, i + 12, i + 13, i + 28, i + 29)
            const Sixteen a = PAIRS(r[0], r[1], 0), b = PAIRS(r[2], r[3], 0);
            const Sixteen c = PAIRS(r[0], r[1], 2), d = PAIRS(r[2], r[3], 2);
            r[0] = HALVES(a, b, 0);
            r[1] = HALVES(a, b, 2);
            r[2] = HALVES(c, d, 0);
            r[3] = HALVES(c, d, 2);
            #undef PAIRS
            #undef HALVES
        }
        // Four numbers of each of 16 particles, whose first ones are `stride` apart
        static __attribute__((always_inline)) void load_four(const Real* p, int stride, Sixteen* x) {
            #define EIGHT(q) __builtin_shufflevector(*(const Four*)(q), *(const Four*)((q) + 4 * stride), 0, 1, 2, 3, 4, 5, 6, 7)
            for (int j = 0; j < 4; ++j) {
                const Eight low = EIGHT(p + j * stride), high = EIGHT(p + (j + 8) * stride);
                x[j] = __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            }
            #undef EIGHT
            transpose(x);
        }
        static __attribute__((always_inline)) void store_four(Real* p, int stride, Sixteen a, Sixteen b, Sixteen c, Sixteen d) {
            Sixteen r[4] = {a, b, c, d};
            transpose(r);
            for (int j = 0; j < 4; ++j) {
                Real* const q = p + j * stride;
                *(Four*)q = __builtin_shufflevector(r[j], r[j], 0, 1, 2, 3);
                *(Four*)(q + 4 * stride) = __builtin_shufflevector(r[j], r[j], 4, 5, 6, 7);
                *(Four*)(q + 8 * stride) = __builtin_shufflevector(r[j], r[j], 8, 9, 10, 11);
                *(Four*)(q + 12 * stride) = __builtin_shufflevector(r[j], r[j], 12, 13, 14, 15);
            }
        }
#endif
        // Loads memory of a later pack, which is not in the caches of a CPU after many steps.
        static void prefetch(const Real* p, int count) {
#if !defined(__CUDA_ARCH__)
            for (int k = 0; k < count; k += 64 / sizeof(Real)) __builtin_prefetch(p + k, 1);
#endif
        }
        static void load(const Real* p, int used, Pack* x, bool repeats = true) {
#if !defined(__CUDA_ARCH__)
            for (int part = 0; part < (used == WIDTH ? WIDTH / 16 : 0); ++part, p += 9 * 16)
                for (int start = 0; start < 9; start += 4) {  // the last four overlap, so that nothing after the end is read
                    const int k = start == 8 ? 5 : start;
                    Sixteen r[4];
                    load_four(p + k, 9, r);
                    for (int j = start - k; j < 4; ++j) ((Sixteen*)&x[k + j])[part] = r[j];
                }
            if (used == WIDTH && WIDTH % 16 == 0) return;
#endif
            for (int l = 0; l < WIDTH; ++l)
                for (int k = 0; k < 9; ++k) LANE(x[k], l) = l < used || repeats ? p[9 * (l < used ? l : 0) + k] : Real(0);
        }
        static void store(Real* p, int used, const Pack* x) {
#if !defined(__CUDA_ARCH__)
            for (int part = 0; part < (used == WIDTH ? WIDTH / 16 : 0); ++part, p += 9 * 16) {
                const auto of = [&](int k) { return ((const Sixteen*)&x[k])[part]; };
                store_four(p, 9, of(0), of(1), of(2), of(3));
                store_four(p + 4, 9, of(4), of(5), of(6), of(7));
                for (int l = 0; l < 16; ++l) p[9 * l + 8] = LANE(x[8], 16 * part + l);
            }
            if (used == WIDTH && WIDTH % 16 == 0) return;
#endif
            for (int l = 0; l < used; ++l)
                for (int k = 0; k < 9; ++k) p[9 * l + k] = LANE(x[k], l);
        }
    };

// First in a function: enables fused multiply-add on a CPU, as on a GPU, which is not Warp's default. Numbers below the
// normal ones, such as squares of a vanishing angle, become zero, because they are a hundred times slower on x86.
//// fuse
#if defined(__clang__)
    #pragma clang fp contract(fast)
#endif
#if defined(__SSE__) && !defined(__CUDA_ARCH__)
    struct WithoutSubnormals {
        const unsigned before = __builtin_ia32_stmxcsr();
        WithoutSubnormals() { __builtin_ia32_ldmxcsr(before | 0x8040u); }  // results to zero, arguments are zero
        ~WithoutSubnormals() { __builtin_ia32_ldmxcsr(before); }
    } without_subnormals;
#endif

// Constants and functions of a pack. On a CPU exp and log are series with an error of one or two units in the last
// place.
//// math
    Pack zero;
    for (int l = 0; l < WIDTH; ++l) LANE(zero, l) = Real(0);
    const Pack one = zero + Real(1);
    typedef decltype(zero < zero) Mask;
    const Real EPS = sizeof(Real) == 4 ? Real(1.1920928955078125e-7) : Real(2.220446049250313e-16);
    const Real NORMAL_MIN = sizeof(Real) == 4 ? Real(1.17549435e-38) : Real(2.2250738585072014e-308);
    const Real NORMAL_MAX = sizeof(Real) == 4 ? Real(3.4028234e38) : Real(1.7976931348623157e308);
    const Real THIRD_PART = Real(1) / Real(3), ATANH_SQUARE = Real(0.03);
    // Terms for round-off accuracy of exp up to log(2) / 2, atanh(x) / x up to x^2 = ATANH_SQUARE, and sinh(x) / x up
    // to 1/2.
    const int EXP_TERMS = sizeof(Real) == 4 ? 8 : 14, ATANH_TERMS = sizeof(Real) == 4 ? 5 : 11;
    const int SINH_TERMS = sizeof(Real) == 4 ? 4 : 8;
    // Pairs of axes, and the axis that is not in the pair.
    const int FIRST[3] = {0, 0, 1}, SECOND[3] = {1, 2, 2}, THIRD[3] = {2, 1, 0};
    auto dot = [](const Pack* x, const Pack* y) { return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; };
#if defined(__CUDA_ARCH__)
    #define UNROLL _Pragma("unroll")
    auto exponential = [](const Pack& x) { return Real(exp(x)); };
    auto logarithm = [](const Pack& x) { return Real(log(x)); };
    auto any = [](bool mask) { return mask; };
#else
    #define UNROLL
    typedef Mask Bits;  // as wide as Real
    const int MANTISSA = sizeof(Real) == 4 ? 23 : 52, BIAS = sizeof(Real) == 4 ? 127 : 1023;
    // Adding 1.5 2^MANTISSA rounds to an integer, which is then in the last bits of the sum
    const Real ROUND = sizeof(Real) == 4 ? Real(12582912.0) : Real(6755399441055744.0);
    // log 2 in two parts; products of the first with an exponent are exact
    const Real LOG2_HIGH = sizeof(Real) == 4 ? Real(0.693359375) : Real(0.693147180369123816490);
    const Real LOG2_LOW = sizeof(Real) == 4 ? Real(-2.12194440054690583e-4) : Real(1.90821492927058770002e-10);
    const Real EXP_MIN = sizeof(Real) == 4 ? Real(-87) : Real(-708), EXP_MAX = sizeof(Real) == 4 ? Real(89) : Real(709.9);
    auto exponential = [&](const Pack& argument) {
        Pack x = argument > EXP_MAX ? zero + EXP_MAX : argument;
        x = x < EXP_MIN ? zero + EXP_MIN : x;
        const Pack shifted = x * Real(1.4426950408889634) + ROUND;
        const Pack k = shifted - ROUND;
        const Pack r = (x - k * LOG2_HIGH) - k * LOG2_LOW;
        Pack series = one;
        for (int i = EXP_TERMS; i > 0; --i) series = series * r * (Real(1) / Real(i)) + Real(1);
        return series * (Pack)(((Bits)shifted + BIAS) << MANTISSA);
    };
    // for normal numbers; infinity and what is no number stay
    auto logarithm = [&](const Pack& x) {
        const Pack root = zero + Real(0.70710678118654752);
        const Bits k = ((Bits)x - (Bits)root) >> MANTISSA;
        const Pack m = (Pack)((Bits)x - (k << MANTISSA));
        const Pack w = DIVIDE(m - Real(1), m + Real(1));
        const Pack q = w * w;
        Pack series = zero + Real(1) / Real(2 * ATANH_TERMS + 1);
        for (int i = ATANH_TERMS - 1; i >= 0; --i) series = series * q + Real(1) / Real(2 * i + 1);
        const Pack exponent = (Pack)(k + (Bits)(zero + ROUND)) - ROUND;
        const Pack value = exponent * LOG2_HIGH + (Real(2) * w * series + exponent * LOG2_LOW);
        return x <= NORMAL_MAX ? value : x;
    };
    auto any = [](const auto& mask) {
        auto bits = mask[0];
        for (int l = 1; l < WIDTH; ++l) bits |= mask[l];
        return bits != 0;
    };
#endif
    // sinh(x) / x and its derivative, for X = exp(x)
    auto sinhc = [&](const Pack& x, const Pack& X, Pack& value, Pack& slope) {
        const Pack q = x * x;
        Real c[SINH_TERMS + 1];  // 1 / (2 i + 1)!
        c[0] = Real(1);
        UNROLL for (int i = 1; i <= SINH_TERMS; ++i) c[i] = c[i - 1] / Real(2 * i * (2 * i + 1));
        value = q * c[SINH_TERMS] + c[SINH_TERMS - 1];
        slope = zero + Real(2 * SINH_TERMS) * c[SINH_TERMS];
        UNROLL for (int i = SINH_TERMS - 1; i > 0; --i) {
            value = value * q + c[i - 1];
            slope = slope * q + Real(2 * i) * c[i];
        }
        slope = slope * x;
        const auto far = q > Real(0.25);
        const Pack inverse_x = RECIPROCAL(far ? x : one), inverse = RECIPROCAL(X);
        const Pack away = Real(0.5) * (X - inverse) * inverse_x;
        slope = far ? (Real(0.5) * (X + inverse) - away) * inverse_x : slope;
        value = far ? away : value;
    };
    // Divided differences of c = max(s, STRETCH_MIN) and of its logarithm e over the pairs.
    auto log_pairs = [&](const Pack* s, const Pack* c, const Pack* e, bool crushed, Pack* clamped, Pack* log_quotient) {
        for (int pair = 0; pair < 3; ++pair) {
            const int i = FIRST[pair], j = SECOND[pair];
            const Pack apart = c[i] - c[j], inverse_total = RECIPROCAL(c[i] + c[j]);
            const Pack w = apart * inverse_total, q = w * w;
            Pack series = zero + Real(1) / Real(2 * ATANH_TERMS + 1);
            for (int k = ATANH_TERMS - 1; k >= 0; --k) series = series * q + Real(1) / Real(2 * k + 1);
            const auto far = q > ATANH_SQUARE;
            log_quotient[pair] = far ? DIVIDE(e[i] - e[j], far ? apart : one) : Real(2) * inverse_total * series;
            clamped[pair] = one;
            if (crushed) {
                const Pack difference = s[i] - s[j];
                const auto same = difference == Real(0);
                const Pack inside = s[j] > STRETCH_MIN ? one : zero;
                clamped[pair] = same ? inside : DIVIDE(apart, same ? one : difference);
                log_quotient[pair] = log_quotient[pair] * clamped[pair];
            }
        }
    };

// Opens a kernel over packs.
//// pack
    const int first = block * WIDTH;
    const int used = n - first < WIDTH ? n - first : WIDTH;

//// load
    Pack a[9];
    Matrices::load((const Real*)F.data + 9 * first, used, a);

// Decomposes `Pack a[9]` (row-major, scaled in place) into columns u0, u1, u2 and v0, v1, v2 and s[3]. Cyclic Jacobi on
// A^T A gives V, one one-sided Jacobi sweep on A V restores the relative accuracy lost by squaring A, then A V is sorted
// and orthonormalised. Only rotations are used and u2 = u0 x u1, so det U = det V = +1.
//// svd
    const Real TINY = sizeof(Real) == 4 ? Real(1e-36) : Real(1e-300);
    const Real NO_ANGLE = sizeof(Real) == 4 ? Real(1e-30) : Real(1e-300);  // squares below lose digits by underflow
    Pack zero = a[0];
    for (int l = 0; l < WIDTH; ++l) LANE(zero, l) = Real(0);
    const Pack one = zero + Real(1);
    Pack scale = zero;
    for (int k = 0; k < 9; ++k) {
        const Pack x = a[k] < Real(0) ? -a[k] : a[k];
        scale = x > scale ? x : scale;
    }
    scale = scale > TINY ? scale : one;
    const Pack inverse_scale = RECIPROCAL(scale);
    for (int k = 0; k < 9; ++k) a[k] = a[k] * inverse_scale;

    auto dot = [](const Pack* x, const Pack* y) { return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; };
    // cosine and sine of the rotation by at most 45 degrees that diagonalises [[app, apq], [apq, aqq]]
    // Returns sn / c.
    auto angle = [&](const Pack& app, const Pack& aqq, const Pack& apq, Pack& c, Pack& sn) {
        const Pack d = aqq - app;
        const Pack p2 = apq + apq;
        const Pack h = SQRT(d * d + p2 * p2);
        const Pack den = (d < Real(0) ? -d : d) + h;
        const Pack q = (h + h) * den;
        const Pack inv = RECIPROCAL_ROOT(q > NO_ANGLE ? q : one);
        c = q > NO_ANGLE ? den * inv : one;
        sn = q > NO_ANGLE ? p2 * inv : zero;
        sn = d < Real(0) ? -sn : sn;
        return sn * inv * (h + h);
    };
    auto turn = [](const Pack& c, const Pack& sn, Pack* x, Pack* y) {
        for (int k = 0; k < 3; ++k) {
            const Pack t = c * x[k] - sn * y[k];
            y[k] = sn * x[k] + c * y[k];
            x[k] = t;
        }
    };
    Pack v0[3] = {one, zero, zero}, v1[3] = {zero, one, zero}, v2[3] = {zero, zero, one};
    {
        Pack s00 = a[0] * a[0] + a[3] * a[3] + a[6] * a[6];
        Pack s11 = a[1] * a[1] + a[4] * a[4] + a[7] * a[7];
        Pack s22 = a[2] * a[2] + a[5] * a[5] + a[8] * a[8];
        Pack s01 = a[0] * a[1] + a[3] * a[4] + a[6] * a[7];
        Pack s02 = a[0] * a[2] + a[3] * a[5] + a[6] * a[8];
        Pack s12 = a[1] * a[2] + a[4] * a[5] + a[7] * a[8];
        auto jacobi = [&](Pack& app, Pack& aqq, Pack& apq, Pack& arp, Pack& arq, Pack* vp, Pack* vq) {
            Pack c, sn;
            const Pack shift = angle(app, aqq, apq, c, sn) * apq;
            app = app - shift;
            aqq = aqq + shift;
            apq = zero;
            const Pack t = c * arp - sn * arq;
            arq = sn * arp + c * arq;
            arp = t;
            turn(c, sn, vp, vq);
        };
        for (int sweep = 0; sweep < SWEEPS; ++sweep) {
            jacobi(s00, s11, s01, s02, s12, v0, v1);
            jacobi(s00, s22, s02, s01, s12, v0, v2);
            jacobi(s11, s22, s12, s01, s02, v1, v2);
        }
    }
    Pack u0[3], u1[3], u2[3];
    for (int k = 0; k < 3; ++k) {
        u0[k] = a[3 * k] * v0[0] + a[3 * k + 1] * v0[1] + a[3 * k + 2] * v0[2];
        u1[k] = a[3 * k] * v1[0] + a[3 * k + 1] * v1[1] + a[3 * k + 2] * v1[2];
        u2[k] = a[3 * k] * v2[0] + a[3 * k + 1] * v2[1] + a[3 * k + 2] * v2[2];
    }
    auto polish = [&](Pack* bp, Pack* bq, Pack* vp, Pack* vq) {
        Pack c, sn;
        angle(dot(bp, bp), dot(bq, bq), dot(bp, bq), c, sn);
        turn(c, sn, bp, bq);
        turn(c, sn, vp, vq);
    };
    polish(u0, u1, v0, v1);
    polish(u0, u2, v0, v2);
    polish(u1, u2, v1, v2);

    Pack n0 = dot(u0, u0), n1 = dot(u1, u1), n2 = dot(u2, u2);
    auto order = [](Pack& np, Pack& nq, Pack* bp, Pack* bq, Pack* vp, Pack* vq) {
        const auto swap = np < nq;
        for (int k = 0; k < 3; ++k) {
            Pack t = swap ? bq[k] : bp[k];
            bq[k] = swap ? -bp[k] : bq[k];
            bp[k] = t;
            t = swap ? vq[k] : vp[k];
            vq[k] = swap ? -vp[k] : vq[k];
            vp[k] = t;
        }
        const Pack t = swap ? nq : np;
        nq = swap ? np : nq;
        np = t;
    };
    order(n0, n1, u0, u1, v0, v1);
    order(n0, n2, u0, u2, v0, v2);
    order(n1, n2, u1, u2, v1, v2);

    Pack s[3];
    s[0] = SQRT(n0);
    const auto null = s[0] <= TINY;
    const Pack inverse_0 = RECIPROCAL(null ? one : s[0]);
    for (int k = 0; k < 3; ++k) u0[k] = null ? (k == 0 ? one : zero) : u0[k] * inverse_0;
    const Pack overlap = dot(u0, u1);
    for (int k = 0; k < 3; ++k) u1[k] = u1[k] - overlap * u0[k];
    s[1] = SQRT(dot(u1, u1));
    const auto flat = s[1] <= s[0] * TINY;  // rank one: any direction orthogonal to u0
    const auto steep = u0[0] * u0[0] > Real(0.5);
    Pack e[3] = {steep ? zero : one, steep ? one : zero, zero};
    const Pack along = dot(u0, e);
    for (int k = 0; k < 3; ++k) e[k] = e[k] - along * u0[k];
    const Pack inverse_1 = RECIPROCAL(flat ? SQRT(dot(e, e)) : s[1]);
    for (int k = 0; k < 3; ++k) u1[k] = (flat ? e[k] : u1[k]) * inverse_1;
    const Pack b2[3] = {u2[0], u2[1], u2[2]};
    u2[0] = u0[1] * u1[2] - u0[2] * u1[1];
    u2[1] = u0[2] * u1[0] - u0[0] * u1[2];
    u2[2] = u0[0] * u1[1] - u0[1] * u1[0];
    s[2] = dot(u2, b2);
    for (int k = 0; k < 3; ++k) s[k] = s[k] * scale;

//// store
    for (int l = 0; l < used; ++l) {
        const int i = first + l;
        Real* pu = (Real*)U.data + 9 * i;
        Real* pv = (Real*)Vh.data + 9 * i;
        Real* ps = (Real*)sigma.data + 3 * i;
        for (int k = 0; k < 3; ++k) {
            pu[3 * k] = LANE(u0[k], l);
            pu[3 * k + 1] = LANE(u1[k], l);
            pu[3 * k + 2] = LANE(u2[k], l);
            pv[k] = LANE(v0[k], l);
            pv[3 + k] = LANE(v1[k], l);
            pv[6 + k] = LANE(v2[k], l);
            ps[k] = LANE(s[k], l);
        }
    }

//// end
#undef LANE
#undef SQRT
#undef RECIPROCAL
#undef RECIPROCAL_ROOT
#undef DIVIDE
#undef UNROLL
