// Text of the functions of records.py, which replaces REAL and SPLAT_SIZE: a third of a record at a time, 16 bytes of
// single precision by one instruction on a GPU.
//// load
    const REAL* at = records.data + ((long long)image * records.shape[1] + g) * SPLAT_SIZE + 4 * piece;
#if defined(__CUDA_ARCH__)
    if (sizeof(REAL) == 4) {
        const float4 v = *(const float4*)at;
        return {(REAL)v.x, (REAL)v.y, (REAL)v.z, (REAL)v.w};
    }
#endif
    return {at[0], at[1], at[2], at[3]};

//// store
    REAL* at = records.data + ((long long)image * records.shape[1] + g) * SPLAT_SIZE + 4 * piece;
#if defined(__CUDA_ARCH__)
    if (sizeof(REAL) == 4) {
        *(float4*)at = make_float4(a, b, c, d);
        return;
    }
#endif
    at[0] = a;
    at[1] = b;
    at[2] = c;
    at[3] = d;
