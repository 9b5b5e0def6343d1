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
    typedef Row Pack;
    const int WIDTH = 16;
    #define LANE(x, l) ((Real*)&(x))[l]
    #define SHUFFLE __builtin_shufflevector
    #define INLINE __attribute__((always_inline))
    const int n = c.n;
    const Real inv_dx = c.inv_dx, dt = c.dt;
    const Four zero = {};
    // First or later addition to a sum. An argument of 512 bits also makes LLVM use registers of that size.
    auto add = [](bool first, Row& sum, Real w, Row a) INLINE {
        if (first)
            sum = w * a;
        else
            sum += w * a;
    };
    const Row steps = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0};

//// lanes
    // Vectors and matrices of up to 16 particles, with a row for each number and a particle per lane
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
    auto store_lanes = [](Real* p, int used, const Row* x) INLINE {
        if (used == 16) {
            *(Row*)(p + 0) = SHUFFLE(SHUFFLE(x[0], x[1], 0, 16, -1, 1, 17, -1, 2, 18, -1, 3, 19, -1, 4, 20, -1, 5), x[2],
                0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15);
            *(Row*)(p + 16) = SHUFFLE(SHUFFLE(x[0], x[1], 21, -1, 6, 22, -1, 7, 23, -1, 8, 24, -1, 9, 25, -1, 10, 26), x[2],
                0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15);
            *(Row*)(p + 32) = SHUFFLE(SHUFFLE(x[0], x[1], -1, 11, 27, -1, 12, 28, -1, 13, 29, -1, 14, 30, -1, 15, 31, -1), x[2],
                26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31);
        } else
            for (int l = 0; l < used; ++l)
                for (int axis = 0; axis < 3; ++axis) p[3 * l + axis] = x[axis][l];
    };
    auto load_matrices = [](const Real* p, int used, Row* x) INLINE { Matrices::load(p, used, x, false); };
    auto store_matrices = [](Real* p, int used, const Row* x) INLINE { Matrices::store(p, used, x); };
    auto load_numbers = [](const Real* p, int used) INLINE {
        if (used == 16) return *(const Row*)p;
        Row x = {};
        for (int l = 0; l < used; ++l) x[l] = p[l];
        return x;
    };
    // F_trial = (I + dt C) F
    auto store_trial = [&](Real* out, const Real* from, const Row* C, int used) INLINE {
        Row F[9], trial[9];
        load_matrices(from, used, F);
        for (int k = 0; k < 9; ++k) {
            const int i = k / 3 * 3, j = k % 3;
            trial[k] = F[k] + dt * (C[i] * F[j] + C[i + 1] * F[3 + j] + C[i + 2] * F[6 + j]);
        }
        store_matrices(out, used, trial);
    };

//// block
    // Weights of up to 16 particles, one per lane. Loops over the particles read them as scalars from memory, which costs
    // less than to move them between lanes.
    typedef int Indices __attribute__((vector_size(16 * sizeof(int)), aligned(sizeof(int))));
    struct Block {
        Real f[3][16];  // distance from the first node [dx]
        Real w[3][3][16], wd[3][3][16], slope[3][3][16];  // by axis and node: weights, moments and slopes
        Real w_ij[9][16];  // products of the weights of the first two axes
        int first[16], line[16], k[16];  // first node, its row in the grid of the body, and its place in the row
    };
    Block block;
    auto prepare = [&](const Real* p, int used, int field) INLINE {
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
        *(Indices*)block.first = (field * n * n + line) * n + base[2];
    };
    // Four numbers of an axis spread over the lanes of a row
    auto spread = [&](const Real (*w)[16], int l) INLINE {
        const Real w0 = w[0][l], w1 = w[1][l], w2 = w[2][l];
        const Four a = {w0, w0, w0, w0}, b = {w1, w1, w1, w1}, d = {w2, w2, w2, w2};
        const Eight ab = SHUFFLE(a, b, 0, 1, 2, 3, 4, 5, 6, 7), d0 = SHUFFLE(d, zero, 0, 1, 2, 3, 4, 5, 6, 7);
        return SHUFFLE(ab, d0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    };
    // Of each particle of a block: a row of numbers of three nodes, and the sum over the nodes with weights w
    typedef Real Rows[16][16];
    auto add_nodes = [&](const Rows& rows, const Real (*w)[16], Row* sum) INLINE {
        for (int node = 0; node < 3; ++node) {
            Row x[4];
            Matrices::load_four(rows[0] + 4 * node, 16, x);
            for (int k = 0; k < 4; ++k) sum[k] = node ? sum[k] + *(const Row*)w[node] * x[k] : *(const Row*)w[node] * x[k];
        }
    };
    auto add_all = [&](const Rows& rows, const Real (*w)[16]) INLINE {
        Row sum[4];
        add_nodes(rows, w, sum);
        return (sum[0] + sum[1]) + (sum[2] + sum[3]);
    };
    // Three equal columns of four numbers
    auto repeat = [](const Real* p) INLINE {
        const Four a = *(const Four*)p;
        return SHUFFLE(a, a, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
    };
    #define EACH_BLOCK                                                                                       \
        for (int range = 0; range < c.copies * c.ranges; ++range)                                            \
            for (int copy = range / c.ranges, own = range % c.ranges, field = copy * c.bodies + c.body_of[own], \
                     begin = copy * c.particles + c.starts[own], stop = copy * c.particles + c.starts[own + 1], \
                     used; begin < stop; begin += used)
    #define OPEN_BLOCK used = stop - begin < 16 ? stop - begin : 16

// First and last node that particles touch in each row, from those of the rows of their first nodes. Nodes outside are
// zero. `spans` has six numbers per row of a body in a copy, one after the other: the first and the last of first nodes, of a sum
// over one axis, and of all nodes.
//// spans
    const int lines = n * n;
    auto clear = [&](int field, Real* nodes, int grids, size_t size) {
        int* const span = (int*)spans.data + 6 * lines * field;
        for (int r = 0; r < lines; ++r) {
            const int low = span[4 * lines + r], count = span[5 * lines + r] + 1 - low;
            for (int g = 0; g < (count > 0 ? grids : 0); ++g) {
                Four* const p = (Four*)(nodes + g * size) + ((size_t)field * lines + r) * n + low;
                for (int k = 0; k < count; ++k) p[k] = zero;
            }
            span[r] = n, span[lines + r] = -3;
        }
    };
    auto grow = [&](int field) {
        // The last two rows of an axis have no first nodes, so that the rows before another may be those of the last i.
        int* const span = (int*)spans.data + 6 * lines * field;
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
    const int rows_kept = c.fields * lines;
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
    for (int field = 0; field < c.fields; ++field) clear(field, (Real*)grid.data, grid.shape[0], grid.shape[1] * (size_t)4);
    const Four* next = (const Four*)kept.data;
    for (int row = 0; row < rows_kept; ++row) {
        const int low = kept_span[2 * row], high = kept_span[2 * row + 1];
        span_of(row)[0] = low, span_of(row)[lines] = high;
        for (int k = low; k <= high; ++k) ((Four*)grid.data)[(size_t)row * n + k] = *next++;
    }
    return 1;

//// momentum
    // q = (m v + A d, m) at the first node and columns of A, by which it grows from node to node, as in `kernels.p2g`
    Real momenta[16][16];
    const Real stress_factor = Real(4) * dt * inv_dx * inv_dx;
    auto prepare_momentum = [&](int begin, int used, Row* A, Row& m, Row& stress) INLINE {
        Row T[9], q[3];
        load_matrices((const Real*)C.data + 9 * begin, used, A);
        load_matrices((const Real*)tau.data + 9 * begin, used, T);
        load_lanes((const Real*)v.data + 3 * begin, used, q);
        m = load_numbers((const Real*)mass.data + begin, used);
        stress = stress_factor * load_numbers((const Real*)vol0.data + begin, used);
        Matrices::prefetch((const Real*)C.data + 9 * (begin + 32), 9 * 16);
        Matrices::prefetch((const Real*)tau.data + 9 * (begin + 32), 9 * 16);
        const Row m_dx = c.dx * m, stress_dx = c.dx * stress, none = {};
        for (int k = 0; k < 9; ++k) A[k] = m_dx * A[k] - stress_dx * T[k];
        for (int k = 0; k < 3; ++k) {
            q[k] = m * q[k];
            for (int axis = 0; axis < 3; ++axis) q[k] -= *(const Row*)block.f[axis] * A[3 * k + axis];
        }
        Matrices::store_four(momenta[0], 16, q[0], q[1], q[2], m);
        for (int k = 0; k < 3; ++k) Matrices::store_four(momenta[0] + 4 + 4 * k, 16, A[k], A[3 + k], A[6 + k], none);
    };

//// p2g
    Four* const nodes = (Four*)grid.data;
    for (int field = 0; field < c.fields; ++field) clear(field, (Real*)grid.data, grid.shape[0], grid.shape[1] * (size_t)4);
    EACH_BLOCK {
        OPEN_BLOCK;
        prepare((const Real*)x.data + 3 * begin, used, field);
        int* const span = (int*)spans.data + 6 * lines * field;
        Row A[9], m, stress;
        prepare_momentum(begin, used, A, m, stress);
        for (int l = 0; l < used; ++l) {
            const Real* const from = momenta[l];
            const Row w = spread(block.w[2], l), by_i = w * repeat(from + 4), by_j = w * repeat(from + 8);
            Row q_i = w * (repeat(from) + steps * repeat(from + 12));
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
    for (int field = 0; field < c.fields; ++field) grow(field);
    keep_nodes();

// v_i = (m v)_i / m_i + dt g without walls and clamps
//// grid_update
    const int lines = n * n;
    const Four gain = dt * Four{c.gravity[0], c.gravity[1], c.gravity[2], Real(0)};
    const int* const span = (const int*)spans.data;
    for (int row = 0; row < c.fields * lines; ++row) {
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
    Rows all = {}, along_i = {}, along_j = {};
    EACH_BLOCK {
        OPEN_BLOCK;
        prepare((const Real*)x.data + 3 * begin, used, field);
        for (int l = 0; l < used; ++l) {
            Row total, total_i, total_j;
            for (int i = 0; i < 3; ++i) {
                Row sum, moment;
                for (int j = 0; j < 3; ++j) {
                    const Row row = *(const Row*)((const Four*)grid_v.data + block.first[l] + (i * n + j) * n);
                    add(j == 0, sum, block.w[1][j][l], row);
                    add(j == 0, moment, block.wd[1][j][l], row);
                }
                add(i == 0, total, block.w[0][i][l], sum);
                add(i == 0, total_i, block.wd[0][i][l], sum);
                add(i == 0, total_j, block.w[0][i][l], moment);
            }
            *(Row*)all[l] = total, *(Row*)along_i[l] = total_i, *(Row*)along_j[l] = total_j;
        }
        Matrices::prefetch((Real*)C_after.data + 9 * (begin + 32), 9 * 16);
        Matrices::prefetch((Real*)F_trial.data + 9 * (begin + 32), 9 * 16);
        Matrices::prefetch((Real*)x_after.data + 3 * (begin + 32), 3 * 16);
        Matrices::prefetch((Real*)v_after.data + 3 * (begin + 32), 3 * 16);
        Row v_p[4], place[3], moment[3][4], C_p[9];
        load_lanes((const Real*)x.data + 3 * begin, used, place);
        add_nodes(all, block.w[2], v_p);
        add_nodes(along_i, block.w[2], moment[0]);
        add_nodes(along_j, block.w[2], moment[1]);
        add_nodes(all, block.wd[2], moment[2]);
        const Row none = {};
        auto fine = none == none;
        for (int k = 0; k < 9; ++k) {
            C_p[k] = factor * moment[k % 3][k / 3];
            fine &= C_p[k] - C_p[k] == none;
        }
        for (int k = 0; k < 3; ++k) {
            const Row moved = dt * v_p[k];
            place[k] += moved;
            place[k] = place[k] < c.clamp_high ? place[k] : none + c.clamp_high;
            place[k] = place[k] > c.clamp_low ? place[k] : none + c.clamp_low;
            fine &= (moved <= c.dx) & (moved >= -c.dx) & (place[k] >= c.leave_low) & (place[k] <= c.leave_high);
        }
        store_lanes((Real*)x_after.data + 3 * begin, used, place);
        store_lanes((Real*)v_after.data + 3 * begin, used, v_p);
        store_matrices((Real*)C_after.data + 9 * begin, used, C_p);
        store_trial((Real*)F_trial.data + 9 * begin, (const Real*)F.data + 9 * begin, C_p, used);
        bool all_fine = true;
        for (int l = 0; l < 16; ++l) all_fine &= fine[l] != 0;
        for (int l = 0; l < (all_fine ? 0 : used); ++l) fault(begin + l, copy);
    }

// x += dt v for tracers, as `kernels.advect_tracers`. Those of a block belong to one body.
//// advect
    Rows all = {};
    for (int begin = 0, used; begin < x.shape[0]; begin += used) {
        const int* const first = (const int*)first_of.data + begin;
        int own = 0;
        for (int k = 1; k < c.ranges; ++k) own = first[0] >= c.starts[k] ? k : own;
        for (used = 1; used < 16 && begin + used < x.shape[0] && first[used] == first[0];) ++used;
        Real* const p = (Real*)x.data + 3 * begin;
        prepare(p, used, c.body_of[own]);
        for (int l = 0; l < used; ++l) {
            Row total;
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    const Row row = *(const Row*)((const Four*)grid_v.data + block.first[l] + (i * n + j) * n);
                    add(i + j == 0, total, block.w_ij[3 * i + j][l], row);
                }
            *(Row*)all[l] = total;
        }
        Row v_p[4], place[3];
        load_lanes(p, used, place);
        add_nodes(all, block.w[2], v_p);
        const Row none = {};
        for (int k = 0; k < 3; ++k) {
            Row moved = place[k] + dt * (v_p[k] / v_p[3]);
            moved = moved < c.clamp_high ? moved : none + c.clamp_high;
            moved = moved > c.clamp_low ? moved : none + c.clamp_low;
            place[k] = v_p[3] > none ? moved : place[k];
        }
        store_lanes(p, used, place);
    }

//// trial
    for (int begin = 0, used; begin < c.copies * c.particles; begin += used) {
        used = c.copies * c.particles - begin < 16 ? c.copies * c.particles - begin : 16;
        Row C_p[9];
        load_matrices((const Real*)C_after.data + 9 * begin, used, C_p);
        store_trial((Real*)F_trial.data + 9 * begin, (const Real*)F.data + 9 * begin, C_p, used);
    }

//// g2p_adjoint
    Real motions[16][16];  // u at the first node and columns of D, see `adjoint_kernels.g2p_adjoint`
    Rows along_i = {}, along_j = {}, along_k = {};
    EACH_BLOCK {
        OPEN_BLOCK;
        prepare((const Real*)x.data + 3 * begin, used, field);
        Row g_x[3], g_v[3], place[3], D[9];
        const Row none = {};
        {
            Row g[9], F_p[9], C_p[9], grad_F_p[9];
            Matrices::prefetch((const Real*)F.data + 9 * (begin + 32), 9 * 16);
            load_lanes((const Real*)x_after.data + 3 * begin, used, place);
            load_lanes((const Real*)grad_x.data + 3 * begin, used, g_x);
            load_lanes((const Real*)grad_v.data + 3 * begin, used, g_v);
            load_matrices((const Real*)grad_F_trial.data + 9 * begin, used, g);
            load_matrices((const Real*)grad_C.data + 9 * begin, used, D);
            load_matrices((const Real*)F.data + 9 * begin, used, F_p);
            load_matrices((const Real*)C_after.data + 9 * begin, used, C_p);
            const Row m = HELD ? load_numbers((const Real*)mass.data + begin, used) : none + Real(1);
            const auto free = m != none;
            for (int k = 0; k < 9; ++k) {
                const int i = k / 3, j = k % 3;
                const Row turned = g[k] + dt * (C_p[i] * g[j] + C_p[3 + i] * g[3 + j] + C_p[6 + i] * g[6 + j]);
                grad_F_p[k] = HELD ? free ? turned : g[k] : turned;
                D[k] = (Real(4) * inv_dx) * (D[k] + dt * (
                    g[3 * i] * F_p[3 * j] + g[3 * i + 1] * F_p[3 * j + 1] + g[3 * i + 2] * F_p[3 * j + 2]));
            }
            store_matrices((Real*)grad_F.data + 9 * begin, used, grad_F_p);
            for (int k = 0; k < 3; ++k) {
                const auto inside = (place[k] > c.clamp_low) & (place[k] < c.clamp_high);
                const Row moves = inside ? g_x[k] : none;
                g_v[k] += dt * moves;
                for (int axis = 0; axis < 3; ++axis) g_v[k] -= *(const Row*)block.f[axis] * D[3 * k + axis];
                g_x[k] = HELD ? free ? moves : g_x[k] : moves;
            }
        }
        Matrices::store_four(motions[0], 16, g_v[0], g_v[1], g_v[2], none);
        for (int k = 0; k < 3; ++k) Matrices::store_four(motions[0] + 4 + 4 * k, 16, D[k], D[3 + k], D[6 + k], none);
        for (int l = 0; l < used; ++l) {
            if (HELD && ((const Real*)mass.data)[begin + l] == Real(0)) {
                *(Row*)along_i[l] = *(Row*)along_j[l] = *(Row*)along_k[l] = none;
                continue;
            }
            const Real* const from = motions[l];
            const Row w = spread(block.w[2], l), by_i = repeat(from + 4), by_j = repeat(from + 8);
            Row u_i = repeat(from) + steps * repeat(from + 12), total_i, total_j, total_k;
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
                add(i == 0, total_i, block.slope[0][i][l], sum);
                add(i == 0, total_j, block.w[0][i][l], sloped);
                add(i == 0, total_k, block.w[0][i][l], sum);
                u_i += by_i;
            }
            *(Row*)along_i[l] = total_i, *(Row*)along_j[l] = total_j, *(Row*)along_k[l] = total_k;
        }
        Row v_new[3];
        load_lanes((const Real*)v_after.data + 3 * begin, used, v_new);
        const Row moving[3] = {
            add_all(along_i, block.w[2]), add_all(along_j, block.w[2]), add_all(along_k, block.slope[2])};
        for (int k = 0; k < 3; ++k) {
            const Row change = moving[k] - (D[k] * v_new[0] + D[3 + k] * v_new[1] + D[6 + k] * v_new[2]);
            if (HELD) {
                const Row m = load_numbers((const Real*)mass.data + begin, used);
                g_x[k] = m != none ? g_x[k] + inv_dx * change : g_x[k];
            } else
                g_x[k] += inv_dx * change;
        }
        store_lanes((Real*)grad_x.data + 3 * begin, used, g_x);
    }

//// grid_adjoint
    const int lines = n * n;
    const int* const span = (const int*)spans.data;
    for (int row = 0; row < c.fields * lines; ++row) {
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
    Rows all = {}, moment_i = {}, moment_j = {}, along_i = {}, along_j = {}, along_k = {};
    EACH_BLOCK {
        OPEN_BLOCK;
        prepare((const Real*)x.data + 3 * begin, used, field);
        Row A[9], m, stress;
        prepare_momentum(begin, used, A, m, stress);
        for (int l = 0; l < used; ++l) {
            const Real* const from = momenta[l];
            const Row by_i = repeat(from + 4), by_j = repeat(from + 8);
            Row q_i = repeat(from) + steps * repeat(from + 12);
            Row total, first_i, first_j, total_i, total_j, total_k;
            for (int i = 0; i < 3; ++i) {
                Row q_ij = q_i, sum, moment, sum_q, sloped;
                for (int j = 0; j < 3; ++j) {
                    const Row g = *(const Row*)((const Four*)grad_grid.data + block.first[l] + (i * n + j) * n);
                    const Row gq = g * q_ij;
                    add(j == 0, sum, block.w[1][j][l], g);
                    add(j == 0, moment, block.wd[1][j][l], g);
                    add(j == 0, sum_q, block.w[1][j][l], gq);
                    add(j == 0, sloped, block.slope[1][j][l], gq);
                    if (j < 2) q_ij += by_j;
                }
                add(i == 0, total, block.w[0][i][l], sum);
                add(i == 0, first_i, block.wd[0][i][l], sum);
                add(i == 0, first_j, block.w[0][i][l], moment);
                add(i == 0, total_i, block.slope[0][i][l], sum_q);
                add(i == 0, total_j, block.w[0][i][l], sloped);
                add(i == 0, total_k, block.w[0][i][l], sum_q);
                q_i += by_i;
            }
            *(Row*)all[l] = total, *(Row*)moment_i[l] = first_i, *(Row*)moment_j[l] = first_j;
            *(Row*)along_i[l] = total_i, *(Row*)along_j[l] = total_j, *(Row*)along_k[l] = total_k;
        }
        Row g[4], g_A[3][4], g_v[3], g_C[9], g_tau[9], g_x[3];
        add_nodes(all, block.w[2], g);
        add_nodes(moment_i, block.w[2], g_A[0]);
        add_nodes(moment_j, block.w[2], g_A[1]);
        add_nodes(all, block.wd[2], g_A[2]);
        for (int k = 0; k < 9; ++k) {
            const Row g_k = c.dx * g_A[k % 3][k / 3];
            g_C[k] = m * g_k, g_tau[k] = -stress * g_k;
        }
        store_matrices((Real*)grad_C.data + 9 * begin, used, g_C);
        store_matrices((Real*)grad_tau.data + 9 * begin, used, g_tau);
        load_lanes((const Real*)grad_x.data + 3 * begin, used, g_x);
        // sums over the four components of a node, of which the last is the mass
        const Row moving[3] = {
            add_all(along_i, block.w[2]), add_all(along_j, block.w[2]), add_all(along_k, block.slope[2])};
        for (int k = 0; k < 3; ++k) {
            g_v[k] = m * g[k];
            g_x[k] += inv_dx * (moving[k] - (A[k] * g[0] + A[3 + k] * g[1] + A[6 + k] * g[2]));
        }
        store_lanes((Real*)grad_v.data + 3 * begin, used, g_v);
        store_lanes((Real*)grad_x.data + 3 * begin, used, g_x);
    }

// Particles that may touch an obstacle: those near a face of the unit cube, or all if there are other obstacles. If there are
// some, the others keep their velocity. They have no displacement, as known `again` in the reverse loop.
//// near
    int count = 0;
    const int N = c.copies * c.particles;
    for (int k = 0; k < (again ? 0 : 3 * N); ++k) ((Real*)stuck.data)[k] = Real(0);
    if (others)
        for (; count < N; ++count) ((int*)near.data)[count] = count;
    else
        for (int begin = 0; begin < N; begin += 16) {
            const int used = N - begin < 16 ? N - begin : 16;
            Row x_p[3];
            load_lanes((const Real*)x.data + 3 * begin, used, x_p);
            const Row r = load_numbers((const Real*)radius.data + begin, used), far = Real(1) - r;
            auto outside = (x_p[0] < r) | (x_p[0] > far);
            for (int axis = 1; axis < 3; ++axis) outside |= (x_p[axis] < r) | (x_p[axis] > far);
            bool any = false;
            for (int l = 0; l < 16; ++l) any |= outside[l] != 0;
            for (int l = 0; l < (any ? used : 0); ++l)
                if (outside[l]) ((int*)near.data)[count++] = begin + l;
        }
    for (int k = 0; k < (count ? 3 * N : 0); ++k) ((Real*)v_now.data)[k] = ((const Real*)v.data)[k];
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
    #undef LANE
    #undef SHUFFLE
    #undef INLINE
    #undef EACH_BLOCK
    #undef OPEN_BLOCK
