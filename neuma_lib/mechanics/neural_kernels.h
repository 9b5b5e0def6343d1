// Features of the networks, combined with parts of singular_values_kernels.h.

// Features are sigma - 1 (3), F^T F - I (9, row-major) and det F - 1 (1). The SVD scales a[], so this part precedes it.
//// gram
    Pack gram[9], det;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) gram[3 * i + j] = a[i] * a[j] + a[3 + i] * a[3 + j] + a[6 + i] * a[6 + j];
    det = a[0] * (a[4] * a[8] - a[5] * a[7]) - a[1] * (a[3] * a[8] - a[5] * a[6])
        + a[2] * (a[3] * a[7] - a[4] * a[6]);

//// store
    Pack turn9[9];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) turn9[3 * i + j] = u0[i] * v0[j] + u1[i] * v1[j] + u2[i] * v2[j];
    for (int l = 0; l < used; ++l) {
        const int i = first + l;
        Real* pz = (Real*)z.data + FEATURES * i;
        Real* pr = (Real*)R.data + 9 * i;
        Real* pv = (Real*)Vh.data + 9 * i;
        for (int k = 0; k < 3; ++k) {
            pz[k] = LANE(s[k], l) - Real(1);
            pv[k] = LANE(v0[k], l);
            pv[3 + k] = LANE(v1[k], l);
            pv[6 + k] = LANE(v2[k], l);
        }
        for (int k = 0; k < 9; ++k) {
            pz[3 + k] = LANE(gram[k], l) - (k % 4 == 0 ? Real(1) : Real(0));
            pr[k] = LANE(turn9[k], l);
        }
        pz[12] = LANE(det, l) - Real(1);
    }
