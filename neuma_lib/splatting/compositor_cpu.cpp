// Parts of the kernels of compositor_cpu.py, for Clang. That module replaces SPLAT_SIZE and REAL.
//
// A tile of WIDTH x HEIGHT pixels is one vector. The state of a tile is contiguous: transmittance, negative where the
// pixel is opaque; red, green, blue; and the rank of the first splat that was not drawn.

//// types
    #pragma clang fp contract(on)
    typedef REAL Real;
    const int WIDTH = 4, HEIGHT = 4, LANES = 16, PLANES = 5;
    typedef Real Vec __attribute__((ext_vector_type(16)));
    typedef Real Loose __attribute__((ext_vector_type(16), aligned(sizeof(Real))));
    typedef decltype(Vec() > Vec()) Ints;
    typedef Real Quad __attribute__((ext_vector_type(4)));
    typedef int Ints4 __attribute__((ext_vector_type(4)));
    typedef Real LooseQuad __attribute__((ext_vector_type(4), aligned(sizeof(Real))));
    typedef int LooseInts4 __attribute__((ext_vector_type(4), aligned(4)));
    #define INLINE __attribute__((always_inline))
    #define SHUFFLE __builtin_shufflevector
    auto load = [](const Real* p) INLINE { return Vec(*(const Loose*)p); };
    auto store = [](Real* p, Vec v) INLINE { *(Loose*)p = v; };
    // not elementwise_min and max, which take two instructions more to treat NaN; here it becomes the bound
    #define AT_LEAST(x, bound) ((x) > (bound) ? (x) : (bound))
    #define AT_MOST(x, bound) ((x) < (bound) ? (x) : (bound))
    auto any = [](Ints m) INLINE { return __builtin_reduce_or(m) != 0; };
    const Vec U = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
    const Vec V = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
    const int across = (width + WIDTH - 1) / WIDTH, tiles = across * ((height + HEIGHT - 1) / HEIGHT);
    auto inside = [&](int tile) INLINE {
        const int x = tile % across * WIDTH, y = tile / across * HEIGHT;
        return (U < Vec(Real(width - x))) & (V < Vec(Real(height - y)));
    };
    const Real* const record = splats.data + (long long)image * count * SPLAT_SIZE;
    int* const ranked = (int*)order.data + (long long)image * count;
    Real* const states = planes.data + (long long)image * tiles * PLANES * LANES;
    int* const opaque_from = (int*)ends.data + (long long)image * tiles;

// 2^x: an integer power times a polynomial of degree 5, relative error below 3e-7
//// exp2_float32
    auto exponential = [](Vec x) INLINE {
        x = AT_LEAST(x, Vec(-100));  // no subnormal numbers, which are slow
        // The sum has the nearest integer in its lowest bits.
        const Vec magic = 12582912.0f, sum = x + magic, r = x - (sum - magic);
        Vec p = 0.00132764725f * r + 0.00967554096f;
        p = p * r + 0.0555071309f;
        p = p * r + 0.240221202f;
        p = p * r + 0.693146944f;
        p = p * r + 1.00000012f;
        return __builtin_bit_cast(Vec, __builtin_bit_cast(Ints, p) + (__builtin_bit_cast(Ints, sum) << 23));
    };

//// exp2_float64
    auto exponential = [](Vec x) INLINE {
        Vec e;
        for (int k = 0; k < LANES; ++k) e[k] = wp::exp(x[k] * 0.69314718055994530942);
        return e;
    };

// Stable radix sort of the splats that are not culled by the bits of their depths, which are positive
//// rank
    typedef decltype(sizeof(0)) Size;
    const Real* const depth = depths.data + (long long)image * count;
    int seen = 0;
    for (int g = 0; g < count; ++g)
        if (depth[g] < Real(CULLED)) ranked[seen++] = g;
    int *from = ranked, *to = (int*)spare.data;
    for (Size byte = 0; byte < sizeof(Real); ++byte) {
        auto digit = [&](int g) INLINE { return ((const unsigned char*)(depth + g))[byte]; };  // little-endian
        int starts[257] = {};
        for (int i = 0; i < seen; ++i) ++starts[digit(from[i]) + 1];
        if (seen && starts[digit(from[0]) + 1] == seen) continue;
        for (int k = 0; k < 256; ++k) starts[k + 1] += starts[k];
        for (int i = 0; i < seen; ++i) to[starts[digit(from[i])]++] = from[i];
        int* const sorted = to;
        to = from;
        from = sorted;
    }
    for (int i = 0; i < seen && from != ranked; ++i) ranked[i] = from[i];
    ((int*)numbers.data)[image] = seen;

// Calls BODY for the tiles that the ellipse of each splat reaches (with a tolerance; the lanes test alpha itself), and
// FINISH after each splat. Both use the splat of rank `i`, BODY also the number `t` of the tile, dx, dy, alpha and
// `reached`. The tiles of many splats are listed first: a list costs no mispredicted branches, and its length is known
// early when the loop over its tiles ends.
//// splats
    const int SPLATS = 256, ROOM = 4096;
    int* const list = (int*)spare.data;  // tiles, and their first columns and rows
    Real* const list_x = corners.data;
    Real* const list_y = list_x + corners.shape[1];
    auto tiles_of = [&](const Real* s, int at) INLINE {
        const Real mx = s[0] - Real(0.5), my = s[1] - Real(0.5), A = s[2], B = s[3], C = s[4], reach = s[9], tall = s[11];
        const Real over = 1 / A, slant = B * over, det = A * C - B * B, lean = B / C * s[10];
        const int row_first = (int)wp::ceil(AT_MOST(AT_LEAST(my - tall, Real(0)), Real(height)));
        const int row_last = (int)wp::floor(AT_MOST(AT_LEAST(my + tall, Real(-1)), Real(height - 1)));
        const int band_last = row_first > row_last ? -1 : row_last / HEIGHT;
        const int begin = at;
        for (int band = row_first / HEIGHT; band <= band_last; band += 4) {
            // of four rows of tiles: the outermost points of the ellipse between their first and last pixels
            const Quad y = (Quad{0, 1, 2, 3} + Real(band)) * Real(HEIGHT), top = y - my;
            const Quad low = AT_LEAST(top, Quad(-tall)), high = AT_MOST(top + Real(HEIGHT - 1), Quad(tall));
            auto within = [&](Real dy) INLINE { return AT_MOST(AT_LEAST(Quad(dy), low), high); };
            auto half = [&](Quad dy) INLINE {
                const Quad square = reach * A - det * dy * dy;
                return over * __builtin_elementwise_sqrt(AT_LEAST(square, Quad(0))) + Real(0.01);
            };
            auto column = [&](Quad x) INLINE {
                x = AT_MOST(AT_LEAST(x, Quad(-1)), Quad(Real(width)));
                return __builtin_convertvector(x, Ints4);
            };
            const Quad to_right = within(-lean), to_left = within(lean);
            Ints4 first = column(__builtin_elementwise_ceil(mx - slant * to_left - half(to_left)));
            Ints4 last = column(__builtin_elementwise_floor(mx - slant * to_right + half(to_right)));
            first = AT_LEAST(first, Ints4(0));
            last = AT_MOST(last, Ints4(width - 1));
            const Ints4 bands = Ints4{0, 1, 2, 3} + band;
            const Ints4 sizes = ((first <= last) & (bands <= Ints4(band_last))) & (last / WIDTH - first / WIDTH + 1);
            const Ints4 start = bands * across + first / WIDTH;
            const Quad x = __builtin_convertvector(first / WIDTH * WIDTH, Quad);
            for (int b = 0; b < 4; ++b) {
                int k = 0;
                do {
                    *(LooseInts4*)(list + at + k) = Ints4{0, 1, 2, 3} + (start[b] + k);
                    *(LooseQuad*)(list_x + at + k) = Quad{0, WIDTH, 2 * WIDTH, 3 * WIDTH} + (x[b] + Real(k * WIDTH));
                    *(LooseQuad*)(list_y + at + k) = Quad(y[b]);
                    k += 4;
                } while (k < sizes[b]);
                at += sizes[b];
            }
        }
        return at - begin;
    };
    for (int done = 0, several; done < seen; done += several) {
        int sizes[SPLATS], total = 0;
        for (several = 0; several < SPLATS && done + several < seen && total < ROOM; ++several) {
            const int i = ASCENDING ? done + several : seen - 1 - done - several;
            sizes[several] = tiles_of(record + (long long)ranked[i] * SPLAT_SIZE, total);
            total += sizes[several];
        }
        int entry = 0;
        for (int j = 0; j < several; ++j) {
            const int i = ASCENDING ? done + j : seen - 1 - done - j;
            const Real* s = record + (long long)ranked[i] * SPLAT_SIZE;
            const Real mx = s[0] - Real(0.5), my = s[1] - Real(0.5), A = s[2], B = s[3], C = s[4], opacity = s[5];
            const Vec red = s[6], green = s[7], blue = s[8];
            const Real log2e = Real(1.44269504088896340736);
            const Real A2 = Real(-0.5) * log2e * A, B2 = -log2e * B, C2 = Real(-0.5) * log2e * C;
            START
            const Vec from_x = U - mx, from_y = V - my;
            for (const int stop = entry + sizes[j]; entry < stop; ++entry) {
                const int t = list[entry];
                if (opaque_from[t] <= i) continue;
                const Vec dx = from_x + list_x[entry], dy = from_y + list_y[entry];
                const Vec power = (A2 * dx + B2 * dy) * dx + C2 * dy * dy;  // -sigma log2(e)
                const Vec raw = opacity * exponential(power);
                const Vec alpha = AT_MOST(raw, Vec(alpha_max));
                const Ints reached = (alpha >= Vec(alpha_min)) & (power <= Vec(0));
                BODY
            }
            FINISH
        }
    }

//// forward
    for (int t = 0; t < tiles; ++t) {
        const Ints real = inside(t);
        Real* const state = states + t * PLANES * LANES;
        store(state, real ? Vec(1) : Vec(0));
        for (int k = 1; k < 4; ++k) store(state + k * LANES, Vec(0));
        store(state + 4 * LANES, real ? Vec(Real(count)) : Vec(0));
        opaque_from[t] = count;
    }
    const bool ASCENDING = true;
    SPLATS_LOOP

//// forward_body
                Real* const state = states + t * PLANES * LANES;
                const Vec T = load(state);
                const Ints open = reached & (T > Vec(0));
                Vec weight = open ? alpha * T : Vec(0);
                Vec after = T - weight;
                const Ints opaque = open & (after < Vec(transmittance_min));
                if (any(opaque)) {
                    weight = opaque ? Vec(0) : weight;
                    after = opaque ? -T : after;
                    store(state + 4 * LANES, opaque ? Vec(Real(i)) : load(state + 4 * LANES));
                    if (!any(after > Vec(0))) opaque_from[t] = i + 1;
                }
                store(state, after);
                store(state + LANES, load(state + LANES) + weight * red);
                store(state + 2 * LANES, load(state + 2 * LANES) + weight * green);
                store(state + 3 * LANES, load(state + 3 * LANES) + weight * blue);

//// draw
    Real* const picture = pictures.data + (long long)image * height * width * 3;
    Real* const cover = alphas.data + (long long)image * height * width;
    for (int t = 0; t < tiles; ++t) {
        const Real* const state = states + t * PLANES * LANES;
        const int x = t % across * WIDTH, y = t / across * HEIGHT;
        for (int k = 0; k < LANES; ++k) {
            const int column = x + k % WIDTH, row = y + k / WIDTH;
            if (column >= width || row >= height) continue;
            const int at = row * width + column;
            const Real T = wp::abs(state[k]);
            picture[3 * at] = state[LANES + k] + T * back0;
            picture[3 * at + 1] = state[2 * LANES + k] + T * back1;
            picture[3 * at + 2] = state[3 * LANES + k] + T * back2;
            cover[at] = 1 - T;
        }
    }

// Squared differences from straight-alpha pixels over white. Differences replace the colours of the tiles.
//// compare
    const int* const pixels = (const int*)observed.data + (long long)image * height * width;
    typedef double Doubles __attribute__((ext_vector_type(16)));
    Doubles total = 0;
    for (int t = 0; t < tiles; ++t) {
        Real* const state = states + t * PLANES * LANES;
        const int x = t % across * WIDTH, y = t / across * HEIGHT;
        unsigned rgba[LANES];
        for (int k = 0; k < LANES; ++k) {
            const int column = wp::min(x + k % WIDTH, width - 1), row = wp::min(y + k / WIDTH, height - 1);
            rgba[k] = (unsigned)pixels[row * width + column];
        }
        const Ints real = inside(t);
        const Vec T = __builtin_elementwise_abs(load(state));
        auto channel = [&](int shift) INLINE {
            Vec value;
            for (int k = 0; k < LANES; ++k) value[k] = Real((int)(rgba[k] >> shift & 255));
            return value * (Real(1) / Real(255));
        };
        const Vec opaque = channel(24);
        const Real back[3] = {back0, back1, back2};
        Vec squares = 0;
        for (int k = 0; k < 3; ++k) {
            const Vec seen_colour = channel(8 * k) * opaque + (1 - opaque);
            const Vec error = real ? load(state + (1 + k) * LANES) + T * back[k] - seen_colour : Vec(0);
            store(state + (1 + k) * LANES, error);
            squares += error * error;
        }
        total += __builtin_convertvector(squares, Doubles);
    }
    double sum = 0;
    for (int k = 0; k < LANES; ++k) sum += total[k];
    ((double*)sums.data)[image] = sum;

//// backward
    Real* const nows = scratch.data;  // transmittance, gradients of red, green, blue, gradient-weighted light from behind
    const int seen = ((const int*)numbers.data)[image];
    for (int t = 0; t < tiles; ++t) {
        const Real* const state = states + t * PLANES * LANES;
        Real* const now = nows + t * PLANES * LANES;
        const Vec T = __builtin_elementwise_abs(load(state));
        Vec grad_red, grad_green, grad_blue, grad_cover;
        GRADIENTS
        store(now, T);
        store(now + LANES, grad_red);
        store(now + 2 * LANES, grad_green);
        store(now + 3 * LANES, grad_blue);
        store(now + 4 * LANES, T * (grad_red * back0 + grad_green * back1 + grad_blue * back2 - grad_cover));
    }
    // lane k of the result is the sum of the k-th vector
    auto pair = [](Vec a, Vec b) INLINE {
        return SHUFFLE(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30) +
               SHUFFLE(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    };
    Real* const grads = grad_splats.data + (long long)image * count * SPLAT_SIZE;
    const bool ASCENDING = false;
    SPLATS_LOOP

//// sums
            Vec s0 = 0, sx = 0, sy = 0, sxx = 0, sxy = 0, syy = 0, s_red = 0, s_green = 0, s_blue = 0;

//// gradients
            const Vec half = pair(pair(sx, sy), pair(sxx, sxy)), rest = pair(pair(syy, s_red), pair(s_green, s_blue));
            const Vec sum = pair(pair(half, rest), Vec(0));
            Real* out = grads + (long long)ranked[i] * SPLAT_SIZE;
            out[0] = A * sum[0] + B * sum[1];
            out[1] = B * sum[0] + C * sum[1];
            out[2] = Real(-0.5) * sum[2];
            out[3] = -sum[3];
            out[4] = Real(-0.5) * sum[4];
            out[6] = sum[5];
            out[7] = sum[6];
            out[8] = sum[7];
            if (opacities) {
                const Vec halves = pair(s0, s0), quarters = pair(halves, halves), eighths = pair(quarters, quarters);
                out[5] = (eighths[0] + eighths[1]) / opacity;
            }

//// image_gradients
        const int x = t % across * WIDTH, y = t / across * HEIGHT;
        for (int k = 0; k < LANES; ++k) {
            const int column = x + k % WIDTH, row = y + k / WIDTH, at = row * width + column;
            const bool real = column < width && row < height;
            const Real* const pixel = grad_pictures.data + ((long long)image * height * width + at) * 3;
            grad_red[k] = real ? pixel[0] : Real(0);
            grad_green[k] = real ? pixel[1] : Real(0);
            grad_blue[k] = real ? pixel[2] : Real(0);
            grad_cover[k] = real ? grad_alphas.data[(long long)image * height * width + at] : Real(0);
        }

//// error_gradients
        const Real scale = scales.data[image];
        grad_red = scale * load(state + LANES);
        grad_green = scale * load(state + 2 * LANES);
        grad_blue = scale * load(state + 3 * LANES);
        grad_cover = 0;

//// backward_body
                Real* const now = nows + t * PLANES * LANES;
                const Ints drawn = reached & (load(states + t * PLANES * LANES + 4 * LANES) > Vec(Real(i)));
                const Vec T = load(now), r0 = load(now + LANES), r1 = load(now + 2 * LANES);
                const Vec r2 = load(now + 3 * LANES), rest = load(now + 4 * LANES);
                const Vec own = drawn ? alpha : Vec(0);
                const Vec inverse = 1 / (1 - own);
                const Vec before = T * inverse, weight = own * before;
                const Vec shade = r0 * red + r1 * green + r2 * blue;
                Vec slope = own * (before * shade - rest * inverse);
                slope = raw <= Vec(alpha_max) ? slope : Vec(0);
                store(now, before);
                store(now + 4 * LANES, rest + weight * shade);
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
