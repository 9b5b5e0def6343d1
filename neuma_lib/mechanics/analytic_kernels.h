// The built-in analytic laws and their adjoints for packs of deformation gradients, composed by analytic_kernels.py.
//
// In another kernel: insert `analytic_kernels.laws(dtype)` at the start of the body of a native function and the part
// "end" of singular_values_kernels.h at its end. This defines the types `Real` and `Pack` (one number for each of WIDTH
// particles) and lambdas of packs of row-major 3x3 matrices, without reference to arrays:
//
//     stress(c, F, tau)                         F[9] -> tau[9]
//     return_map(c, F_trial, F)                 F_trial[9] -> F[9]
//     flow(c, ce, F_trial, F, tau)              both at once
//     stress_vjp(c, F, g, grad_F, grad_c)       adjoint for the gradient g[9] of tau
//     return_vjp(c, F_trial, g, grad_F, grad_c)
//     flow_vjp(c, ce, F_trial, F, g, g_tau, grad_F, grad_c, grad_ce)
//
// `c` points to the row of `analytic_kernels.row`: the index of the law and its coefficients c[1], c[2], ... A vjp sets
// grad_F[9] and grad_c[COEFFICIENTS], per particle: grad_c[k] is the gradient of c[k + 1]. Particles of a pack share c.
// A last argument `Pack kept[KEPT]` receives the singular values and vectors of a forward function for its adjoint.
// Lanes are independent. Those without a particle need any F, and g = 0 if grad_c is summed over lanes.
//
// A law is one branch of a function below. With F = U diag(s) V^T it states
// - a stress U diag(y) U^T by y, the divided differences (y_i - y_j) / (s_i - s_j) over pairs of axes, and from the
//   gradient gy of y those of s and c (principal_stress);
// - a stress that is polynomial in b = F F^T and a function of J = det F by both and their gradients, which needs no
//   singular values (tensor_stress);
// - a return map by a and b of y = exp(a + b dev log s) and from their gradients those of the trace and the norm of the
//   deviator of log s, and of c (principal_return).
// The adjoints in F follow from these without differences of singular values, so that they are accurate where singular
// values are equal. Letters and equations are those of elasticity.py and plasticity.py.

// Functions that both kinds of laws use.
//// functions
    const Real LOW = STRETCH_MIN, LOW_J = LOW * LOW * LOW;
    auto at_least = [&](const Pack& x, Real least) { return x < least ? zero + least : x; };
    auto away_from_zero = [&](const Pack& x) {
        return x < Real(0) ? (x > -EPS ? zero - EPS : x) : (x < EPS ? zero + EPS : x);
    };
    auto no_gradient = [&](Pack* grad_c) {
        for (int k = 0; k < COEFFICIENTS; ++k) grad_c[k] = zero;
    };
    // u[k], v[k] are the columns of U and V. `kept` is written, or read if `again`.
    auto decompose = [&](const Pack* F, Pack (*u)[3], Pack (*v)[3], Pack* singular, Pack* kept, bool again) {
        if (kept && again) {
            for (int k = 0; k < 3; ++k) {
                for (int i = 0; i < 3; ++i) {
                    u[k][i] = kept[3 * k + i];
                    v[k][i] = kept[9 + 3 * k + i];
                }
                singular[k] = kept[18 + k];
            }
            return;
        }
        Pack a[9];
        for (int k = 0; k < 9; ++k) a[k] = F[k];
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
        if (!kept) return;
        for (int k = 0; k < 3; ++k) {
            for (int i = 0; i < 3; ++i) {
                kept[3 * k + i] = u[k][i];
                kept[9 + 3 * k + i] = v[k][i];
            }
            kept[18 + k] = singular[k];
        }
    };
    // U K V^T
    auto turn_back = [&](const Pack (*u)[3], const Pack (*K)[3], const Pack (*v)[3], Pack* out) {
        Pack KV[3][3];
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j) KV[k][j] = K[k][0] * v[0][j] + K[k][1] * v[1][j] + K[k][2] * v[2][j];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) out[3 * i + j] = u[0][i] * KV[0][j] + u[1][i] * KV[1][j] + u[2][i] * KV[2][j];
    };
    // U^T g V
    auto turn = [&](const Pack (*u)[3], const Pack* g, const Pack (*v)[3], Pack (*G)[3]) {
        for (int j = 0; j < 3; ++j) {
            const Pack gv[3] = {dot(g, v[j]), dot(g + 3, v[j]), dot(g + 6, v[j])};
            for (int i = 0; i < 3; ++i) G[i][j] = dot(u[i], gv);
        }
    };
    // c = max(s, LOW), e = log c, rate = d e / d s, trace and dev of e
    auto strains = [&](const Pack* s, Pack* c, Pack* e, Pack* rate, Pack& trace, Pack* dev) {
        for (int k = 0; k < 3; ++k) {
            c[k] = at_least(s[k], LOW);
            e[k] = logarithm(c[k]);
            rate[k] = s[k] < LOW ? zero : RECIPROCAL(c[k]);
        }
        trace = e[0] + e[1] + e[2];
        for (int k = 0; k < 3; ++k) dev[k] = e[k] - trace * THIRD_PART;
    };

// Principal Kirchhoff stresses y. If `adjoint`, also the divided differences over pairs, and the gradients gs of s and
// grad_c of the coefficients for the gradient gy of y.
//// elasticity
    auto principal_stress = [&](const Real* c, const Pack* s, bool adjoint, const Pack* gy, Pack* y, Pack* quotient,
                                Pack* gs, Pack* grad_c) {
        const int law = (int)c[0];  // Warp redefines int(...)
        const Pack total = gy[0] + gy[1] + gy[2];
        const Pack minors[3] = {s[1] * s[2], s[0] * s[2], s[0] * s[1]};
        const Pack J = s[0] * minors[0];
        if (law == FixedCorotated) {  // c: 2 mu, lam
            for (int k = 0; k < 3; ++k) y[k] = c[1] * (s[k] - one) * s[k] + c[2] * J * (J - one);
            if (!adjoint) return;
            for (int k = 0; k < 3; ++k) {
                quotient[k] = c[1] * (s[FIRST[k]] + s[SECOND[k]] - one);
                gs[k] = c[1] * gy[k] * (s[k] + s[k] - one) + c[2] * total * (J + J - one) * minors[k];
                grad_c[0] = grad_c[0] + gy[k] * (s[k] - one) * s[k];
            }
            grad_c[1] = total * J * (J - one);
            return;
        }
        // functions of the logarithmic strain e, with the gradient ge and the quotient over e instead of s
        Pack limited[3], e[3], rate[3], trace, dev[3], ge[3];
        strains(s, limited, e, rate, trace, dev);
        const Pack mean = total * THIRD_PART;
        if (law == Tait) {  // c: 2 mu, K / 7
            const Pack bounded = at_least(J, LOW), inverse = RECIPROCAL(bounded);
            const Pack power = inverse * inverse * inverse * inverse * inverse * inverse;
            for (int k = 0; k < 3; ++k) y[k] = c[2] * (bounded - power) + c[1] * dev[k];
            if (!adjoint) return;
            const Pack bulk = J < LOW ? zero : c[2] * total * (one + Real(6) * power * inverse);
            for (int k = 0; k < 3; ++k) {
                ge[k] = c[1] * (gy[k] - mean);
                gs[k] = bulk * minors[k];
                quotient[k] = zero + c[1];
            }
            grad_c[0] = dot(gy, dev);
            grad_c[1] = total * (bounded - power);
        } else if (law == Ogden || law == MooneyRivlin) {
            // Ogden, c: 2 mu / alpha, alpha, bulk; MooneyRivlin, c: mu (1 - q), mu q, bulk
            const bool ogden = law == Ogden;
            const Real half = ogden ? Real(0.5) * c[2] : Real(1), back = ogden ? Real(0) : c[2];
            Pack X[3], x[3], inverse[3];
            for (int k = 0; k < 3; ++k) {
                X[k] = exponential(half * dev[k]);
                x[k] = X[k] * X[k];
                inverse[k] = ogden ? zero : RECIPROCAL(x[k]);
                y[k] = c[1] * x[k] - back * inverse[k];
            }
            const Pack middle = (y[0] + y[1] + y[2]) * THIRD_PART;
            for (int k = 0; k < 3; ++k) y[k] = y[k] - middle + c[3] * trace;
            if (!adjoint) return;
            Pack h[3];
            for (int k = 0; k < 3; ++k) {
                h[k] = gy[k] - mean;
                ge[k] = Real(2) * half * h[k] * (c[1] * x[k] + back * inverse[k]);
            }
            const Pack shared = c[3] * total - (ge[0] + ge[1] + ge[2]) * THIRD_PART;
            for (int k = 0; k < 3; ++k) {
                ge[k] = ge[k] + shared;
                gs[k] = zero;
                const int i = FIRST[k], j = SECOND[k];
                const Pack product = X[i] * X[j];
                Pack value, slope;
                sinhc(half * (e[i] - e[j]), DIVIDE(X[i], X[j]), value, slope);
                quotient[k] = Real(2) * half * (c[1] * product + (ogden ? zero : DIVIDE(zero + back, product))) * value;
            }
            const Pack weighted[3] = {h[0] * x[0], h[1] * x[1], h[2] * x[2]};
            grad_c[0] = weighted[0] + weighted[1] + weighted[2];
            grad_c[1] = ogden ? c[1] * dot(weighted, dev) : -dot(h, inverse);
            grad_c[2] = total * trace;
        } else {  // Hencky and FibreReinforced, c: 2 mu, lam
            for (int k = 0; k < 3; ++k) y[k] = c[1] * e[k] + c[2] * trace;
            if (!adjoint) return;
            for (int k = 0; k < 3; ++k) {
                ge[k] = c[1] * gy[k] + c[2] * total;
                gs[k] = zero;
                quotient[k] = zero + c[1];
            }
            grad_c[0] = dot(gy, e);
            grad_c[1] = total * trace;
        }
        Pack clamped[3], log_quotient[3];
        log_pairs(s, limited, e, any(s[2] < LOW), clamped, log_quotient);
        for (int k = 0; k < 3; ++k) {
            gs[k] = gs[k] + rate[k] * ge[k];
            quotient[k] = quotient[k] * log_quotient[k];
        }
    };
    // Laws in b and J. For A = g + g^T, the gradient g of tau: gb twice the gradient of b, gJ that of J.
    auto is_tensor_law = [](int law) { return law == NeoHookean || law == StVK || law == Fluid; };
    auto volume_ratio = [&](const Pack* F, Pack* cofactor) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
                cofactor[3 * i + j] = F[3 * i1 + j1] * F[3 * i2 + j2] - F[3 * i1 + j2] * F[3 * i2 + j1];
            }
        return dot(F, cofactor);
    };
    auto product = [&](const Pack* A, const Pack* B, Pack* AB) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                AB[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j];
    };
    auto symmetric_square = [&](const Pack* F, Pack* b) {  // F F^T
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j <= i; ++j) b[3 * i + j] = b[3 * j + i] = dot(F + 3 * i, F + 3 * j);
    };
    auto tensor_stress = [&](const Real* c, const Pack* F, Pack* tau) {
        const int law = (int)c[0];
        Pack cofactor[9], b[9], pressure;
        symmetric_square(F, b);
        if (law == StVK) {  // c: 2 mu, lam
            pressure = zero;
            const Pack dilation = Real(0.5) * (c[2] * (b[0] + b[4] + b[8] - Real(3)) - c[1]);
            symmetric_square(b, tau);
            for (int k = 0; k < 9; ++k) tau[k] = Real(0.5) * c[1] * tau[k] + dilation * b[k];
            return;
        }
        const Pack J = volume_ratio(F, cofactor);
        const Real shear = law == NeoHookean ? c[1] : Real(0);  // c: mu, lam; Fluid, c: lam
        pressure = law == NeoHookean ? c[2] * logarithm(at_least(J, LOW_J)) : c[1] * J * (J - one);
        for (int k = 0; k < 9; ++k) tau[k] = k % 4 ? shear * b[k] : shear * (b[k] - one) + pressure;
    };
    auto tensor_stress_vjp = [&](const Real* c, const Pack* F, const Pack* g, Pack* grad_F, Pack* grad_c) {
        const int law = (int)c[0];
        const Pack total = g[0] + g[4] + g[8];
        Pack cofactor[9], A[9], b[9], gb[9], gJ;
        for (int k = 0; k < 9; ++k) A[k] = g[k] + g[3 * (k % 3) + k / 3];
        symmetric_square(F, b);
        const Pack trace = b[0] + b[4] + b[8];
        const Pack along = dot(A, b) + dot(A + 3, b + 3) + dot(A + 6, b + 6);
        const Pack J = volume_ratio(F, cofactor);
        if (law == StVK) {
            Pack Ab[9];
            product(A, b, Ab);
            for (int k = 0; k < 9; ++k) {
                gb[k] = Real(0.5) * (c[1] * (Ab[k] + Ab[3 * (k % 3) + k / 3] - A[k]) + c[2] * (trace - Real(3)) * A[k]);
                if (k % 4 == 0) gb[k] = gb[k] + Real(0.5) * c[2] * along;
            }
            gJ = zero;
            const Pack square = dot(Ab, b) + dot(Ab + 3, b + 3) + dot(Ab + 6, b + 6);
            grad_c[0] = Real(0.25) * (square - along);
            grad_c[1] = Real(0.25) * (trace - Real(3)) * along;
        } else if (law == NeoHookean) {
            const Pack bounded = at_least(J, LOW_J);
            for (int k = 0; k < 9; ++k) gb[k] = c[1] * A[k];
            gJ = J < LOW_J ? zero : DIVIDE(c[2] * total, bounded);
            grad_c[0] = Real(0.5) * along - total;
            grad_c[1] = total * logarithm(bounded);
        } else {
            for (int k = 0; k < 9; ++k) gb[k] = zero;
            gJ = c[1] * total * (J + J - one);
            grad_c[0] = total * J * (J - one);
        }
        product(gb, F, grad_F);
        for (int k = 0; k < 9; ++k) grad_F[k] = grad_F[k] + gJ * cofactor[k];
    };
    // Fibres, c[3 ...]: half their modulus, exponent, direction. Strain, and tension with its slope by the strain.
    auto fibre = [&](const Real* c, const Pack* F, Pack* along, Pack& strain, Pack& growth, Pack& tension,
                     Pack& slope) {
        for (int i = 0; i < 3; ++i) along[i] = F[3 * i] * c[5] + F[3 * i + 1] * c[6] + F[3 * i + 2] * c[7];
        strain = dot(along, along) - one;
        const Pack exponent = c[4] * strain * strain;
        const auto bounded = exponent > FIBRE_EXPONENT_MAX;
        growth = exponential(bounded ? zero + FIBRE_EXPONENT_MAX : exponent);
        tension = c[3] * strain * growth;
        slope = c[3] * growth * (bounded ? one : one + exponent + exponent);
        return bounded;
    };
    auto add_fibres = [&](const Real* c, const Pack* F, Pack* tau) {
        Pack along[3], strain, growth, tension, slope;
        fibre(c, F, along, strain, growth, tension, slope);
        for (int k = 0; k < 9; ++k) tau[k] = tau[k] + tension * along[k / 3] * along[k % 3];
    };
    auto add_fibres_vjp = [&](const Real* c, const Pack* F, const Pack* g, Pack* grad_F, Pack* grad_c) {
        Pack along[3], strain, growth, tension, slope, pulled[3], grad_along[3];
        const auto bounded = fibre(c, F, along, strain, growth, tension, slope);
        for (int i = 0; i < 3; ++i) pulled[i] = dot(g + 3 * i, along);
        const Pack work = dot(pulled, along);
        for (int i = 0; i < 3; ++i) {
            const Pack other = g[i] * along[0] + g[3 + i] * along[1] + g[6 + i] * along[2];
            grad_along[i] = tension * (pulled[i] + other) + Real(2) * slope * work * along[i];
            for (int j = 0; j < 3; ++j) {
                grad_F[3 * i + j] = grad_F[3 * i + j] + grad_along[i] * c[5 + j];
                grad_c[4 + j] = grad_c[4 + j] + F[3 * i + j] * grad_along[i];
            }
        }
        grad_c[2] = work * strain * growth;
        grad_c[3] = bounded ? zero : work * tension * strain * strain;
    };
    // U diag(y) U^T for the principal stresses y of stretches s
    auto coaxial_stress = [&](const Real* c, const Pack (*u)[3], const Pack* s, Pack* tau) {
        Pack y[3];
        const Pack gy[3] = {zero, zero, zero};
        principal_stress(c, s, false, gy, y, y, y, y);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j <= i; ++j)
                tau[3 * i + j] = tau[3 * j + i]
                    = u[0][i] * y[0] * u[0][j] + u[1][i] * y[1] * u[1][j] + u[2][i] * y[2] * u[2][j];
    };
    // K of its gradient U K V^T
    auto coaxial_stress_vjp = [&](const Real* c, const Pack (*u)[3], const Pack* s, const Pack* g, Pack (*K)[3],
                                  Pack* grad_c) {
        Pack y[3], quotient[3], gs[3], G[3][3];
        turn(u, g, u, G);
        const Pack gy[3] = {G[0][0], G[1][1], G[2][2]};
        principal_stress(c, s, true, gy, y, quotient, gs, grad_c);
        for (int k = 0; k < 3; ++k) {
            const int i = FIRST[k], j = SECOND[k];
            const Pack both = DIVIDE(quotient[k] * (G[i][j] + G[j][i]), away_from_zero(s[i] + s[j]));
            K[k][k] = gs[k];
            K[i][j] = both * s[j];
            K[j][i] = both * s[i];
        }
    };
    auto stress = [&](const Real* c, const Pack* F, Pack* tau, Pack* kept = nullptr) {
        const int law = (int)c[0];
        if (is_tensor_law(law)) {
            tensor_stress(c, F, tau);
            return;
        }
        Pack u[3][3], v[3][3], s[3];
        decompose(F, u, v, s, kept, false);
        coaxial_stress(c, u, s, tau);
        if (law == FibreReinforced) add_fibres(c, F, tau);
    };
    auto stress_vjp = [&](const Real* c, const Pack* F, const Pack* g, Pack* grad_F, Pack* grad_c,
                          Pack* kept = nullptr) {
        const int law = (int)c[0];
        no_gradient(grad_c);
        if (is_tensor_law(law)) {
            tensor_stress_vjp(c, F, g, grad_F, grad_c);
            return;
        }
        Pack u[3][3], v[3][3], s[3], K[3][3];
        decompose(F, u, v, s, kept, true);
        coaxial_stress_vjp(c, u, s, g, K, grad_c);
        turn_back(u, K, v, grad_F);
        if (law == FibreReinforced) add_fibres_vjp(c, F, g, grad_F, grad_c);
    };

// Principal stretches y = exp(a + b dev) after the return, and whether there is one. Returns false without y if no
// particle of the pack yields. If `adjoint`, also b, and from the gradient gy of y the gradients gs of s and grad_c.
//// plasticity
    auto principal_return = [&](const Real* c, const Pack* s, bool adjoint, const Pack* gy, Pack* y, Mask& yields,
                                Pack* quotient, Pack* gs, Pack* grad_c) {
        const int law = (int)c[0];
        Pack limited[3], e[3], rate[3], trace, dev[3], a, b;
        if (law == FluidProjection) {
            const Pack minors[3] = {s[1] * s[2], s[0] * s[2], s[0] * s[1]};
            const Pack J = s[0] * minors[0], bounded = at_least(J, LOW_J);
            const Pack stretch = exponential(logarithm(bounded) * THIRD_PART);
            const Pack slope = J < LOW_J ? zero : DIVIDE(stretch * THIRD_PART, bounded);
            yields = one == one;
            for (int k = 0; k < 3; ++k) {
                y[k] = stretch;
                if (!adjoint) continue;
                quotient[k] = zero;
                gs[k] = (gy[0] + gy[1] + gy[2]) * slope * minors[k];
            }
            return true;
        }
        strains(s, limited, e, rate, trace, dev);
        const Pack square = at_least(dot(dev, dev), NORMAL_MIN), inverse = RECIPROCAL_ROOT(square), norm = square * inverse;
        const auto undefined = norm != norm;
        // of a and b by the trace and the norm, and by the coefficients
        Pack a_trace = zero + THIRD_PART, a_norm = zero, b_trace = zero, b_norm = zero;
        Pack a_c[5] = {zero, zero, zero, zero, zero}, b_c[5] = {zero, zero, zero, zero, zero};
        a = trace * THIRD_PART;
        if (law == DruckerPrager) {  // c: slope of the cone, strain at the apex per axis
            const Pack shifted = trace - Real(3) * c[2];
            const auto tensile = shifted > Real(0);
            yields = (norm > -c[1] * shifted) | undefined;
            a = tensile ? zero + c[2] : a;
            b = tensile ? zero : -c[1] * shifted * inverse;
            a_trace = tensile ? zero : a_trace;
            a_c[1] = tensile ? one : zero;
            b_trace = tensile ? zero : -c[1] * inverse;
            b_norm = -b * inverse;
            b_c[0] = tensile ? zero : -shifted * inverse;
            b_c[1] = tensile ? zero : Real(3) * c[1] * inverse;
        } else if (law == CohesiveDruckerPrager) {
            // c: slope of the cone, norm of the deviator at yield without trace, change of trace by flow
            const Real stiffness = Real(1) / (Real(1) + Real(3) * c[1] * c[3]);
            const Pack flow = (norm + c[1] * trace - c[2]) * stiffness;
            yields = (flow > Real(0)) | undefined;
            const auto torn = flow >= norm;
            const Pack share = flow * inverse;
            a = torn ? zero + c[2] / (Real(3) * c[1]) : a - c[3] * flow;
            b = torn ? zero : one - share;
            a_trace = torn ? zero : a_trace - c[3] * stiffness * c[1];
            a_norm = torn ? zero : zero - c[3] * stiffness;
            b_trace = torn ? zero : -c[1] * stiffness * inverse;
            b_norm = torn ? zero : (share - stiffness) * inverse;
            const Pack flow_c[3] = {
                (trace - flow * Real(3) * c[3]) * stiffness, zero - stiffness, -flow * Real(3) * c[1] * stiffness
            };
            for (int k = 0; k < 3; ++k) {
                a_c[k] = torn ? zero : -c[3] * flow_c[k] - (k == 2 ? flow : zero);
                b_c[k] = torn ? zero : -flow_c[k] * inverse;
            }
            a_c[0] = torn ? zero - c[2] / (Real(3) * c[1] * c[1]) : a_c[0];
            a_c[1] = torn ? zero + Real(1) / (Real(3) * c[1]) : a_c[1];
        } else if (law == CrushableFoam) {
            // c: p and q in units of the half axis of the ellipse by -trace and norm, its centre, 1 - centre^2,
            // remaining share of the excess after a step
            const Pack p = -c[1] * trace, q = c[2] * norm;
            const Pack A = p * p + q * q, B = c[3] * p;
            yields = (A - B - B - c[4] > Real(0)) | undefined;
            const Pack inverse_A = RECIPROCAL(yields ? A : one), root = SQRT(B * B + A * c[4]);
            const Pack ray = (B + root) * inverse_A, r = ray + (one - ray) * c[5];
            const Pack r_ray = zero + (Real(1) - c[5]), r_A = r_ray * (DIVIDE(zero + Real(0.5) * c[4], root) - ray) * inverse_A;
            const Pack r_B = r_ray * (one + DIVIDE(B, root)) * inverse_A;
            b = r;
            a = r * a;
            b_trace = -c[1] * (Real(2) * r_A * p + r_B * c[3]);
            b_norm = c[2] * Real(2) * r_A * q;
            b_c[0] = -trace * (Real(2) * r_A * p + r_B * c[3]);
            b_c[1] = norm * Real(2) * r_A * q;
            b_c[2] = r_B * p;
            b_c[3] = DIVIDE(r_ray * Real(0.5), root);
            b_c[4] = one - ray;
            a_trace = r * THIRD_PART + b_trace * trace * THIRD_PART;
            a_norm = b_norm * trace * THIRD_PART;
            for (int k = 0; k < 5; ++k) a_c[k] = b_c[k] * trace * THIRD_PART;
        } else {  // the deviator shrinks to the norm `kept`
            yields = (norm > c[1]) | undefined;
            Pack kept, kept_norm, kept_limit;
            if (law == HerschelBulkley) {  // c: limit, log rate, power, of y + rate y^power = norm - limit = total
                const auto tiny = norm - c[1] < EPS * EPS;
                const Pack all = tiny ? zero + EPS * EPS : norm - c[1], log_all = logarithm(all);
                const Pack other = (log_all - c[2]) * (Real(1) / c[3]);
                Pack u = other < log_all ? other : log_all, share = zero, slope = one;
                for (int step = 0; step < 9; ++step) {  // Newton's method, see plasticity._positive_root
                    const Pack d = c[2] + (c[3] - Real(1)) * u, size = d < Real(0) ? -d : d, small = exponential(-size);
                    share = DIVIDE(d < Real(0) ? small : one, one + small);
                    slope = RECIPROCAL(one + (c[3] - Real(1)) * share);
                    const Pack sum = (d < Real(0) ? u : u + d) + logarithm(one + small);
                    u = u - (sum - log_all) * slope;
                }
                const Pack root = exponential(u);
                kept = c[1] + root;
                kept_norm = tiny ? zero : DIVIDE(root * slope, all);
                kept_limit = one - kept_norm;
                b_c[1] = -root * share * slope * inverse;
                b_c[2] = b_c[1] * u;
            } else {  // VonMises and ViscousFlow, c: limit, remaining share of the excess after a step
                kept = c[1] + (norm - c[1]) * c[2];
                kept_norm = zero + c[2];
                kept_limit = one - c[2];
                b_c[1] = (norm - c[1]) * inverse;
            }
            b = kept * inverse;
            b_norm = (kept_norm - b) * inverse;
            b_c[0] = kept_limit * inverse;
        }
        if (!any(yields)) return false;
        Pack Y[3];
        for (int k = 0; k < 3; ++k) {
            Y[k] = exponential(Real(0.5) * (a + b * dev[k]));
            y[k] = Y[k] * Y[k];
        }
        if (!adjoint) return true;
        const Pack gl[3] = {gy[0] * y[0], gy[1] * y[1], gy[2] * y[2]};  // of log y
        const Pack ga = gl[0] + gl[1] + gl[2], gb = dot(gl, dev);
        const Pack g_trace = ga * a_trace + gb * b_trace - b * ga * THIRD_PART;
        const Pack g_norm = (ga * a_norm + gb * b_norm) * inverse;
        Pack clamped[3];
        log_pairs(s, limited, e, any(s[2] < LOW), clamped, quotient);
        for (int k = 0; k < 3; ++k) {
            gs[k] = rate[k] * (g_trace + b * gl[k] + g_norm * dev[k]);
            const int i = FIRST[k], j = SECOND[k];
            Pack value, slope;
            sinhc(Real(0.5) * b * (e[i] - e[j]), DIVIDE(Y[i], Y[j]), value, slope);
            quotient[k] = quotient[k] * b * Y[i] * Y[j] * value;
        }
        for (int k = 0; k < 5; ++k) grad_c[k] = yields ? ga * a_c[k] + gb * b_c[k] : zero;
        return true;
    };
    // F = U diag(y) V^T where y differs from s, else F_trial; sets s to y
    auto coaxial_return = [&](const Real* c, const Pack (*u)[3], const Pack (*v)[3], Pack* s, const Pack* F_trial,
                              Pack* F) {
        const Pack gy[3] = {zero, zero, zero};
        Pack y[3], value[9];
        Mask yields;
        for (int k = 0; k < 9; ++k) F[k] = F_trial[k];
        if (!principal_return(c, s, false, gy, y, yields, y, y, y)) return;
        yields = yields & ((y[0] != s[0]) | (y[1] != s[1]) | (y[2] != s[2]));
        const Pack K[3][3] = {{y[0], zero, zero}, {zero, y[1], zero}, {zero, zero, y[2]}};
        turn_back(u, K, v, value);
        for (int k = 0; k < 9; ++k) F[k] = yields ? value[k] : F[k];
        for (int k = 0; k < 3; ++k) s[k] = yields ? y[k] : s[k];
    };
    // From G = U^T g V, the gradient g of F. Where nothing yields, the gradient is g.
    auto coaxial_return_vjp = [&](const Real* c, const Pack (*u)[3], const Pack (*v)[3], const Pack* s,
                                  const Pack (*G)[3], const Pack* g, Pack* grad_F, Pack* grad_c) {
        Pack y[3], quotient[3], gs[3], K[3][3], value[9];
        Mask yields;
        const Pack gy[3] = {G[0][0], G[1][1], G[2][2]};
        for (int k = 0; k < 9; ++k) grad_F[k] = g[k];
        if (!principal_return(c, s, true, gy, y, yields, quotient, gs, grad_c)) return;
        for (int k = 0; k < 3; ++k) {
            const int i = FIRST[k], j = SECOND[k];
            const Pack stretch = Real(0.5) * quotient[k] * (G[i][j] + G[j][i]);
            const Pack spin = DIVIDE(Real(0.5) * (y[i] + y[j]), away_from_zero(s[i] + s[j])) * (G[i][j] - G[j][i]);
            K[k][k] = gs[k];
            K[i][j] = stretch + spin;
            K[j][i] = stretch - spin;
        }
        turn_back(u, K, v, value);
        for (int k = 0; k < 9; ++k) grad_F[k] = yields ? value[k] : grad_F[k];
    };
    auto return_map = [&](const Real* c, const Pack* F_trial, Pack* F, Pack* kept = nullptr) {
        if ((int)c[0] == Identity) {
            for (int k = 0; k < 9; ++k) F[k] = F_trial[k];
            return;
        }
        Pack u[3][3], v[3][3], s[3];
        decompose(F_trial, u, v, s, kept, false);
        coaxial_return(c, u, v, s, F_trial, F);
    };
    auto return_vjp = [&](const Real* c, const Pack* F_trial, const Pack* g, Pack* grad_F, Pack* grad_c,
                          Pack* kept = nullptr) {
        no_gradient(grad_c);
        if ((int)c[0] == Identity) {
            for (int k = 0; k < 9; ++k) grad_F[k] = g[k];
            return;
        }
        Pack u[3][3], v[3][3], s[3], G[3][3];
        decompose(F_trial, u, v, s, kept, true);
        turn(u, g, v, G);
        coaxial_return_vjp(c, u, v, s, G, g, grad_F, grad_c);
    };

// Return map and the stress after it, with one decomposition instead of two, because the return keeps U and V.
// Coefficients c of the plasticity and ce of the elasticity.
//// flow
    auto flow = [&](const Real* c, const Real* ce, const Pack* F_trial, Pack* F, Pack* tau, Pack* kept = nullptr) {
        if ((int)c[0] == Identity || is_tensor_law((int)ce[0])) {
            return_map(c, F_trial, F, kept);
            stress(ce, F, tau, (int)c[0] == Identity ? kept : nullptr);
            return;
        }
        Pack u[3][3], v[3][3], s[3];
        decompose(F_trial, u, v, s, kept, false);
        coaxial_return(c, u, v, s, F_trial, F);
        coaxial_stress(ce, u, s, tau);
        if ((int)ce[0] == FibreReinforced) add_fibres(ce, F, tau);
    };
    // For gradients g of F, without the part through tau, and g_tau; F is the result of the return
    auto flow_vjp = [&](const Real* c, const Real* ce, const Pack* F_trial, const Pack* F, const Pack* g,
                        const Pack* g_tau, Pack* grad_F, Pack* grad_c, Pack* grad_ce, Pack* kept = nullptr) {
        Pack all[9];
        if ((int)c[0] == Identity || is_tensor_law((int)ce[0])) {
            stress_vjp(ce, F, g_tau, all, grad_ce, (int)c[0] == Identity ? kept : nullptr);
            for (int k = 0; k < 9; ++k) all[k] = all[k] + g[k];
            return_vjp(c, F_trial, all, grad_F, grad_c, kept);
            return;
        }
        Pack u[3][3], v[3][3], s[3], y[3], unused[9], K[3][3], G[3][3];
        no_gradient(grad_c);
        no_gradient(grad_ce);
        decompose(F_trial, u, v, s, kept, true);
        for (int k = 0; k < 3; ++k) y[k] = s[k];
        coaxial_return(c, u, v, y, F_trial, unused);
        coaxial_stress_vjp(ce, u, y, g_tau, K, grad_ce);
        turn_back(u, K, v, all);
        if ((int)ce[0] == FibreReinforced) add_fibres_vjp(ce, F, g_tau, all, grad_ce);
        for (int k = 0; k < 9; ++k) all[k] = all[k] + g[k];
        turn(u, all, v, G);
        coaxial_return_vjp(c, u, v, s, G, all, grad_F, grad_c);
    };

// Kernels of analytic_kernels.py: consecutive copies of n rows, each with a row of coefficients. On a GPU a thread
// processes one row.
//// rows
    auto load = [&](uint64_t array, size_t first, int used, Pack* x) {
        Matrices::load((const Real*)array + 9 * first, used, x);
    };
    auto prefetch = [&](uint64_t array, size_t first) {
        Matrices::prefetch((const Real*)array + 9 * (first + WIDTH), 9 * WIDTH);
    };
    auto store = [&](uint64_t array, size_t first, int used, const Pack* x) {
        Matrices::store((Real*)array + 9 * first, used, x);
    };
    auto add_up = [&](uint64_t partials, size_t pack, int used, const Pack* grad_c) {
        if (!partials) return;
        for (int k = 0; k < COEFFICIENTS; ++k) {
            double sum = 0;
            for (int l = 0; l < used; ++l) sum += LANE(grad_c[k], l);
            ((double*)partials)[COEFFICIENTS * pack + k] = sum;
        }
    };
#if defined(__CUDA_ARCH__)
    const size_t pack = blockIdx.x * (size_t)THREADS + threadIdx.x;
    if (pack >= copies * (size_t)n) return;
    {
        const int used = 1;
        const size_t copy = pack / n, first = pack;
#else
    const size_t packs = (n + WIDTH - 1) / WIDTH;
    for (size_t pack = 0; pack < copies * packs; ++pack) {
        const size_t copy = pack / packs, begin = pack % packs * WIDTH, first = copy * n + begin;
        const int used = n - begin < WIDTH ? n - begin : WIDTH;
#endif
        const Real* const c = (const Real*)rows + (COEFFICIENTS + 1) * copy;
        Pack* const kept = cache ? (Pack*)cache + KEPT * pack : nullptr;
        Pack x[9], value[9];
        if (cache) Matrices::prefetch((Real*)(kept + KEPT), KEPT * WIDTH);
        load(F, first, used, x);

//// evaluate
        prefetch(out, first);
        FORWARD(c, x, value, kept);
        store(out, first, used, value);
    }

//// vjp
        Pack g[9], grad_c[COEFFICIENTS];
        load(grad_out, first, used, g);
        VJP(c, x, g, value, grad_c, kept);
        store(grad_F, first, used, value);
        add_up(partials, pack, used, grad_c);
    }

// `rows` are those of the plasticity and F is F_trial.
//// evaluate_flow
        Pack tau[9];
        prefetch(out, first);
        prefetch(stress_out, first);
        flow(c, (const Real*)elastic_rows + (COEFFICIENTS + 1) * copy, x, value, tau, kept);
        store(out, first, used, value);
        store(stress_out, first, used, tau);
    }

//// vjp_flow
        Pack g[9], g_tau[9], returned[9], grad_c[COEFFICIENTS], grad_ce[COEFFICIENTS];
        load(returned_F, first, used, returned);
        load(grad_out, first, used, g);
        load(grad_stress, first, used, g_tau);
        const Real* const ce = (const Real*)elastic_rows + (COEFFICIENTS + 1) * copy;
        flow_vjp(c, ce, x, returned, g, g_tau, value, grad_c, grad_ce, kept);
        store(grad_F, first, used, value);
        add_up(partials, pack, used, grad_c);
        add_up(elastic_partials, pack, used, grad_ce);
    }
