// Parts of the kernels of compositor_cpu.py, for Clang. That module replaces SPLAT_SIZE, LANES and REAL.

//// types
    typedef REAL Real;
    typedef Real Vec __attribute__((ext_vector_type(LANES)));
    typedef Real Loose __attribute__((ext_vector_type(LANES), aligned(sizeof(Real))));
    typedef decltype(Vec() > Vec()) Ints;
    auto load = [](const Real* p) { return Vec(*(const Loose*)p); };
    auto store = [](Real* p, Vec v) { *(Loose*)p = v; };
    auto any = [](Ints m) {
        bool found = false;
        for (int k = 0; k < LANES; ++k) found |= m[k] != 0;
        return found;
    };

// 2^n times a polynomial of degree 6, relative error below 2e-7
//// exp_float32
    auto exponential = [](Vec x) {
        x = __builtin_elementwise_max(x, Vec(-87.0f));
        Vec n = __builtin_elementwise_floor(x * 1.44269504f + 0.5f);
        Vec r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
        Vec p = 1.0f / 720.0f;
        p = p * r + 1.0f / 120.0f;
        p = p * r + 1.0f / 24.0f;
        p = p * r + 1.0f / 6.0f;
        p = p * r + 0.5f;
        p = p * r + 1.0f;
        p = p * r + 1.0f;
        Ints bits = (__builtin_convertvector(n, Ints) + 127) << 23;
        return p * __builtin_bit_cast(Vec, bits);
    };

//// exp_float64
    auto exponential = [](Vec x) {
        Vec e;
        for (int k = 0; k < LANES; ++k) e[k] = wp::exp(x[k]);
        return e;
    };

// Loops over the rows and columns where alpha can reach alpha_min (with a tolerance; the lanes test alpha itself). BODY
// uses the splat, the offset `at` into the planes, dx, dy, alpha and `drawn`.
//// splat
        const Real* s = record + (long long)index[i] * SPLAT_SIZE;
        const Real mx = s[0], my = s[1], A = s[2], B = s[3], C = s[4], opacity = s[5];
        const Vec red = s[6], green = s[7], blue = s[8];
        const Real det = A * C - B * B;
        int row_first = 0, row_last = height - 1;
        Real reach = 0;
        if (alpha_min > 0) {
            reach = 2 * wp::log(opacity / alpha_min);
            const Real tall = wp::sqrt(reach * A / det) + Real(0.01);
            row_first = wp::max(0, (int)(wp::ceil(wp::max(my - tall - Real(0.5), Real(-1)))));
            row_last = wp::min(height - 1, (int)(wp::floor(wp::min(my + tall - Real(0.5), Real(height)))));
        }
        for (int row = row_first; row <= row_last; ++row) {
            const Real dy = Real(row) + Real(0.5) - my;
            int first = 0, last = width - 1;
            if (alpha_min > 0) {
                const Real root = wp::sqrt(wp::max(reach * A - det * dy * dy, Real(0)));
                const Real middle = mx - B * dy / A, wide = root / A + Real(0.01);
                first = wp::max(0, (int)(wp::ceil(wp::max(middle - wide - Real(0.5), Real(-1)))));
                last = wp::min(width - 1, (int)(wp::floor(wp::min(middle + wide - Real(0.5), Real(width)))));
            }
            for (int column = first; column <= last; column += LANES) {
                const int at = row * pitch + column;
                const Vec stopped = load(stop + at);
                if (!any(stopped > Vec(Real(i)))) continue;
                const Vec dx = ramp + (Real(column) + Real(0.5) - mx);
                const Vec sigma = Real(0.5) * (A * dx * dx + C * dy * dy) + B * dx * dy;
                const Vec raw = opacity * exponential(-sigma);
                Vec alpha = __builtin_elementwise_min(raw, Vec(alpha_max));
                const Ints drawn = (alpha >= Vec(alpha_min)) & (sigma >= Vec(0)) & (stopped > Vec(Real(i)));
                BODY
            }
        }

//// forward
    const int plane = height * pitch;
    const Real* record = splats.data + (long long)image * count * SPLAT_SIZE;
    const long long* index = (const long long*)order.data + (long long)image * count;
    Real* T = planes.data + (long long)image * 5 * plane;
    Real *c0 = T + plane, *c1 = c0 + plane, *c2 = c1 + plane, *stop = c2 + plane;
    Vec ramp;
    for (int k = 0; k < LANES; ++k) ramp[k] = Real(k);
    for (int k = 0; k < plane; ++k) {
        T[k] = 1; c0[k] = 0; c1[k] = 0; c2[k] = 0; stop[k] = Real(count);
    }
    for (int i = 0; i < seen; ++i) {
        SPLAT
    }
    Real* picture = pictures.data + (long long)image * height * width * 3;
    Real* cover = alphas.data + (long long)image * height * width;
    for (int row = 0; row < height; ++row)
        for (int column = 0; column < width; ++column) {
            const int at = row * pitch + column, to = row * width + column;
            picture[3 * to] = c0[at] + T[at] * back0;
            picture[3 * to + 1] = c1[at] + T[at] * back1;
            picture[3 * to + 2] = c2[at] + T[at] * back2;
            cover[to] = 1 - T[at];
        }

//// forward_body
                const Vec before = load(T + at);
                const Vec after = before * (1 - alpha);
                const Ints opaque = drawn & (after < Vec(transmittance_min));
                store(stop + at, opaque ? Vec(Real(i)) : stopped);
                alpha = (drawn & ~opaque) ? alpha : Vec(0);
                const Vec weight = alpha * before;
                store(T + at, before - weight);
                store(c0 + at, load(c0 + at) + weight * red);
                store(c1 + at, load(c1 + at) + weight * green);
                store(c2 + at, load(c2 + at) + weight * blue);

//// backward
    const int plane = height * pitch;
    const Real* record = splats.data + (long long)image * count * SPLAT_SIZE;
    const long long* index = (const long long*)order.data + (long long)image * count;
    const Real* T_last = planes.data + (long long)image * 5 * plane;
    const Real* stop = T_last + 4 * plane;
    Real* T = scratch.data + (long long)image * 5 * plane;
    Real *g0 = T + plane, *g1 = g0 + plane, *g2 = g1 + plane, *behind = g2 + plane;
    const Real* picture = grad_pictures.data + (long long)image * height * width * 3;
    const Real* cover = grad_alphas.data + (long long)image * height * width;
    Real* grads = grad_splats.data + (long long)image * count * SPLAT_SIZE;
    Vec ramp;
    for (int k = 0; k < LANES; ++k) ramp[k] = Real(k);
    for (int row = 0; row < height; ++row)
        for (int column = 0; column < pitch; ++column) {
            const int at = row * pitch + column, from = row * width + column;
            const bool inside = column < width;
            T[at] = T_last[at];
            g0[at] = inside ? picture[3 * from] : Real(0);
            g1[at] = inside ? picture[3 * from + 1] : Real(0);
            g2[at] = inside ? picture[3 * from + 2] : Real(0);
            const Real grad_cover = inside ? cover[from] : Real(0);
            behind[at] = T[at] * (g0[at] * back0 + g1[at] * back1 + g2[at] * back2 - grad_cover);
        }
    for (int i = seen - 1; i >= 0; --i) {
        Vec s0 = 0, sx = 0, sy = 0, sxx = 0, sxy = 0, syy = 0, s_red = 0, s_green = 0, s_blue = 0;
        SPLAT
        auto sum = [](Vec v) {
            for (int width = LANES / 2; width > 0; width /= 2)
                for (int k = 0; k < width; ++k) v[k] += v[k + width];
            return v[0];
        };
        const Real tx = sum(sx), ty = sum(sy);
        Real* out = grads + (long long)index[i] * SPLAT_SIZE;
        out[0] = A * tx + B * ty;
        out[1] = B * tx + C * ty;
        out[2] = Real(-0.5) * sum(sxx);
        out[3] = -sum(sxy);
        out[4] = Real(-0.5) * sum(syy);
        out[5] = sum(s0) / opacity;
        out[6] = sum(s_red);
        out[7] = sum(s_green);
        out[8] = sum(s_blue);
    }

//// backward_body
                alpha = drawn ? alpha : Vec(0);
                const Vec r0 = load(g0 + at), r1 = load(g1 + at), r2 = load(g2 + at);
                const Vec rest = load(behind + at);
                const Vec inverse = 1 / (1 - alpha);
                const Vec before = load(T + at) * inverse;
                const Vec weight = alpha * before;
                const Vec shade = r0 * red + r1 * green + r2 * blue;
                Vec slope = alpha * (before * shade - rest * inverse);
                slope = raw <= Vec(alpha_max) ? slope : Vec(0);
                store(T + at, before);
                store(behind + at, rest + weight * shade);
                const Vec slope_x = slope * dx, slope_y = slope * dy;
                s0 += slope;
                sx += slope_x;
                sy += slope_y;
                sxx += slope_x * dx;
                sxy += slope_x * dy;
                syy += slope_y * dy;
                s_red += weight * r0;
                s_green += weight * r1;
                s_blue += weight * r2;
