// Parts of the kernels of compositor_cuda.py, which replaces TILE, LANE_PIXELS, PATCH_WIDTH, PATCH_HEIGHT, WARPS,
// SPLAT_SIZE, COMPARES and OPACITIES. COMPARES 0: the first pass writes images, the second reads their gradients.
// COMPARES 1: the first pass subtracts the observation and sums the squares, the second uses the differences as
// gradients. OPACITIES 0: the second pass omits the sum for gradients of opacities.

// Common start of both passes. The pixels of a thread are in column x and rows y + 4 p. `fetch` loads the splat of an
// entry into the warp's shared memory, for powers of two: weights of dx^2, dx dy, dy^2 and log2 of the opacity.
//// common
    constexpr unsigned ALL = 0xffffffffu;
    const float LOG2_E = 1.44269504f;
    __shared__ float4 places[WARPS][32];  // mean, weights of dx^2 and dx dy
    __shared__ float4 shades[WARPS][32];  // weight of dy^2, log2(opacity), red, green
    __shared__ float2 others[WARPS][32];  // blue, splat
    const int warp = thread / 32, lane = thread % 32;
    const int tiles_x = (width + TILE - 1) / TILE, tiles_y = (height + TILE - 1) / TILE;
    const int image = tile / (tiles_x * tiles_y);
    const int tile_row = tile / tiles_x - image * tiles_y, tile_column = tile % tiles_x;
    const int patch_x = tile_column * TILE + warp % (TILE / PATCH_WIDTH) * PATCH_WIDTH;
    const int patch_y = tile_row * TILE + warp / (TILE / PATCH_WIDTH) * PATCH_HEIGHT;
    const int x = patch_x + lane % PATCH_WIDTH, y = patch_y + lane / PATCH_WIDTH;
    const int begin = starts.data[tile], end = starts.data[tile + 1];
    const float4* records = (const float4*)splats.data;
    const long long corner = ((long long)image * height + y) * width + x;  // the lane's first pixel
#if COMPARES
    float4* differences = (float4*)states.data;  // of colours, and transmittance
    // index of the state of pixel p, tile by tile, so that lanes of a warp are neighbours
    auto place_of = [&](int p) { return ((long long)tile * LANE_PIXELS + p) * (32 * WARPS) + thread; };
#endif

    auto exp2_fast = [](float v) {
#if defined(__CUDA_ARCH__)
        float e;
        asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(e) : "f"(v));
        return e;
#else
        return exp2f(v);
#endif
    };
    // Whether the ellipse reaches one of the patch's pixel centres. The minimum of the quadratic form over their
    // rectangle is on one of the two sides that face the mean, or at the mean.
    auto touches = [&](float mx, float my, float A, float B, float C, float reach) {
        const float x0 = patch_x + 0.5f - mx, x1 = x0 + (PATCH_WIDTH - 1);
        const float y0 = patch_y + 0.5f - my, y1 = y0 + (PATCH_HEIGHT - 1);
        const float side_x = fminf(fmaxf(x0, 0.0f), x1), side_y = fminf(fmaxf(y0, 0.0f), y1);
        const float along_y = fminf(fmaxf(__fdividef(-B * side_x, C), y0), y1);
        const float along_x = fminf(fmaxf(__fdividef(-B * side_y, A), x0), x1);
        const float q_x = A * side_x * side_x + 2.0f * B * side_x * along_y + C * along_y * along_y;
        const float q_y = A * along_x * along_x + 2.0f * B * along_x * side_y + C * side_y * side_y;
        return fminf(q_x, q_y) <= reach;
    };
    auto fetch = [&](int entry) {
        const int splat = ids.data[entry];
        const float4* record = records + 3LL * splat;
        const float4 p = record[0], q = record[1], r = record[2];
        if (!touches(p.x, p.y, p.z, p.w, q.x, r.y)) return false;
        places[warp][lane] = make_float4(p.x, p.y, -0.5f * LOG2_E * p.z, -LOG2_E * p.w);
        shades[warp][lane] = make_float4(-0.5f * LOG2_E * q.x, log2f(q.y), q.z, q.w);
        others[warp][lane] = make_float2(r.x, __int_as_float(splat));
        return true;
    };

//// forward
#if !COMPARES
    if (begin == end) {
        // no splats: the warp writes its rows of the tile one by one, for contiguous stores
        const int left = tile_column * TILE, columns = min(TILE, width - left);
        for (int row = tile_row * TILE + warp; row < min(height, (tile_row + 1) * TILE); row += WARPS) {
            const long long at = ((long long)image * height + row) * width + left;
            for (int k = lane; k < 3 * columns; k += 32) pictures.data[3 * at + k] = background.data[k % 3];
            for (int k = lane; k < columns; k += 32) alphas.data[at + k] = 0.0f;
        }
        return;
    }
#endif
    float T[LANE_PIXELS], red[LANE_PIXELS], green[LANE_PIXELS], blue[LANE_PIXELS];
    int stop[LANE_PIXELS];  // list position after the last drawn splat
    bool open[LANE_PIXELS];
#if COMPARES
    unsigned seen[LANE_PIXELS];  // R, G, B, A from the lowest byte up; loaded early to hide latency
#endif
#pragma unroll
    for (int p = 0; p < LANE_PIXELS; ++p) {
        T[p] = 1.0f;
        red[p] = green[p] = blue[p] = 0.0f;
        stop[p] = 0;
        open[p] = x < width && y + 4 * p < height;
#if COMPARES
        seen[p] = open[p] ? observed.data[corner + 4LL * p * width] : 0;
#endif
    }
    for (int base = begin; base < end; base += 32) {
        bool any_open = false;
#pragma unroll
        for (int p = 0; p < LANE_PIXELS; ++p) any_open |= open[p];
        if (!__any_sync(ALL, any_open)) break;
        __syncwarp();  // all lanes have read the previous entries
        const bool hit = base + lane < end && fetch(base + lane);
        unsigned todo = __ballot_sync(ALL, hit);
        __syncwarp();
        while (todo) {
            const int k = __ffs(todo) - 1;
            todo &= todo - 1;
            const float4 place = places[warp][k], shade = shades[warp][k];
            const float splat_blue = others[warp][k].x;
            const float dx = x + 0.5f - place.x, dy0 = y + 0.5f - place.y;
            const float constant = place.z * dx * dx, linear = place.w * dx;
#pragma unroll
            for (int p = 0; p < LANE_PIXELS; ++p) {
                const float dy = dy0 + 4 * p;
                const float power = fmaf(dy, fmaf(shade.x, dy, linear), constant);
                const float alpha = fminf(exp2_fast(power + shade.y), alpha_max);
                if (open[p] && power <= 0.0f && alpha >= alpha_min) {
                    const float after = T[p] * (1.0f - alpha);
                    if (after < transmittance_min) {
                        open[p] = false;
                    } else {
                        const float weight = alpha * T[p];
                        red[p] = fmaf(weight, shade.z, red[p]);
                        green[p] = fmaf(weight, shade.w, green[p]);
                        blue[p] = fmaf(weight, splat_blue, blue[p]);
                        T[p] = after;
                        stop[p] = base - begin + k + 1;
                    }
                }
            }
        }
    }
#if COMPARES
    double sum = 0.0;
#pragma unroll
    for (int p = 0; p < LANE_PIXELS; ++p) {
        float4 state = make_float4(0.0f, 0.0f, 0.0f, T[p]);
        if (x < width && y + 4 * p < height) {
            const float unit = 1.0f / 255.0f, cover = unit * (seen[p] >> 24), white = 1.0f - cover;
            state.x = fmaf(T[p], background.data[0], red[p]) - fmaf(unit * (seen[p] & 255), cover, white);
            state.y = fmaf(T[p], background.data[1], green[p]) - fmaf(unit * (seen[p] >> 8 & 255), cover, white);
            state.z = fmaf(T[p], background.data[2], blue[p]) - fmaf(unit * (seen[p] >> 16 & 255), cover, white);
            sum += state.x * state.x + state.y * state.y + state.z * state.z;
        }
        if (begin < end) {
            differences[place_of(p)] = state;
            stops.data[place_of(p)] = stop[p];
        }
    }
    for (int step = 16; step > 0; step /= 2) sum += __shfl_xor_sync(ALL, sum, step);
    if (lane == 0) sums.data[(long long)tile * WARPS + warp] = sum;
#else
#pragma unroll
    for (int p = 0; p < LANE_PIXELS; ++p) {
        if (x < width && y + 4 * p < height) {
            const long long at = corner + 4LL * p * width;
            pictures.data[3 * at] = fmaf(T[p], background.data[0], red[p]);
            pictures.data[3 * at + 1] = fmaf(T[p], background.data[1], green[p]);
            pictures.data[3 * at + 2] = fmaf(T[p], background.data[2], blue[p]);
            alphas.data[at] = 1.0f - T[p];
            transmittances.data[at] = T[p];
            stops.data[at] = stop[p];
        }
    }
#endif

//// backward
    if (begin == end) return;
    float T[LANE_PIXELS], red[LANE_PIXELS], green[LANE_PIXELS], blue[LANE_PIXELS];  // gradient of the image
    float behind[LANE_PIXELS];  // gradient-weighted light that reaches the pixel from behind the current splat
    int stop[LANE_PIXELS], last = 0;
#pragma unroll
    for (int p = 0; p < LANE_PIXELS; ++p) {
#if COMPARES
        const float4 state = differences[place_of(p)];  // 0 outside the image
        const float scale = scales.data[image];
        stop[p] = stops.data[place_of(p)];
        T[p] = state.w;
        red[p] = scale * state.x;
        green[p] = scale * state.y;
        blue[p] = scale * state.z;
        behind[p] = T[p] * (red[p] * background.data[0] + green[p] * background.data[1]
            + blue[p] * background.data[2]);
#else
        T[p] = red[p] = green[p] = blue[p] = behind[p] = 0.0f;
        stop[p] = 0;
        if (x < width && y + 4 * p < height) {
            const long long at = corner + 4LL * p * width;
            stop[p] = stops.data[at];
            T[p] = transmittances.data[at];
            red[p] = grad_pictures.data[3 * at];
            green[p] = grad_pictures.data[3 * at + 1];
            blue[p] = grad_pictures.data[3 * at + 2];
            behind[p] = T[p] * (red[p] * background.data[0] + green[p] * background.data[1]
                + blue[p] * background.data[2] - grad_alphas.data[at]);
        }
#endif
        last = max(last, stop[p]);
    }
    for (int step = 16; step > 0; step /= 2) last = max(last, __shfl_xor_sync(ALL, last, step));
    const bool upper16 = lane & 16, upper8 = lane & 8, upper4 = lane & 4, upper2 = lane & 2;
#if OPACITIES
    const bool writes = lane % 4 == 0 || lane == 2;
    const int slot = lane == 2 ? 8 : lane / 4;
#else
    const bool writes = lane % 4 == 0;
    const int slot = 1 + lane / 4;
#endif

    for (int base = (last - 1) & ~31; last > 0 && base >= 0; base -= 32) {
        __syncwarp();
        const bool hit = base + lane < last && fetch(begin + base + lane);
        unsigned todo = __ballot_sync(ALL, hit);
        __syncwarp();
        while (todo) {
            const int k = 31 - __clz(todo);
            todo ^= 1u << k;
            const float4 place = places[warp][k], shade = shades[warp][k];
            const float2 other = others[warp][k];
            const float dx = x + 0.5f - place.x, dy0 = y + 0.5f - place.y;
            const float constant = place.z * dx * dx, linear = place.w * dx;
            float raw[LANE_PIXELS];
            bool drawn[LANE_PIXELS], any_drawn = false;
#pragma unroll
            for (int p = 0; p < LANE_PIXELS; ++p) {
                const float dy = dy0 + 4 * p;
                const float power = fmaf(dy, fmaf(shade.x, dy, linear), constant);
                raw[p] = exp2_fast(power + shade.y);
                drawn[p] = base + k < stop[p] && power <= 0.0f && fminf(raw[p], alpha_max) >= alpha_min;
                any_drawn |= drawn[p];
            }
            if (!__any_sync(ALL, any_drawn)) continue;
            // sums over the pixels: slope times 1, dx, dy, dx^2, dx dy, dy^2, and weight times the image's gradient
            float s = 0.0f, s_y = 0.0f, s_yy = 0.0f, w_red = 0.0f, w_green = 0.0f, w_blue = 0.0f;
#pragma unroll
            for (int p = 0; p < LANE_PIXELS; ++p) {
                if (drawn[p]) {
                    const float alpha = fminf(raw[p], alpha_max), dy = dy0 + 4 * p;
                    const float inverse = __fdividef(1.0f, 1.0f - alpha);
                    T[p] *= inverse;
                    const float weight = alpha * T[p];
                    const float light = red[p] * shade.z + green[p] * shade.w + blue[p] * other.x;
                    const float slope = raw[p] <= alpha_max ? alpha * (T[p] * light - behind[p] * inverse) : 0.0f;
                    behind[p] = fmaf(weight, light, behind[p]);
                    s += slope;
                    s_y = fmaf(slope, dy, s_y);
                    s_yy = fmaf(slope * dy, dy, s_yy);
                    w_red = fmaf(weight, red[p], w_red);
                    w_green = fmaf(weight, green[p], w_green);
                    w_blue = fmaf(weight, blue[p], w_blue);
                }
            }
#if OPACITIES
            float sums[8] = {s, s * dx, s_y, s * dx * dx, s_y * dx, s_yy, w_red, w_green};
#else
            float sums[8] = {s * dx, s_y, s * dx * dx, s_y * dx, s_yy, w_red, w_green, w_blue};
#endif
#pragma unroll
            for (int i = 0; i < 4; ++i) {
                const float given = upper16 ? sums[i] : sums[i + 4];
                sums[i] = (upper16 ? sums[i + 4] : sums[i]) + __shfl_xor_sync(ALL, given, 16);
            }
#pragma unroll
            for (int i = 0; i < 2; ++i) {
                const float given = upper8 ? sums[i] : sums[i + 2];
                sums[i] = (upper8 ? sums[i + 2] : sums[i]) + __shfl_xor_sync(ALL, given, 8);
            }
            {
                const float given = upper4 ? sums[0] : sums[1];
                sums[0] = (upper4 ? sums[1] : sums[0]) + __shfl_xor_sync(ALL, given, 4);
            }
#if OPACITIES
            w_blue += __shfl_xor_sync(ALL, w_blue, 16);
            w_blue += __shfl_xor_sync(ALL, w_blue, 8);
            w_blue += __shfl_xor_sync(ALL, w_blue, 4);
            // lanes with bit 1 continue with the ninth sum, the others with sum number lane / 4
            const float given = upper2 ? sums[0] : w_blue;
            float sum = (upper2 ? w_blue : sums[0]) + __shfl_xor_sync(ALL, given, 2);
#else
            float sum = sums[0] + __shfl_xor_sync(ALL, sums[0], 2);
#endif
            sum += __shfl_xor_sync(ALL, sum, 1);
            if (writes) atomicAdd(grad_splats.data + (long long)SPLAT_SIZE * __float_as_int(other.y) + slot, sum);
        }
    }
