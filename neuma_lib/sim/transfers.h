// Transfers of `transfers` on a CPU: loops over the particles or nodes of all copies, with the names and equations of
// `kernels` and `adjoint_kernels`. REAL is the scalar type.
//
// A node is four numbers. `Row` holds a row of three consecutive nodes and, in its last four lanes, the node after it,
// whose weight is zero. So sums over the last axis of a stencil are products of vectors, and a row is one load or store.

//// start
    #pragma clang fp contract(on)
    typedef REAL Real;
    typedef Real Four __attribute__((vector_size(4 * sizeof(Real)), aligned(sizeof(Real))));
    typedef Real Eight __attribute__((vector_size(8 * sizeof(Real)), aligned(sizeof(Real))));
    typedef Real Row __attribute__((vector_size(16 * sizeof(Real)), aligned(sizeof(Real))));
    typedef int Index __attribute__((vector_size(4 * sizeof(int))));
    struct Columns { Four c[3]; };  // of a matrix. Their last lanes are zero.
    #define SHUFFLE __builtin_shufflevector
    #define INLINE __attribute__((always_inline))
    const int n = c.n;
    const Real inv_dx = c.inv_dx, dt = c.dt;
    const Four zero = {};
    auto repeat = [](Four a) INLINE { return SHUFFLE(a, a, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3); };
    auto load3 = [](const Real* p) INLINE { return Four{p[0], p[1], p[2], Real(0)}; };
    auto store3 = [](Real* p, Four a) INLINE { for (int k = 0; k < 3; ++k) p[k] = a[k]; };
    // Rows of a matrix in memory. Loads and stores of four numbers overlap instead of passing its end.
    auto load_rows = [&](const Real* p) INLINE {
        const Four a = *(const Four*)p, b = *(const Four*)(p + 3), d = *(const Four*)(p + 5);
        return Columns{{SHUFFLE(a, zero, 0, 1, 2, 4), SHUFFLE(b, zero, 0, 1, 2, 4), SHUFFLE(d, zero, 1, 2, 3, 4)}};
    };
    auto store_rows = [](Real* p, const Columns& a) INLINE {
        *(Four*)p = a.c[0];
        *(Four*)(p + 3) = a.c[1];
        *(Four*)(p + 5) = SHUFFLE(a.c[1], a.c[2], 2, 4, 5, 6);
    };
    auto transposed = [&](const Columns& a) INLINE {
        const Four low = SHUFFLE(a.c[0], a.c[1], 0, 4, 1, 5), high = SHUFFLE(a.c[0], a.c[1], 2, 6, 3, 7);
        const Four last = SHUFFLE(a.c[2], zero, 0, 1, 2, 4);
        return Columns{{SHUFFLE(low, last, 0, 1, 4, 7), SHUFFLE(low, last, 2, 3, 5, 7), SHUFFLE(high, last, 0, 1, 6, 7)}};
    };
    // sum_k a.c[k] b[k]
    auto times = [](const Columns& a, Four b) INLINE { return a.c[0] * b[0] + a.c[1] * b[1] + a.c[2] * b[2]; };
    auto each_sum = [&](Four a, Four b, Four d) INLINE {
        const Columns t = transposed({{a, b, d}});
        return t.c[0] + t.c[1] + t.c[2];
    };
    auto folded = [](const Row& a) INLINE {
        return SHUFFLE(a, a, 0, 1, 2, 3) + SHUFFLE(a, a, 4, 5, 6, 7) + SHUFFLE(a, a, 8, 9, 10, 11);
    };
    // Weights of an axis spread over the lanes of a row
    auto spread = [&](const Four* w, int axis) INLINE {
        const Four a = zero + w[0][axis], b = zero + w[1][axis], d = zero + w[2][axis];
        const Eight ab = SHUFFLE(a, b, 0, 1, 2, 3, 4, 5, 6, 7), d0 = SHUFFLE(d, zero, 0, 1, 2, 3, 4, 5, 6, 7);
        return SHUFFLE(ab, d0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    };
    // F_trial = (I + dt C) F
    auto trial_of = [&](const Columns& C_rows, const Columns& F_rows) INLINE {
        Columns trial;
        for (int k = 0; k < 3; ++k) trial.c[k] = F_rows.c[k] + dt * times(F_rows, C_rows.c[k]);
        return trial;
    };
    // First or later addition to a sum
    auto add = [](bool first, Row& sum, Real w, const Row& a) INLINE {
        if (first)
            sum = w * a;
        else
            sum += w * a;
    };
    const Row steps = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0};

//// stencil
    // First of the 27 nodes, distance from it [dx], and weights of all axes by node
    struct Stencil { int i, j, k, first; Four f, w[3]; };
    auto stencil = [&](const Real* x, int copy) INLINE {
        Stencil s;
        const Four scaled = load3(x) * inv_dx, last = zero + Real(n - 3);
        Four low = scaled - (Real(c.first) + Real(0.5));
        low = low > zero ? low : zero;  // also for values that are not numbers
        low = low < last ? low : last;
        const Index base = __builtin_convertvector(low, Index);
        s.f = scaled - (__builtin_convertvector(base, Four) + Real(c.first));
        const Four f = s.f, left = Real(1.5) - f, middle = f - Real(1), right = f - Real(0.5);
        s.w[0] = Real(0.5) * left * left;
        s.w[1] = Real(0.75) - middle * middle;
        s.w[2] = Real(0.5) * right * right;
        s.i = base[0], s.j = base[1], s.k = base[2];
        s.first = ((copy * n + s.i) * n + s.j) * n + s.k;
        return s;
    };
    auto slopes = [&](Four f, Four* s) INLINE {
        s[0] = f - Real(1.5), s[1] = Real(2) - Real(2) * f, s[2] = f - Real(0.5);
    };
    auto moments = [&](const Stencil& s, Four* wd) INLINE {
        for (int k = 0; k < 3; ++k) wd[k] = s.w[k] * (Real(k) - s.f);
    };

// Nodes from the first to the last that particles touch in a row, from those in the rows of their first nodes. Nodes
// outside are zero.
//// lines
    const int lines = n * n;

//// spans
    auto clear = [&](int copy, Real* nodes, int grids, size_t size) {
        int* const span = (int*)spans.data + 4 * lines * copy;
        for (int r = 0; r < lines; ++r) {
            const int low = span[2 * lines + r], count = span[3 * lines + r] + 1 - low;
            if (count > 0)
                for (int g = 0; g < grids; ++g) {
                    Four* const p = (Four*)(nodes + g * size) + ((size_t)copy * lines + r) * n + low;
                    for (int k = 0; k < count; ++k) p[k] = zero;
                }
            span[r] = n, span[lines + r] = -3;
        }
    };
    auto grow = [&](int copy) {
        int* const span = (int*)spans.data + 4 * lines * copy;
        int *low = span, *high = span + lines, *row_low = low + 2 * lines, *row_high = high + 2 * lines;
        for (int side = 0; side < 2; ++side) {  // along j to the rows, then in place along i from the last
            const int stride = side ? n : 1;
            for (int r = lines - 1; r >= 0; --r) {
                int a = side ? row_low[r] : low[r], b = side ? row_high[r] : high[r];
                for (int d = 1; d < 3; ++d) {
                    const bool exists = side ? r >= d * n : r % n >= d;
                    if (exists) {
                        const int s = r - d * stride, a2 = side ? row_low[s] : low[s], b2 = side ? row_high[s] : high[s];
                        a = a2 < a ? a2 : a, b = b2 > b ? b2 : b;
                    }
                }
                row_low[r] = a, row_high[r] = side ? b + 2 : b;
            }
        }
    };

//// momentum
    // q = (m v + A d, m) with A = m C - dt vol0 (4/dx^2) tau at the first node, and what it grows by along each axis
    struct Momentum { Four q; Columns A; Real stress; };
    auto momentum = [&](int p, Four f) INLINE {
        const Real m = ((const Real*)mass.data)[p];
        const Real stress = Real(4) * dt * inv_dx * inv_dx * ((const Real*)vol0.data)[p];
        const Real *pC = (const Real*)C.data + 9 * p, *pT = (const Real*)tau.data + 9 * p, *pv = (const Real*)v.data + 3 * p;
        const Eight a = c.dx * (m * *(const Eight*)pC - stress * *(const Eight*)pT);
        const Eight b = {c.dx * (m * pC[8] - stress * pT[8])};
        Momentum r;
        r.A.c[0] = SHUFFLE(a, b, 0, 3, 6, 9);
        r.A.c[1] = SHUFFLE(a, b, 1, 4, 7, 9);
        r.A.c[2] = SHUFFLE(a, b, 2, 5, 8, 9);
        r.q = m * Four{pv[0], pv[1], pv[2], Real(1)} - times(r.A, f);
        r.stress = stress;
        return r;
    };

//// p2g
    Four* const nodes = (Four*)grid.data;
    const size_t size = grid.shape[1] * (size_t)4;
    for (int copy = 0; copy < c.copies; ++copy) {
        clear(copy, (Real*)grid.data, grid.shape[0], size);
        int* const span = (int*)spans.data + 4 * lines * copy;
        int cell = -1;
        Row sum[9];
        auto flush = [&]() INLINE {
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) *(Row*)(nodes + cell + (i * n + j) * n) += sum[3 * i + j];
        };
        for (int p = copy * c.particles; p < (copy + 1) * c.particles; ++p) {
            const Stencil s = stencil((const Real*)x.data + 3 * p, copy);
            const Momentum u = momentum(p, s.f);
            const Row w = spread(s.w, 2), by_i = w * repeat(u.A.c[0]), by_j = w * repeat(u.A.c[1]);
            Row q_i = w * repeat(u.q) + steps * (w * repeat(u.A.c[2]));
            if (s.first != cell) {
                if (cell >= 0) flush();
                cell = s.first;
                for (int k = 0; k < 9; ++k) sum[k] = Row{};
                const int line = s.i * n + s.j;
                span[line] = s.k < span[line] ? s.k : span[line];
                span[lines + line] = s.k > span[lines + line] ? s.k : span[lines + line];
            }
            for (int i = 0; i < 3; ++i) {
                Row q_ij = q_i;
                for (int j = 0; j < 3; ++j) {
                    sum[3 * i + j] += (s.w[i][0] * s.w[j][1]) * q_ij;
                    q_ij += by_j;
                }
                q_i += by_i;
            }
        }
        if (cell >= 0) flush();
        grow(copy);
    }

// v_i = (m v)_i / m_i + dt g without walls and clamps
//// grid_update
    const Four gain = dt * Four{c.gravity[0], c.gravity[1], c.gravity[2], Real(0)};
    const int* const span = (const int*)spans.data;
    for (int row = 0; row < c.copies * lines; ++row) {
        const int at = row / lines * 4 * lines + row % lines, low = span[at + 2 * lines], high = span[at + 3 * lines];
        for (size_t node = (size_t)row * n + low; node <= (size_t)row * n + high && low <= high; ++node) {
            const Four mv = ((const Four*)grid.data)[node], v = mv / mv[3] + gain;
            ((Four*)grid_v.data)[node] = mv[3] > Real(0) ? v : zero;
        }
    }

//// g2p
    const Four low = zero + c.clamp_low, high = zero + c.clamp_high;
    for (int p = 0; p < c.copies * c.particles; ++p) {
        const int copy = c.copies > 1 ? p / c.particles : 0;
        const Real* const px = (const Real*)x.data + 3 * p;
        if (HELD && ((const Real*)mass.data)[p] == Real(0)) continue;
        const Stencil s = stencil(px, copy);
        Four wd[3];
        moments(s, wd);
        Row all, along_i, along_j;
        for (int i = 0; i < 3; ++i) {
            Row sum, moment;
            for (int j = 0; j < 3; ++j) {
                const Row row = *(const Row*)((const Four*)grid_v.data + s.first + (i * n + j) * n);
                add(j == 0, sum, s.w[j][1], row);
                add(j == 0, moment, wd[j][1], row);
            }
            add(i == 0, all, s.w[i][0], sum);
            add(i == 0, along_i, wd[i][0], sum);
            add(i == 0, along_j, s.w[i][0], moment);
        }
        const Row w = spread(s.w, 2);
        const Four v3 = SHUFFLE(folded(w * all), zero, 0, 1, 2, 4);
        const Real factor = Real(4) * inv_dx;
        const Columns B = {{factor * folded(w * along_i), factor * folded(w * along_j), factor * folded(spread(wd, 2) * all)}};
        const Columns C_rows = transposed(B);
        Four x_new = load3(px) + dt * v3;
        x_new = x_new < high ? x_new : high;
        x_new = x_new > low ? x_new : low;
        store3((Real*)x_after.data + 3 * p, x_new);
        store3((Real*)v_after.data + 3 * p, v3);
        store_rows((Real*)C_after.data + 9 * p, C_rows);
        store_rows((Real*)F_trial.data + 9 * p, trial_of(C_rows, load_rows((const Real*)F.data + 9 * p)));
        const Four speed = dt * (v3 > zero ? v3 : -v3), finite = Real(0) * (C_rows.c[0] + C_rows.c[1] + C_rows.c[2]);
        auto fine = (speed <= zero + c.dx) & (x_new >= zero + c.leave_low) & (x_new <= zero + c.leave_high) & (finite == zero);
        if (!(fine[0] && fine[1] && fine[2])) {
            bool is_finite = true, is_slow = true, is_inside = true;
            for (int k = 0; k < 3; ++k) {
                is_finite = is_finite && v3[k] - v3[k] == Real(0);
                for (int r = 0; r < 3; ++r) is_finite = is_finite && C_rows.c[r][k] - C_rows.c[r][k] == Real(0);
                is_slow = is_slow && !(speed[k] > c.dx);
                is_inside = is_inside && !(x_new[k] < c.leave_low) && !(x_new[k] > c.leave_high);
            }
            const int64_t here = ((int64_t)step << 31) + p;
            int64_t* const flag = (int64_t*)faults.data + 3 * copy + (is_finite ? is_slow ? 2 : 1 : 0);
            if (!(is_finite && is_slow && is_inside) && here < *flag) *flag = here;
        }
    }

//// trial
    for (int p = 0; p < c.copies * c.particles; ++p)
        store_rows(
            (Real*)F_trial.data + 9 * p,
            trial_of(load_rows((const Real*)C_after.data + 9 * p), load_rows((const Real*)F.data + 9 * p)));

//// g2p_adjoint
    for (int p = 0; p < c.copies * c.particles; ++p) {
        const int copy = c.copies > 1 ? p / c.particles : 0;
        if (HELD && ((const Real*)mass.data)[p] == Real(0)) continue;
        const Stencil s = stencil((const Real*)x.data + 3 * p, copy);
        Four slope[3];
        slopes(s.f, slope);
        const Columns g = load_rows((const Real*)grad_F_trial.data + 9 * p), g_T = transposed(g);
        const Columns F_rows = load_rows((const Real*)F.data + 9 * p), C_T = transposed(load_rows((const Real*)C_after.data + 9 * p));
        const Columns g_C = transposed(load_rows((const Real*)grad_C.data + 9 * p));
        Columns grad_F_rows, D;
        for (int k = 0; k < 3; ++k) {
            grad_F_rows.c[k] = g.c[k] + dt * times(g, C_T.c[k]);
            D.c[k] = (Real(4) * inv_dx) * (g_C.c[k] + dt * times(g_T, F_rows.c[k]));
        }
        store_rows((Real*)grad_F.data + 9 * p, grad_F_rows);
        const Four x_new = load3((const Real*)x_after.data + 3 * p);
        Four g_x = load3((const Real*)grad_x.data + 3 * p);
        g_x = ((x_new > zero + c.clamp_low) & (x_new < zero + c.clamp_high)) ? g_x : zero;
        const Four g_v = load3((const Real*)grad_v.data + 3 * p) + dt * g_x;
        const Row w = spread(s.w, 2), by_i = repeat(D.c[0]), by_j = repeat(D.c[1]);
        Row u_i = repeat(g_v - times(D, s.f)) + steps * repeat(D.c[2]), along_i, along_j, along_k;
        for (int i = 0; i < 3; ++i) {
            Row u_ij = u_i, sum, sloped;
            for (int j = 0; j < 3; ++j) {
                const size_t at = s.first + (i * n + j) * n;
                *(Row*)((Four*)grad_grid.data + at) += ((s.w[i][0] * s.w[j][1]) * w) * u_ij;
                const Row vu = *(const Row*)((const Four*)grid_v.data + at) * u_ij;
                add(j == 0, sum, s.w[j][1], vu);
                add(j == 0, sloped, slope[j][1], vu);
                u_ij += by_j;
            }
            add(i == 0, along_i, slope[i][0], sum);
            add(i == 0, along_j, s.w[i][0], sloped);
            add(i == 0, along_k, s.w[i][0], sum);
            u_i += by_i;
        }
        const Four v_new = load3((const Real*)v_after.data + 3 * p);
        const Four moving = each_sum(
            folded(w * along_i) - D.c[0] * v_new, folded(w * along_j) - D.c[1] * v_new,
            folded(spread(slope, 2) * along_k) - D.c[2] * v_new);
        store3((Real*)grad_x.data + 3 * p, g_x + inv_dx * moving);
    }

//// grid_adjoint
    const int* const span = (const int*)spans.data;
    for (int row = 0; row < c.copies * lines; ++row) {
        const int at = row / lines * 4 * lines + row % lines, low = span[at + 2 * lines], high = span[at + 3 * lines];
        for (size_t node = (size_t)row * n + low; node <= (size_t)row * n + high && low <= high; ++node) {
            const Four mv = ((const Four*)grid.data)[node], v = mv / mv[3];
            Four& g = ((Four*)grad_grid.data)[node];
            Four g_mv = g / mv[3];
            g_mv[3] = -(g_mv[0] * v[0] + g_mv[1] * v[1] + g_mv[2] * v[2]);
            g = mv[3] > Real(0) ? g_mv : zero;
        }
    }

//// p2g_adjoint
    for (int p = 0; p < c.copies * c.particles; ++p) {
        const int copy = c.copies > 1 ? p / c.particles : 0;
        const Stencil s = stencil((const Real*)x.data + 3 * p, copy);
        const Momentum u = momentum(p, s.f);
        Four slope[3], wd[3];
        slopes(s.f, slope);
        moments(s, wd);
        const Row w = spread(s.w, 2), by_i = repeat(u.A.c[0]), by_j = repeat(u.A.c[1]);
        Row q_i = repeat(u.q) + steps * repeat(u.A.c[2]);
        Row all, moment_i, moment_j, along_i, along_j, along_k;
        for (int i = 0; i < 3; ++i) {
            Row q_ij = q_i, sum, moment, sum_q, sloped;
            for (int j = 0; j < 3; ++j) {
                const Row g = *(const Row*)((const Four*)grad_grid.data + s.first + (i * n + j) * n), gq = g * q_ij;
                add(j == 0, sum, s.w[j][1], g);
                add(j == 0, moment, wd[j][1], g);
                add(j == 0, sum_q, s.w[j][1], gq);
                add(j == 0, sloped, slope[j][1], gq);
                q_ij += by_j;
            }
            add(i == 0, all, s.w[i][0], sum);
            add(i == 0, moment_i, wd[i][0], sum);
            add(i == 0, moment_j, s.w[i][0], moment);
            add(i == 0, along_i, slope[i][0], sum_q);
            add(i == 0, along_j, s.w[i][0], sloped);
            add(i == 0, along_k, s.w[i][0], sum_q);
            q_i += by_i;
        }
        const Real m = ((const Real*)mass.data)[p];
        const Four g = SHUFFLE(folded(w * all), zero, 0, 1, 2, 4);
        const Columns g_A = transposed({{c.dx * folded(w * moment_i), c.dx * folded(w * moment_j), c.dx * folded(spread(wd, 2) * all)}});
        Columns g_C, g_tau;
        for (int k = 0; k < 3; ++k) g_C.c[k] = m * g_A.c[k], g_tau.c[k] = -u.stress * g_A.c[k];
        store3((Real*)grad_v.data + 3 * p, m * g);
        store_rows((Real*)grad_C.data + 9 * p, g_C);
        store_rows((Real*)grad_tau.data + 9 * p, g_tau);
        // the sums over the four components of a node, of which the last is the mass
        const Columns moving = {{folded(w * along_i), folded(w * along_j), folded(spread(slope, 2) * along_k)}};
        const Four from_mass = {moving.c[0][3], moving.c[1][3], moving.c[2][3], Real(0)};
        const Four from_momentum = each_sum(
            moving.c[0] - u.A.c[0] * g, moving.c[1] - u.A.c[1] * g, moving.c[2] - u.A.c[2] * g);
        Real* const gx = (Real*)grad_x.data + 3 * p;
        store3(gx, load3(gx) + inv_dx * (from_mass + from_momentum));
    }

//// end
    #undef SHUFFLE
    #undef INLINE
