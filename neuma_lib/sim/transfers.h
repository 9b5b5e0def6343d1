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
    // Row k of F_trial = (I + dt C) F. Numbers of C come from memory, see `Block`.
    auto trial_of = [&](const Columns& F_rows, const Real* C, int k) INLINE {
        return F_rows.c[k] + dt * (F_rows.c[0] * C[3 * k] + F_rows.c[1] * C[3 * k + 1] + F_rows.c[2] * C[3 * k + 2]);
    };
    auto store_trial = [&](Real* out, const Real* F, const Real* C) INLINE {
        const Columns rows = load_rows(F);
        store_rows(out, {{trial_of(rows, C, 0), trial_of(rows, C, 1), trial_of(rows, C, 2)}});
    };
    // First or later addition to a sum
    auto add = [](bool first, Row& sum, Real w, const Row& a) INLINE {
        if (first)
            sum = w * a;
        else
            sum += w * a;
    };
    const Row steps = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0};

//// lanes
    // Vectors of up to 16 particles, one per lane
    auto load_lanes = [](const Real* p, int used, Row* x) INLINE {
        if (used == 16) {
            const Row a = *(const Row*)p, b = *(const Row*)(p + 16), d = *(const Row*)(p + 32);
            #define LOW(i) SHUFFLE(a, b, i, i + 3, i + 6, i + 9, i + 12, i + 15, i + 18, i + 21, i + 24, i + 27, \
                i > 1 ? -1 : i + 30, -1, -1, -1, -1, -1)
            x[0] = SHUFFLE(LOW(0), d, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29);
            x[1] = SHUFFLE(LOW(1), d, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30);
            x[2] = SHUFFLE(LOW(2), d, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31);
            #undef LOW
        } else
            for (int l = 0; l < 16; ++l)
                for (int axis = 0; axis < 3; ++axis) x[axis][l] = p[3 * (l < used ? l : 0) + axis];
    };

//// block
    // Weights of up to 16 particles, one per lane. Loops over the particles read them as scalars from memory, which costs
    // less than to move them between lanes.
    typedef int Indices __attribute__((vector_size(16 * sizeof(int)), aligned(sizeof(int))));
    struct Block {
        Real f[3][16];  // distance from the first node [dx]
        Real w[3][3][16], wd[3][3][16], slope[3][3][16];  // by axis and node: weights, moments and slopes
        Real w_ij[9][16];  // products of the weights of the first two axes
        int first[16], line[16], k[16];  // first node, its row in the grid of the copy, and its place in the row
    };
    Block block;
    auto prepare = [&](const Real* p, int used, int copy) INLINE {
        Row x[3];
        load_lanes(p, used, x);
        Indices base[3];
        const Row none = {}, last = none + Real(n - 3);
        for (int axis = 0; axis < 3; ++axis) {
            const Row scaled = x[axis] * inv_dx;
            Row low = scaled - (Real(c.first) + Real(0.5));
            low = low > none ? low : none;  // also for values that are not numbers
            low = low < last ? low : last;
            base[axis] = __builtin_convertvector(low, Indices);
            const Row f = scaled - (__builtin_convertvector(base[axis], Row) + Real(c.first));
            const Row left = Real(1.5) - f, middle = f - Real(1), right = f - Real(0.5);
            const Row w[3] = {Real(0.5) * left * left, Real(0.75) - middle * middle, Real(0.5) * right * right};
            const Row slope[3] = {-left, Real(2) - Real(2) * f, right};
            *(Row*)block.f[axis] = f;
            for (int k = 0; k < 3; ++k) {
                *(Row*)block.w[axis][k] = w[k];
                *(Row*)block.wd[axis][k] = w[k] * (Real(k) - f);
                *(Row*)block.slope[axis][k] = slope[k];
            }
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                *(Row*)block.w_ij[3 * i + j] = *(const Row*)block.w[0][i] * *(const Row*)block.w[1][j];
        const Indices line = base[0] * n + base[1];
        *(Indices*)block.line = line;
        *(Indices*)block.k = base[2];
        *(Indices*)block.first = (copy * n * n + line) * n + base[2];
    };
    // Four numbers of an axis spread over the lanes of a row
    auto spread = [&](const Real (*w)[16], int l) INLINE {
        const Real w0 = w[0][l], w1 = w[1][l], w2 = w[2][l];
        const Four a = {w0, w0, w0, w0}, b = {w1, w1, w1, w1}, d = {w2, w2, w2, w2};
        const Eight ab = SHUFFLE(a, b, 0, 1, 2, 3, 4, 5, 6, 7), d0 = SHUFFLE(d, zero, 0, 1, 2, 3, 4, 5, 6, 7);
        return SHUFFLE(ab, d0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    };
    #define EACH_BLOCK                                                                                       \
        for (int copy = 0; copy < c.copies; ++copy)                                                          \
            for (int begin = copy * c.particles, stop = begin + c.particles, used; begin < stop; begin += used)
    #define OPEN_BLOCK used = stop - begin < 16 ? stop - begin : 16

// First and last node that particles touch in each row, from those of the rows of their first nodes. Nodes outside are
// zero. `spans` has six numbers per row of a copy, one after the other: the first and the last of first nodes, of a sum
// over one axis, and of all nodes.
//// spans
    const int lines = n * n;
    auto clear = [&](int copy, Real* nodes, int grids, size_t size) {
        int* const span = (int*)spans.data + 6 * lines * copy;
        for (int r = 0; r < lines; ++r) {
            const int low = span[4 * lines + r], count = span[5 * lines + r] + 1 - low;
            for (int g = 0; g < (count > 0 ? grids : 0); ++g) {
                Four* const p = (Four*)(nodes + g * size) + ((size_t)copy * lines + r) * n + low;
                for (int k = 0; k < count; ++k) p[k] = zero;
            }
            span[r] = n, span[lines + r] = -3;
        }
    };
    auto grow = [&](int copy) {
        // The last two rows of an axis have no first nodes, so that the rows before another may be those of the last i.
        int* const span = (int*)spans.data + 6 * lines * copy;
        for (int axis = 1; axis >= 0; --axis) {
            const int stride = axis ? 1 : n, added = axis ? 0 : 2;
            const int *low = span + (axis ? 0 : 2 * lines), *high = low + lines;
            int *__restrict row_low = span + (axis ? 2 : 4) * lines, *__restrict row_high = row_low + lines;
            for (int r = 0; r < 2 * stride; ++r) {
                const int before = r < stride ? r : r - stride;
                row_low[r] = low[before] < low[r] ? low[before] : low[r];
                row_high[r] = (high[before] > high[r] ? high[before] : high[r]) + added;
            }
            for (int r = 2 * stride; r < lines; ++r) {
                const int a = low[r - stride] < low[r] ? low[r - stride] : low[r], b = low[r - 2 * stride];
                const int d = high[r - stride] > high[r] ? high[r - stride] : high[r], e = high[r - 2 * stride];
                row_low[r] = a < b ? a : b;
                row_high[r] = (d > e ? d : e) + added;
            }
        }
    };

// Nodes that particles touch of a step, one after the other, with their spans and, last, whether they fit.
//// keep
    const int rows_kept = c.copies * lines;
    auto span_of = [&](int row) INLINE { return (int*)spans.data + (row / lines * 6 + 4) * lines + row % lines; };
    int* const kept_span = (int*)kept_spans.data;
    auto keep_nodes = [&] {
        const int room = kept.shape[0];
        int used = 0;
        for (int row = 0; row < rows_kept; ++row) {
            const int low = span_of(row)[0], high = span_of(row)[lines], count = high < low ? 0 : high + 1 - low;
            kept_span[2 * row] = low, kept_span[2 * row + 1] = high;
            if (count > room - used) break;
            for (int k = 0; k < count; ++k)
                ((Four*)kept.data)[used + k] = ((const Four*)grid.data)[(size_t)row * n + low + k];
            used += count;
            if (row == rows_kept - 1) {
                kept_span[2 * rows_kept] = 1;
                return;
            }
        }
        kept_span[2 * rows_kept] = 0;
    };

// Sets the grid to the kept nodes and clears the gradients of the nodes.
//// restore
    if (!kept_span[2 * rows_kept]) return 0;
    for (int copy = 0; copy < c.copies; ++copy) clear(copy, (Real*)grid.data, grid.shape[0], grid.shape[1] * (size_t)4);
    const Four* next = (const Four*)kept.data;
    for (int row = 0; row < rows_kept; ++row) {
        const int low = kept_span[2 * row], high = kept_span[2 * row + 1];
        span_of(row)[0] = low, span_of(row)[lines] = high;
        for (int k = low; k <= high; ++k) ((Four*)grid.data)[(size_t)row * n + k] = *next++;
    }
    return 1;

//// momentum
    // q = (m v + A d, m) at a node and what it grows by from node to node, as in `kernels.p2g`: rows of equal columns
    struct Momentum { Row q, A[3]; Real stress; };
    const Real stress_factor = Real(4) * dt * inv_dx * inv_dx;
    auto momentum = [&](int p, int l) INLINE {
        const Real m = ((const Real*)mass.data)[p], m_dx = c.dx * m;
        Momentum r;
        r.stress = stress_factor * ((const Real*)vol0.data)[p];
        const Real stress_dx = c.dx * r.stress;
        const Real *pC = (const Real*)C.data + 9 * p, *pT = (const Real*)tau.data + 9 * p, *pv = (const Real*)v.data + 3 * p;
        const Eight a = m_dx * *(const Eight*)pC - stress_dx * *(const Eight*)pT;
        const Eight b = {m_dx * pC[8] - stress_dx * pT[8]};
        r.A[0] = SHUFFLE(a, b, 0, 3, 6, 9, 0, 3, 6, 9, 0, 3, 6, 9, 0, 3, 6, 9);
        r.A[1] = SHUFFLE(a, b, 1, 4, 7, 9, 1, 4, 7, 9, 1, 4, 7, 9, 1, 4, 7, 9);
        r.A[2] = SHUFFLE(a, b, 2, 5, 8, 9, 2, 5, 8, 9, 2, 5, 8, 9, 2, 5, 8, 9);
        r.q = m * repeat(Four{pv[0], pv[1], pv[2], Real(1)}) - block.f[0][l] * r.A[0] - block.f[1][l] * r.A[1] +
            (steps - block.f[2][l]) * r.A[2];
        return r;
    };

//// p2g
    Four* const nodes = (Four*)grid.data;
    for (int copy = 0; copy < c.copies; ++copy) clear(copy, (Real*)grid.data, grid.shape[0], grid.shape[1] * (size_t)4);
    EACH_BLOCK {
        OPEN_BLOCK;
        prepare((const Real*)x.data + 3 * begin, used, copy);
        int* const span = (int*)spans.data + 6 * lines * copy;
        for (int l = 0; l < used; ++l) {
            const Momentum u = momentum(begin + l, l);
            const Row w = spread(block.w[2], l), by_i = w * u.A[0], by_j = w * u.A[1];
            Row q_i = w * u.q;
            const int line = block.line[l], k = block.k[l];
            span[line] = k < span[line] ? k : span[line];
            span[lines + line] = k > span[lines + line] ? k : span[lines + line];
            Four* const node = nodes + block.first[l];
            for (int i = 0; i < 3; ++i) {
                Row q_ij = q_i;
                for (int j = 0; j < 3; ++j) {
                    *(Row*)(node + (i * n + j) * n) += block.w_ij[3 * i + j][l] * q_ij;
                    if (j < 2) q_ij += by_j;
                }
                q_i += by_i;
            }
        }
    }
    for (int copy = 0; copy < c.copies; ++copy) grow(copy);
    keep_nodes();

// v_i = (m v)_i / m_i + dt g without walls and clamps
//// grid_update
    const int lines = n * n;
    const Four gain = dt * Four{c.gravity[0], c.gravity[1], c.gravity[2], Real(0)};
    const int* const span = (const int*)spans.data;
    for (int row = 0; row < c.copies * lines; ++row) {
        const int at = (row / lines * 6 + 4) * lines + row % lines, low = span[at], high = span[at + lines];
        for (size_t node = (size_t)row * n + low; node <= (size_t)row * n + high && low <= high; ++node) {
            const Four mv = ((const Four*)grid.data)[node], v = mv / mv[3] + gain;
            ((Four*)grid_v.data)[node] = mv[3] > Real(0) ? v : zero;
        }
    }

//// g2p
    const Real factor = Real(4) * inv_dx;
    auto fault = [&](int p, int copy) {
        if (HELD && ((const Real*)mass.data)[p] == Real(0)) return;
        const Real *px = (const Real*)x_after.data + 3 * p, *pv = (const Real*)v_after.data + 3 * p;
        const Real* const pC = (const Real*)C_after.data + 9 * p;
        bool is_finite = true, is_slow = true, is_inside = true;
        for (int k = 0; k < 9; ++k) is_finite = is_finite && pC[k] - pC[k] == Real(0);
        for (int k = 0; k < 3; ++k) {
            is_finite = is_finite && pv[k] - pv[k] == Real(0);
            is_slow = is_slow && !(dt * pv[k] > c.dx) && !(dt * pv[k] < -c.dx);
            is_inside = is_inside && !(px[k] < c.leave_low) && !(px[k] > c.leave_high);
        }
        const int64_t here = ((int64_t)step << 31) + p;
        int64_t* const flag = (int64_t*)faults.data + 3 * copy + (is_finite ? is_slow ? 2 : 1 : 0);
        if (!(is_finite && is_slow && is_inside) && here < *flag) *flag = here;
    };
    EACH_BLOCK {
        OPEN_BLOCK;
        prepare((const Real*)x.data + 3 * begin, used, copy);
        for (int l = 0; l < used; ++l) {
            const int p = begin + l;
            Row all, along_i, along_j;
            for (int i = 0; i < 3; ++i) {
                Row sum, moment;
                for (int j = 0; j < 3; ++j) {
                    const Row row = *(const Row*)((const Four*)grid_v.data + block.first[l] + (i * n + j) * n);
                    add(j == 0, sum, block.w[1][j][l], row);
                    add(j == 0, moment, block.wd[1][j][l], row);
                }
                add(i == 0, all, block.w[0][i][l], sum);
                add(i == 0, along_i, block.wd[0][i][l], sum);
                add(i == 0, along_j, block.w[0][i][l], moment);
            }
            const Row w = spread(block.w[2], l), w_factor = factor * w;
            store3((Real*)v_after.data + 3 * p, folded(w * all));
            Real* const pC = (Real*)C_after.data + 9 * p;
            store_rows(pC, transposed({{folded(w_factor * along_i), folded(w_factor * along_j),
                folded(factor * spread(block.wd[2], l) * all)}}));
        }
        const Real *pv = (const Real*)v_after.data + 3 * begin, *pC = (const Real*)C_after.data + 9 * begin;
        Real* const px = (Real*)x_after.data + 3 * begin;
        bool fine = true;
        for (int k = 0; k < 3 * used; ++k) {
            Real place = ((const Real*)x.data)[3 * begin + k] + dt * pv[k];
            place = place < c.clamp_high ? place : c.clamp_high;
            place = place > c.clamp_low ? place : c.clamp_low;
            px[k] = place;
            fine &= (dt * pv[k] <= c.dx) & (dt * pv[k] >= -c.dx) & (place >= c.leave_low) & (place <= c.leave_high);
        }
        for (int k = 0; k < 9 * used; ++k) fine &= pC[k] - pC[k] == Real(0);
        if (!fine)
            for (int l = 0; l < used; ++l) fault(begin + l, copy);
        for (int p = begin; p < begin + used; ++p)
            store_trial((Real*)F_trial.data + 9 * p, (const Real*)F.data + 9 * p, (const Real*)C_after.data + 9 * p);
    }

//// trial
    for (int p = 0; p < c.copies * c.particles; ++p)
        store_trial((Real*)F_trial.data + 9 * p, (const Real*)F.data + 9 * p, (const Real*)C_after.data + 9 * p);

//// g2p_adjoint
    Real g_x[52], g_v[52];
    EACH_BLOCK {
        OPEN_BLOCK;
        prepare((const Real*)x.data + 3 * begin, used, copy);
        for (int k = 0; k < 3 * used; ++k) {
            const Real place = ((const Real*)x_after.data)[3 * begin + k], g = ((const Real*)grad_x.data)[3 * begin + k];
            g_x[k] = place > c.clamp_low && place < c.clamp_high ? g : Real(0);
            g_v[k] = ((const Real*)grad_v.data)[3 * begin + k] + dt * g_x[k];
        }
        for (int l = 0; l < used; ++l) {
            const int p = begin + l;
            if (HELD && ((const Real*)mass.data)[p] == Real(0)) continue;
            const Columns g = load_rows((const Real*)grad_F_trial.data + 9 * p), g_T = transposed(g);
            const Columns g_C = transposed(load_rows((const Real*)grad_C.data + 9 * p));
            const Real *pF = (const Real*)F.data + 9 * p, *pC = (const Real*)C_after.data + 9 * p;
            Columns grad_F_rows;
            Four D[3];
            for (int k = 0; k < 3; ++k) {
                grad_F_rows.c[k] = g.c[k] + dt * (g.c[0] * pC[k] + g.c[1] * pC[3 + k] + g.c[2] * pC[6 + k]);
                D[k] = (Real(4) * inv_dx) *
                    (g_C.c[k] + dt * (g_T.c[0] * pF[3 * k] + g_T.c[1] * pF[3 * k + 1] + g_T.c[2] * pF[3 * k + 2]));
            }
            store_rows((Real*)grad_F.data + 9 * p, grad_F_rows);
            const Row w = spread(block.w[2], l), by_i = repeat(D[0]), by_j = repeat(D[1]);
            Row u_i = repeat(load3(g_v + 3 * l)) - block.f[0][l] * by_i - block.f[1][l] * by_j +
                (steps - block.f[2][l]) * repeat(D[2]);
            Row along_i, along_j, along_k;
            for (int i = 0; i < 3; ++i) {
                Row u_ij = u_i, sum, sloped;
                for (int j = 0; j < 3; ++j) {
                    const size_t at = block.first[l] + (i * n + j) * n;
                    *(Row*)((Four*)grad_grid.data + at) += block.w_ij[3 * i + j][l] * (w * u_ij);
                    const Row vu = *(const Row*)((const Four*)grid_v.data + at) * u_ij;
                    add(j == 0, sum, block.w[1][j][l], vu);
                    add(j == 0, sloped, block.slope[1][j][l], vu);
                    if (j < 2) u_ij += by_j;
                }
                add(i == 0, along_i, block.slope[0][i][l], sum);
                add(i == 0, along_j, block.w[0][i][l], sloped);
                add(i == 0, along_k, block.w[0][i][l], sum);
                u_i += by_i;
            }
            const Four v_new = load3((const Real*)v_after.data + 3 * p);
            const Four moving = each_sum(
                folded(w * along_i) - D[0] * v_new, folded(w * along_j) - D[1] * v_new,
                folded(spread(block.slope[2], l) * along_k) - D[2] * v_new);
            store3((Real*)grad_x.data + 3 * p, load3(g_x + 3 * l) + inv_dx * moving);
        }
    }

//// grid_adjoint
    const int lines = n * n;
    const int* const span = (const int*)spans.data;
    for (int row = 0; row < c.copies * lines; ++row) {
        const int at = (row / lines * 6 + 4) * lines + row % lines, low = span[at], high = span[at + lines];
        for (size_t node = (size_t)row * n + low; node <= (size_t)row * n + high && low <= high; ++node) {
            const Four mv = ((const Four*)grid.data)[node], v = mv / mv[3];
            Four& g = ((Four*)grad_grid.data)[node];
            Four g_mv = g / mv[3];
            g_mv[3] = -(g_mv[0] * v[0] + g_mv[1] * v[1] + g_mv[2] * v[2]);
            g = mv[3] > Real(0) ? g_mv : zero;
        }
    }

//// p2g_adjoint
    EACH_BLOCK {
        OPEN_BLOCK;
        prepare((const Real*)x.data + 3 * begin, used, copy);
        for (int l = 0; l < used; ++l) {
            const int p = begin + l;
            const Momentum u = momentum(p, l);
            Row q_i = u.q, all, moment_i, moment_j, along_i, along_j, along_k;
            for (int i = 0; i < 3; ++i) {
                Row q_ij = q_i, sum, moment, sum_q, sloped;
                for (int j = 0; j < 3; ++j) {
                    const Row g = *(const Row*)((const Four*)grad_grid.data + block.first[l] + (i * n + j) * n);
                    const Row gq = g * q_ij;
                    add(j == 0, sum, block.w[1][j][l], g);
                    add(j == 0, moment, block.wd[1][j][l], g);
                    add(j == 0, sum_q, block.w[1][j][l], gq);
                    add(j == 0, sloped, block.slope[1][j][l], gq);
                    if (j < 2) q_ij += u.A[1];
                }
                add(i == 0, all, block.w[0][i][l], sum);
                add(i == 0, moment_i, block.wd[0][i][l], sum);
                add(i == 0, moment_j, block.w[0][i][l], moment);
                add(i == 0, along_i, block.slope[0][i][l], sum_q);
                add(i == 0, along_j, block.w[0][i][l], sloped);
                add(i == 0, along_k, block.w[0][i][l], sum_q);
                q_i += u.A[0];
            }
            const Real m = ((const Real*)mass.data)[p];
            const Row w = spread(block.w[2], l), w_dx = c.dx * w;
            const Four g = SHUFFLE(folded(w * all), zero, 0, 1, 2, 4);
            const Columns g_A = transposed({{folded(w_dx * moment_i), folded(w_dx * moment_j),
                folded(c.dx * spread(block.wd[2], l) * all)}});
            Columns g_C, g_tau;
            for (int k = 0; k < 3; ++k) g_C.c[k] = m * g_A.c[k], g_tau.c[k] = -u.stress * g_A.c[k];
            store3((Real*)grad_v.data + 3 * p, m * g);
            store_rows((Real*)grad_C.data + 9 * p, g_C);
            store_rows((Real*)grad_tau.data + 9 * p, g_tau);
            // sums over the four components of a node, of which the last is the mass
            const Four along[3] = {folded(w * along_i), folded(w * along_j), folded(spread(block.slope[2], l) * along_k)};
            #define COLUMN(a) SHUFFLE(u.A[a], u.A[a], 0, 1, 2, 3)
            const Four from_momentum = each_sum(
                along[0] - COLUMN(0) * g, along[1] - COLUMN(1) * g, along[2] - COLUMN(2) * g);
            #undef COLUMN
            const Four from_mass = {along[0][3], along[1][3], along[2][3], Real(0)};
            Real* const gx = (Real*)grad_x.data + 3 * p;
            store3(gx, load3(gx) + inv_dx * (from_mass + from_momentum));
        }
    }

// Particles that may touch an obstacle: those near a face of the unit cube, or all if there are other obstacles. The others
// keep their velocity and have no displacement.
//// near
    int count = 0;
    const int N = c.copies * c.particles;
    for (int k = 0; k < 3 * N; ++k) ((Real*)v_now.data)[k] = ((const Real*)v.data)[k];
    for (int k = 0; k < 3 * N; ++k) ((Real*)stuck.data)[k] = Real(0);
    if (others)
        for (; count < N; ++count) ((int*)near.data)[count] = count;
    else
        for (int begin = 0; begin < N; begin += 16) {
            const int used = N - begin < 16 ? N - begin : 16;
            Row x_p[3], r;
            load_lanes((const Real*)x.data + 3 * begin, used, x_p);
            for (int l = 0; l < 16; ++l) r[l] = ((const Real*)radius.data)[begin + (l < used ? l : 0)];
            const Row far = Real(1) - r;
            auto outside = (x_p[0] < r) | (x_p[0] > far);
            for (int axis = 1; axis < 3; ++axis) outside |= (x_p[axis] < r) | (x_p[axis] > far);
            bool any = false;
            for (int l = 0; l < 16; ++l) any |= outside[l] != 0;
            for (int l = 0; l < (any ? used : 0); ++l)
                if (outside[l]) ((int*)near.data)[count++] = begin + l;
        }
    return count;

// Clears what is between the particles that may touch an obstacle.
//// far
    for (int q = 0, p = 0; q <= count; ++q) {
        const int next = q < count ? ((const int*)near.data)[q] : c.copies * c.particles;
        for (; p < next; ++p)
            for (int k = 0; k < 3; ++k) ((Real*)grad_stuck.data)[3 * p + k] = Real(0);
        p = next + 1;
    }

//// end
    #undef SHUFFLE
    #undef INLINE
    #undef EACH_BLOCK
    #undef OPEN_BLOCK
