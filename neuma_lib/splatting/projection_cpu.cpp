// Kernels of projection_cpu.py, for Clang, with a Gaussian in each lane of a vector. The module replaces REAL, SPLAT_SIZE
// and constants. Equations are those of projection.py.

//// start
    #pragma clang fp contract(on)
    typedef REAL Real;
    const int LANES = 16, RECORD = SPLAT_SIZE;
    typedef Real Vec __attribute__((ext_vector_type(16)));
    typedef decltype(Vec() > Vec()) Ints;
    #define INLINE __attribute__((always_inline))
    #define SQRT(x) __builtin_elementwise_sqrt(x)
    auto any = [](Ints m) INLINE { return __builtin_reduce_or(m) != 0; };
    const int first = LANES * pack, used = wp::min(LANES, count - first);
    auto lane = [&](int k) INLINE { return first + (k < used ? k : 0); };
    // Numbers of an array with so many per Gaussian, from the given one
    auto gather = [&](const Real* p, int stride, int number, Vec* out) INLINE {
        for (int k = 0; k < LANES; ++k)
            for (int i = 0; i < number; ++i) ((Real*)(out + i))[k] = p[(size_t)lane(k) * stride + i];
    };
    auto scatter = [&](const Vec* values, int stride, int number, Real* p) INLINE {
        for (int k = 0; k < used; ++k)
            for (int i = 0; i < number; ++i) p[(size_t)(first + k) * stride + i] = ((const Real*)(values + i))[k];
    };
    auto symmetric = [](Vec* m) INLINE {
        m[1] = m[3] = Real(0.5) * (m[1] + m[3]);
        m[2] = m[6] = Real(0.5) * (m[2] + m[6]);
        m[5] = m[7] = Real(0.5) * (m[5] + m[7]);
    };
    struct Camera {
        Real R[9], t[3], fx, fy, cx, cy, centre[3];  // centre: R^T t
    };
    auto camera_of = [&](int v) INLINE {
        const Real* const m = viewmats.data + 16 * v;
        const Real* const K = Ks.data + 9 * v;
        Camera c = {{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]}, {m[3], m[7], m[11]}, K[0], K[4], K[2], K[5]};
        for (int i = 0; i < 3; ++i) c.centre[i] = c.R[i] * c.t[0] + c.R[3 + i] * c.t[1] + c.R[6 + i] * c.t[2];
        return c;
    };
    auto limited = [](Vec tangent, Real focal, Real centre, Real extent) INLINE {
        const Real margin = Real(0.3) * Real(0.5) * extent / focal;
        const Vec low = -(centre / focal + margin), high = (extent - centre) / focal + margin;
        tangent = tangent < low ? low : tangent;
        return tangent > high ? high : tangent;
    };
    // Mean in the camera's frame, tangents, their limited values, and rows of m, the Jacobian times the rotation
    struct View {
        Vec p[3], rz, tangent[2], limit[2], m[2][3];
    };
    auto view_of = [&](const Camera& c, const Vec* mean, Ints* in_front) INLINE {
        View w;
        for (int i = 0; i < 3; ++i)
            w.p[i] = c.R[3 * i] * mean[0] + c.R[3 * i + 1] * mean[1] + c.R[3 * i + 2] * mean[2] + c.t[i];
        *in_front &= w.p[2] >= Vec(Real(NEAR_PLANE));
        w.rz = 1 / (*in_front ? w.p[2] : Vec(1));
        const Real focal[2] = {c.fx, c.fy}, centre[2] = {c.cx, c.cy}, extent[2] = {width, height};
        for (int i = 0; i < 2; ++i) {
            w.tangent[i] = w.p[i] * w.rz;
            w.limit[i] = limited(w.tangent[i], focal[i], centre[i], extent[i]);
            for (int k = 0; k < 3; ++k) w.m[i][k] = focal[i] * w.rz * (c.R[3 * i + k] - w.limit[i] * c.R[6 + k]);
        }
        return w;
    };
    auto direction_of = [&](const Camera& c, const Vec* mean, Vec* d) INLINE {
        Vec square = 0;
        for (int i = 0; i < 3; ++i) {
            d[i] = mean[i] + c.centre[i];
            square += d[i] * d[i];
        }
        const Vec length = SQRT(square), over = length > Vec(0) ? 1 / length : Vec(0);
        for (int i = 0; i < 3; ++i) d[i] *= over;
        return over;
    };
    auto harmonics = [&](const Vec* d, Vec* v) INLINE {
        const Vec x = d[0], y = d[1], z = d[2];
        v[0] = Real(C0);
        if (coefficients > 1) {
            v[1] = -Real(C1) * y;
            v[2] = Real(C1) * z;
            v[3] = -Real(C1) * x;
        }
        if (coefficients > 4) {
            v[4] = Real(C2A) * x * y;
            v[5] = -Real(C2A) * y * z;
            v[6] = Real(C2B) * (2 * z * z - x * x - y * y);
            v[7] = -Real(C2A) * x * z;
            v[8] = Real(C2C) * (x * x - y * y);
        }
        if (coefficients > 9) {
            v[9] = -Real(C3A) * y * (3 * x * x - y * y);
            v[10] = Real(C3B) * x * y * z;
            v[11] = -Real(C3C) * y * (4 * z * z - x * x - y * y);
            v[12] = Real(C3D) * z * (2 * z * z - 3 * x * x - 3 * y * y);
            v[13] = -Real(C3C) * x * (4 * z * z - x * x - y * y);
            v[14] = Real(C3E) * z * (x * x - y * y);
            v[15] = -Real(C3A) * x * (x * x - 3 * y * y);
        }
    };
    Vec colours[48];
    gather(sh.data, 3 * coefficients, 3 * coefficients, colours);

//// project
    Vec opacity, reach = Real(UNLIMITED);
    gather(opacities.data, 1, 1, &opacity);
    const Ints opaque = (opacity >= Vec(alpha_min)) & (opacity > Vec(0));
    if (alpha_min > 0)
        for (int k = 0; k < LANES; ++k) reach[k] = 2 * wp::log(opacity[k] / alpha_min);
    for (int t = 0; t < frames; ++t) {
        Vec mean[3], A[9];
        gather(means.data + (size_t)3 * t * count, 3, 3, mean);
        gather(covars.data + (size_t)9 * t * count, 9, 9, A);
        symmetric(A);
        for (int v = 0; v < views; ++v) {
            const size_t image = (size_t)t * views + v;
            const Camera c = camera_of(v);
            Ints visible = opaque;
            const View w = view_of(c, mean, &visible);
            Vec cov[3] = {0, 0, 0};
            for (int k = 0; k < 3; ++k) {
                const Vec x = A[3 * k] * w.m[0][0] + A[3 * k + 1] * w.m[0][1] + A[3 * k + 2] * w.m[0][2];
                const Vec y = A[3 * k] * w.m[1][0] + A[3 * k + 1] * w.m[1][1] + A[3 * k + 2] * w.m[1][2];
                cov[0] += w.m[0][k] * x;
                cov[1] += w.m[0][k] * y;
                cov[2] += w.m[1][k] * y;
            }
            const Vec a = cov[0] + eps2d, b = cov[1], d = cov[2] + eps2d, det = a * d - b * b;
            visible &= det > Vec(0);
            const Vec x = c.fx * w.tangent[0] + c.cx, y = c.fy * w.tangent[1] + c.cy;
            if (alpha_min > 0) {
                // the exact bounding box of the region where opacity exp(-sigma) >= alpha_min
                const Vec wide = SQRT(reach * a), tall = SQRT(reach * d);
                visible &= ~((x + wide < Vec(0)) | (x - wide > Vec(width)));
                visible &= ~((y + tall < Vec(0)) | (y - tall > Vec(height)));
            }
            Vec record[RECORD], depth = visible ? w.p[2] : Vec(Real(CULLED));
            scatter(&depth, 1, 1, depths.data + image * count);
            if (!any(visible)) continue;
            const Vec inv = 1 / (visible ? det : Vec(1)), reached = reach + Real(REACH_SLACK);
            Vec direction[3], values[16], colour[3] = {Real(0.5), Real(0.5), Real(0.5)};
            direction_of(c, mean, direction);
            harmonics(direction, values);
            for (int k = 0; k < coefficients; ++k)
                for (int i = 0; i < 3; ++i) colour[i] += values[k] * colours[3 * k + i];
            record[0] = x, record[1] = y;
            record[2] = d * inv, record[3] = -b * inv, record[4] = a * inv;
            record[5] = opacity;
            for (int i = 0; i < 3; ++i) record[6 + i] = colour[i] > Vec(0) ? colour[i] : Vec(0);
            record[9] = reached, record[10] = SQRT(reached * a), record[11] = SQRT(reached * d);
            scatter(record, RECORD, RECORD, splats.data + image * count * RECORD);
        }
    }

//// adjoint
    for (int t = 0; t < frames; ++t) {
        Vec mean[3], A[9], grad_mean[3] = {0, 0, 0}, grad_A[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0};
        gather(means.data + (size_t)3 * t * count, 3, 3, mean);
        gather(covars.data + (size_t)9 * t * count, 9, 9, A);
        symmetric(A);
        for (int v = 0; v < views; ++v) {
            const size_t image = (size_t)t * views + v;
            Vec depth;
            gather(depths.data + image * count, 1, 1, &depth);
            Ints visible = depth < Vec(Real(CULLED));
            if (!any(visible)) continue;
            const Camera c = camera_of(v);
            const View w = view_of(c, mean, &visible);
            Vec record[9], grad[9];
            gather(splats.data + image * count * RECORD, RECORD, 9, record);
            gather(grad_splats.data + image * count * RECORD, RECORD, 9, grad);
            for (int i = 0; i < 9; ++i) {
                record[i] = visible ? record[i] : Vec(0);
                grad[i] = visible ? grad[i] : Vec(0);
            }
            // conic = cov^-1, so d cov = -conic (d conic) conic with B counted twice in the exponent
            const Vec a = record[2], b = record[3], d = record[4];
            const Vec ga = grad[2], gb = Real(0.5) * grad[3], gd = grad[4];
            const Vec xa = ga * a + gb * b, xb = ga * b + gb * d, xc = gb * a + gd * b, xd = gb * b + gd * d;
            const Vec G00 = -(a * xa + b * xc), G01 = -(a * xb + b * xd), G11 = -(b * xb + d * xd);
            Vec Gm[2][3], GmA[2][3], J[2][3];
            for (int k = 0; k < 3; ++k) {
                Gm[0][k] = G00 * w.m[0][k] + G01 * w.m[1][k];
                Gm[1][k] = G01 * w.m[0][k] + G11 * w.m[1][k];
            }
            for (int i = 0; i < 3; ++i)
                for (int k = 0; k < 3; ++k) grad_A[3 * i + k] += w.m[0][i] * Gm[0][k] + w.m[1][i] * Gm[1][k];
            for (int i = 0; i < 2; ++i)
                for (int k = 0; k < 3; ++k) GmA[i][k] = Gm[i][0] * A[k] + Gm[i][1] * A[3 + k] + Gm[i][2] * A[6 + k];
            for (int i = 0; i < 2; ++i)  // gradient of the Jacobian
                for (int k = 0; k < 3; ++k)
                    J[i][k] = 2 * (GmA[i][0] * c.R[3 * k] + GmA[i][1] * c.R[3 * k + 1] + GmA[i][2] * c.R[3 * k + 2]);
            const Real focal[2] = {c.fx, c.fy};
            Vec g[3];
            g[2] = -w.rz * w.rz * (c.fx * J[0][0] + c.fy * J[1][1]);
            for (int i = 0; i < 2; ++i) {
                g[i] = grad[i] * focal[i] * w.rz;
                g[2] -= g[i] * w.tangent[i];
                // third column of the Jacobian: -f (x/z) / z, with constant x/z where it is limited
                const Vec slope = -focal[i] * w.rz * J[i][2];
                const Vec free = w.limit[i] == w.tangent[i] ? slope * w.rz : Vec(0);
                g[2] -= w.rz * w.limit[i] * slope + w.tangent[i] * free;
                g[i] += free;
            }
            for (int i = 0; i < 3; ++i) grad_mean[i] += c.R[i] * g[0] + c.R[3 + i] * g[1] + c.R[6 + i] * g[2];
            if (coefficients == 1) continue;
            Vec n[3], weight[16], along[3] = {0, 0, 0}, grad_colour[3];
            const Vec over = direction_of(c, mean, n);
            for (int i = 0; i < 3; ++i) grad_colour[i] = record[6 + i] > Vec(0) ? grad[6 + i] : Vec(0);
            for (int k = 1; k < coefficients; ++k)
                weight[k] = colours[3 * k] * grad_colour[0] + colours[3 * k + 1] * grad_colour[1] +
                            colours[3 * k + 2] * grad_colour[2];
            const Vec x = n[0], y = n[1], z = n[2];
            along[0] += -Real(C1) * weight[3];
            along[1] += -Real(C1) * weight[1];
            along[2] += Real(C1) * weight[2];
            if (coefficients > 4) {
                along[0] += Real(C2A) * (y * weight[4] - z * weight[7]) + 2 * x * (Real(C2C) * weight[8] - Real(C2B) * weight[6]);
                along[1] += Real(C2A) * (x * weight[4] - z * weight[5]) - 2 * y * (Real(C2B) * weight[6] + Real(C2C) * weight[8]);
                along[2] += 4 * Real(C2B) * z * weight[6] - Real(C2A) * (y * weight[5] + x * weight[7]);
            }
            if (coefficients > 9) {
                const Vec xx = x * x, yy = y * y, zz = z * z;
                along[0] += Real(C3B) * y * z * weight[10] + 2 * Real(C3C) * x * y * weight[11] - 6 * Real(C3D) * x * z * weight[12] -
                            Real(C3C) * (4 * zz - 3 * xx - yy) * weight[13] + 2 * Real(C3E) * x * z * weight[14] -
                            Real(C3A) * (6 * x * y * weight[9] + 3 * (xx - yy) * weight[15]);
                along[1] += Real(C3B) * x * z * weight[10] - Real(C3C) * (4 * zz - xx - 3 * yy) * weight[11] -
                            6 * Real(C3D) * y * z * weight[12] + 2 * Real(C3C) * x * y * weight[13] -
                            2 * Real(C3E) * y * z * weight[14] - Real(C3A) * (3 * (xx - yy) * weight[9] - 6 * x * y * weight[15]);
                along[2] += Real(C3B) * x * y * weight[10] - 8 * Real(C3C) * z * (y * weight[11] + x * weight[13]) +
                            3 * Real(C3D) * (2 * zz - xx - yy) * weight[12] + Real(C3E) * (xx - yy) * weight[14];
            }
            const Vec radial = n[0] * along[0] + n[1] * along[1] + n[2] * along[2];
            for (int i = 0; i < 3; ++i) grad_mean[i] += (along[i] - n[i] * radial) * over;
        }
        scatter(grad_mean, 3, 3, grad_means.data + (size_t)3 * t * count);
        scatter(grad_A, 9, 9, grad_covars.data + (size_t)9 * t * count);
    }
