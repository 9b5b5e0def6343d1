// Kernels of `analytic_fused` for a pack of matrices of one law, combined with the load and SVD parts of
// `singular_values_kernels.h`. The module prepends an enum of laws. `constants` holds the index of the law and its
// coefficients c[1] ... c[3].

// Comparisons propagate values that are not finite.
//// constants
    const Real* const c = (const Real*)constants.data;
    const int law = (int)c[0];  // Warp redefines int(...)
    const Real STRETCH_LOW = Real(STRETCH_MIN);

//// unchanged
    auto copy_all = [&]() {
        const Real* p = (const Real*)F.data + 9 * first;
        for (int k = 0; k < 9 * used; ++k) ((Real*)out.data)[9 * first + k] = p[k];
    };
    if (law == Identity) {
        copy_all();
        return;
    }

//// functions
    auto log_of = [&](Pack x) {
        for (int l = 0; l < WIDTH; ++l) LANE(x, l) = wp::log(LANE(x, l));
        return x;
    };
    auto exp_of = [&](Pack x) {
        for (int l = 0; l < WIDTH; ++l) LANE(x, l) = wp::exp(LANE(x, l));
        return x;
    };
    auto at_least = [&](const Pack& x, Real least) { return x < least ? zero + least : x; };
    Pack y[3];

// Principal Kirchhoff stresses y, then U diag(y) U^T.
//// elasticity
    if (law == FixedCorotated) {
        const Pack J = s[0] * s[1] * s[2];
        for (int k = 0; k < 3; ++k) y[k] = c[1] * (s[k] - one) * s[k] + c[2] * J * (J - one);
    } else if (law == StVK) {
        Pack e[3];
        for (int k = 0; k < 3; ++k) e[k] = Real(0.5) * (s[k] - one) * (s[k] + one);
        for (int k = 0; k < 3; ++k) y[k] = s[k] * s[k] * (c[1] * e[k] + c[2] * (e[0] + e[1] + e[2]));
    } else if (law == Hencky) {
        Pack e[3];
        for (int k = 0; k < 3; ++k) e[k] = log_of(at_least(s[k], STRETCH_LOW));
        for (int k = 0; k < 3; ++k) y[k] = c[1] * e[k] + c[2] * (e[0] + e[1] + e[2]);
    } else if (law == NeoHookean) {
        const Pack bulk = c[2] * log_of(at_least(s[0] * s[1] * s[2], STRETCH_LOW * STRETCH_LOW * STRETCH_LOW));
        for (int k = 0; k < 3; ++k) y[k] = c[1] * (s[k] - one) * (s[k] + one) + bulk;
    } else if (law == Fluid) {
        const Pack J = s[0] * s[1] * s[2];
        for (int k = 0; k < 3; ++k) y[k] = c[1] * J * (J - one);
    } else {  // functions of the isochoric logarithmic strain: Ogden, MooneyRivlin
        Pack e[3];
        for (int k = 0; k < 3; ++k) e[k] = log_of(at_least(s[k], STRETCH_LOW));
        const Pack log_J = e[0] + e[1] + e[2];
        for (int k = 0; k < 3; ++k) {
            const Pack strain = e[k] - log_J / Real(3);
            if (law == Ogden)
                y[k] = c[1] * exp_of(c[2] * strain);
            else
                y[k] = c[1] * exp_of(strain + strain) - c[2] * exp_of(-strain - strain);
        }
        const Pack mean = (y[0] + y[1] + y[2]) / Real(3);
        for (int k = 0; k < 3; ++k) y[k] = y[k] - mean + c[3] * log_J;
    }
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j <= i; ++j) {
            const Pack tau = u0[i] * y[0] * u0[j] + u1[i] * y[1] * u1[j] + u2[i] * y[2] * u2[j];
            for (int l = 0; l < used; ++l) {
                Real* p = (Real*)out.data + 9 * (first + l);
                p[3 * i + j] = p[3 * j + i] = LANE(tau, l);
            }
        }
    }

// Principal stretches y after the return, then U diag(y) V^T, or F where they are unchanged.
//// plasticity
    auto yields = (s[0] == s[0]) | (s[0] != s[0]);
    if (law == FluidProjection) {
        const Pack J = at_least(s[0] * s[1] * s[2], STRETCH_LOW * STRETCH_LOW * STRETCH_LOW);
        y[0] = y[1] = y[2] = exp_of(log_of(J) / Real(3));
    } else {
        Pack e[3];
        for (int k = 0; k < 3; ++k) e[k] = log_of(at_least(s[k], STRETCH_LOW));
        const Pack mean = (e[0] + e[1] + e[2]) / Real(3);
        for (int k = 0; k < 3; ++k) e[k] = e[k] - mean;
        const Real NORMAL = sizeof(Real) == 4 ? Real(1.17549435e-38) : Real(2.2250738585072014e-308);
        const Pack norm = SQRT(at_least(e[0] * e[0] + e[1] * e[1] + e[2] * e[2], NORMAL));
        auto beyond = [&](const Pack& limit) { return (norm > limit) | (norm != norm); };
        Pack kept, apex = zero;
        if (law == DruckerPrager) {  // c: slope of the cone, strain at the apex per axis
            const Pack shifted = Real(3) * (mean - c[2]);
            kept = -c[1] * shifted;
            yields = beyond(kept);
            const auto tensile = shifted > Real(0);
            apex = tensile ? zero + c[2] : mean;
            kept = tensile ? zero : kept;
        } else {  // ViscousFlow, and VonMises as c[2] = 0; c: limit, remaining share of the excess after a step
            kept = c[1] + (norm - c[1]) * c[2];
            yields = beyond(zero + c[1]);
            apex = mean;
        }
        bool any = false;
        for (int l = 0; l < used; ++l) any = any || LANE(yields, l) != 0;
        if (!any) {
            copy_all();
            return;
        }
        const Pack share = kept / norm;
        for (int k = 0; k < 3; ++k) y[k] = exp_of(apex + e[k] * share);
    }
    yields = yields & ((y[0] != s[0]) | (y[1] != s[1]) | (y[2] != s[2]));
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            const Pack returned = u0[i] * y[0] * v0[j] + u1[i] * y[1] * v1[j] + u2[i] * y[2] * v2[j];
            for (int l = 0; l < used; ++l) {
                const int k = 9 * (first + l) + 3 * i + j;
                ((Real*)out.data)[k] = LANE(yields, l) ? LANE(returned, l) : ((const Real*)F.data)[k];
            }
        }
    }
