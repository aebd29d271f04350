"""What a thread of encoder.py does, in C++ with the products of plain.py: the encoder on the patches of a row.

Symbols are those of tokens.py.
"""

from __future__ import annotations

import warp as wp

from .plain import source

SIZES = """
    const int T = sizes.data[0], P = sizes.data[1], E = sizes.data[2], F = sizes.data[3], L = sizes.data[4];
    const int H = sizes.data[5], D = sizes.data[6], layouts = sizes.data[7], layers = sizes.data[8];
    const int N = sizes.data[9], members = sizes.data[10], shares = sizes.data[11], C = T - P;
    const int Tp = (T + 31) / 32 * 32, Q = 2 * L + E, to = row % layouts;
    struct Rows {
        static void fill(float* c, int rows, int columns, const float* x) {
            for (int i = 0; i < rows; i++)
                for (int j = 0; j < columns; j += 16)
                    Vector::store(c + (long)i * columns + j, x ? Vector::load(x + j) : v16{});
        }
        static void turn(const float* x, long ldx, int rows, int columns, float* y, int ldy) {
            for (int j = 0; j < columns; j++)
                for (int i = 0; i < ldy; i++) y[(long)j * ldy + i] = i < rows ? x[i * ldx + j] : 0.0f;
        }
        static void norm(const float* x, int rows, int width, float* n, float* scale) {
            for (int i = 0; i < rows; i++) scale[i] = Vector::norm(x + (long)i * width, width, n + (long)i * width);
        }
        // adds the gradient of what was normalised, from that of its norm
        static void back(const float* d, const float* n, const float* scale, int rows, int width, float* x) {
            for (int i = 0; i < rows; i++, d += width, n += width, x += width) {
                v16 sum = {}, along = {};
                for (int j = 0; j < width; j += 16) {
                    sum += Vector::load(d + j);
                    along = Vector::fma(Vector::load(d + j), Vector::load(n + j), along);
                }
                const v16 mean = Vector::all(Vector::total(sum) / (float)width), over = Vector::all(scale[i]);
                const v16 part = Vector::all(Vector::total(along) / (float)width);
                for (int j = 0; j < width; j += 16) {
                    v16 g = Vector::load(d + j) - mean - Vector::load(n + j) * part;
                    Vector::store(x + j, Vector::fma(g, over, Vector::load(x + j)));
                }
            }
        }
        static void add(const float* x, float weight, int width, float* y) {
            for (int j = 0; j < width; j += 16)
                Vector::store(y + j, Vector::fma(Vector::all(weight), Vector::load(x + j), Vector::load(y + j)));
        }
    };
    // what the forward pass keeps of a row: see `places` of encoder.py
    const long TE = (long)T * E, TQ = (long)T * Q, TH = (long)T * H, PROBABLE = D ? (long)(L / D) * T * Tp : 0;
    const long LAYER = 3 * TE + TQ + PROBABLE + 2 * TH + 2 * T;
    const long KEPT = (long)P * (F + E) + (long)C * (F + E + 1) + layers * LAYER;
    float* const pooled = kept.data + row * KEPT;      // y [P,F]
    float* const means = pooled + (long)P * F;         // [C,F]
    float* const change = means + (long)C * F;         // [P,E]
    float* const last = change + (long)P * E;          // n(x) of velocities at the end [C,E]
    float* const last_scale = last + (long)C * E;      // [C]
    float* const of_layers = last_scale + C;
    // gradients of a row, of which those of weights are made: see `found_places` there
    const long FOUND_LAYER = TQ + 2 * TE + TH;
    // weights
    const long WEIGHTS = 2l * (Q * E + E * E + 2 * H * E), BIASES = Q + 2 * E + H;
    const float* const ends = weights.data + layers * WEIGHTS;  // heard^T, heard, pool^T, pool, W_v^T, W_v, velocity
    const float* const end_biases = biases.data + layers * BIASES;  // heard, pool, velocity
    const long EF = (long)E * F;
"""

FORWARD = source(
    SIZES
    + """
    const float* all = faces.data + (long)row * N * F;
    float* x = room.data + (long)row * (2 * TE + (long)L * Tp + (long)P * F + Tp);
    float* start = x + TE;
    float* turned = start + TE;
    float* said = turned + (long)L * Tp;
    float* open = said + (long)P * F;
    Rows::fill(pooled, P, F, nullptr);
    for (int p = 0; p < P; p++) {
        const wp::int64* begin = pool_start.data + (long)to * P + p;
        const long end = p + 1 < P ? begin[1] : (long)members;
        for (long m = begin[0]; m < end; m++)
            Rows::add(all + member.data[(long)to * members + m] * F, member_weight.data[(long)to * members + m], F,
                      pooled + (long)p * F);
    }
    Rows::fill(means, C, F, nullptr);
    Plain::times(pieces.data + (long)to * C * P, P, C, pooled, F, P, F, means, F);
    Rows::fill(x, P, E, end_biases + F);
    Plain::times(pooled, F, P, ends + 2 * EF, E, F, E, x, E);
    __builtin_memcpy(x + (long)P * E, given.data + (long)row * C * E, 4l * C * E);
    Plain::times(means, F, C, ends + 4 * EF, E, F, E, x + (long)P * E, E);
    __builtin_memcpy(start, x, 4 * TE);
    for (int j = 0; j < Tp; j++) open[j] = j < T && (!masks || mask.data[(long)row * T + j]) ? 1.0f : 0.0f;
    for (int layer = 0; layer < layers; layer++) {
        float* n1 = of_layers + layer * LAYER;
        float* keys = n1 + TE;  // queries, keys, values [T,Q]
        float* probable = keys + TQ;
        float* c = probable + PROBABLE;
        float* n2 = c + TE;
        float* h = n2 + TE;
        float* a = h + TH;
        float* s1 = a + TH;
        float* s2 = s1 + T;
        const float* w = weights.data + layer * WEIGHTS;
        const float* b = biases.data + layer * BIASES;
        Rows::norm(x, T, E, n1, s1);
        Rows::fill(keys, T, Q, b);
        Plain::times(n1, E, T, w, Q, E, Q, keys, Q);
        Rows::turn(keys + L, Q, T, L, turned, Tp);
        Rows::fill(c, T, E, nullptr);
        Rows::fill(probable, (int)(PROBABLE / Tp), Tp, nullptr);
        for (int k = 0; k * D < L; k++) {
            float* p = probable + (long)k * T * Tp;
            Plain::times(keys + k * D, Q, T, turned + (long)k * D * Tp, Tp, D, Tp, p, Tp);
            for (int i = 0; i < T; i++) {
                float* s = p + (long)i * Tp;
                v16 most = Vector::all(-1e30f), sum = {};
                for (int j = 0; j < Tp; j += 16)
                    most = __builtin_elementwise_max(most, Vector::load(open + j) > 0.0f ? Vector::load(s + j)
                                                                                        : Vector::all(-1e30f));
                float highest = most[0];
                for (int j = 1; j < 16; j++) highest = most[j] > highest ? most[j] : highest;
                for (int j = 0; j < Tp; j += 16) {
                    v16 e = Vector::exp(Vector::load(s + j) - Vector::all(highest));
                    e = Vector::load(open + j) > 0.0f ? e : v16{};
                    sum += e;
                    Vector::store(s + j, e);
                }
                const v16 over = Vector::all(1.0f / Vector::total(sum));
                for (int j = 0; j < Tp; j += 16) Vector::store(s + j, Vector::load(s + j) * over);
            }
            Plain::times(p, Tp, T, keys + 2 * L + k * D, Q, T, D, c + k * D, E);
        }
        if (L < E) {
            Plain::times(geodesic.data + (long)to * P * P, P, P, keys + 3 * L, Q, P, E - L, c + L, E);
            for (int i = P; i < T; i++) __builtin_memcpy(c + (long)i * E + L, keys + (long)i * Q + 3 * L, 4l * (E - L));
        }
        for (int i = 0; i < T; i++) Rows::add(b + Q, 1.0f, E, x + (long)i * E);
        w += 2l * Q * E;
        Plain::times(c, E, T, w, E, E, E, x, E);
        Rows::norm(x, T, E, n2, s2);
        Rows::fill(h, T, H, b + Q + E);
        w += 2l * E * E;
        Plain::times(n2, E, T, w, H, E, H, h, H);
        for (long i = 0; i < TH; i += 16) Vector::store(a + i, Vector::gelu(Vector::load(h + i)));
        for (int i = 0; i < T; i++) Rows::add(b + Q + E + H, 1.0f, E, x + (long)i * E);
        w += 2l * H * E;
        Plain::times(a, H, T, w, E, H, E, x, E);
    }
    for (long i = 0; i < (long)P * E; i += 16) Vector::store(change + i, Vector::load(x + i) - Vector::load(start + i));
    Rows::fill(said, P, F, end_biases);
    Plain::times(change, E, P, ends, F, E, F, said, F);
    Rows::norm(x + (long)P * E, C, E, last, last_scale);
    for (int i = 0; i < C; i++)
        for (int o = 0; o < 3; o++) {
            v16 sum = {};
            for (int j = 0; j < E; j += 16)
                sum = Vector::fma(Vector::load(ends + 6 * EF + o * E + j), Vector::load(last + (long)i * E + j), sum);
            velocity.data[((long)row * C + i) * 3 + o] = Vector::total(sum) + end_biases[F + E + o];
        }
    float* result = heard.data + (long)row * N * F;
    __builtin_memcpy(result, all, 4l * N * F);
    for (long f = 0; f < N; f++)
        for (int k = 0; k < shares; k++) {
            const long at = ((long)to * N + f) * shares + k;
            if (share.data[at] != 0.0f) Rows::add(said + patch.data[at] * F, share.data[at], F, result + f * F);
        }
"""
)


@wp.func_native(FORWARD)
def encoder_row(
    row: int,
    masks: int,
    sizes: wp.array[wp.int32],
    pool_start: wp.array[wp.int64],
    member: wp.array[wp.int64],
    member_weight: wp.array[wp.float32],
    patch: wp.array[wp.int64],
    share: wp.array[wp.float32],
    pieces: wp.array[wp.float32],
    geodesic: wp.array[wp.float32],
    mask: wp.array[wp.uint8],
    weights: wp.array[wp.float32],
    biases: wp.array[wp.float32],
    faces: wp.array[wp.float32],
    given: wp.array[wp.float32],
    room: wp.array[wp.float32],
    kept: wp.array[wp.float32],
    heard: wp.array[wp.float32],
    velocity: wp.array[wp.float32],
): ...


BACKWARD = source(
    SIZES
    + """
    const float* slope = gradient.data + (long)row * N * F;
    float* result = of_faces.data + (long)row * N * F;
    float* d_said = found.data + (long)row * ((long)P * F + TE + 16l * C + layers * FOUND_LAYER);  // [P,F]
    float* d_velocity = d_said + (long)P * F;          // [C,3]
    float* d_start = d_velocity + 16l * C;             // [T,E]
    float* of_found = d_start + TE;
    float* x = room.data + (long)row * (3 * TE + TH + (long)L * Tp + (long)T * Tp + (long)(P + C) * F);
    float* d_c = x + TE;
    float* d_n = d_c + TE;
    float* d_a = d_n + TE;
    float* turned = d_a + TH;
    float* d_p = turned + (long)L * Tp;
    float* d_means = d_p + (long)T * Tp;               // [C,F]
    float* d_pooled = d_means + (long)C * F;           // [P,F]
    __builtin_memcpy(result, slope, 4l * N * F);
    Rows::fill(d_said, P, F, nullptr);
    for (long f = 0; f < N; f++)
        for (int k = 0; k < shares; k++) {
            const long at = ((long)to * N + f) * shares + k;
            if (share.data[at] != 0.0f) Rows::add(slope + f * F, share.data[at], F, d_said + patch.data[at] * F);
        }
    Rows::fill(x, T, E, nullptr);
    Plain::times(d_said, F, P, ends + EF, E, F, E, x, E);
    for (long i = 0; i < (long)P * E; i += 16) Vector::store(d_start + i, -Vector::load(x + i));
    for (long i = (long)P * E; i < TE; i += 16) Vector::store(d_start + i, v16{});
    Rows::fill(d_n, C, E, nullptr);
    for (int i = 0; i < C; i++)
        for (int o = 0; o < 3; o++) {
            d_velocity[16 * i + o] = of_velocity.data[((long)row * C + i) * 3 + o];
            Rows::add(ends + 6 * EF + o * E, d_velocity[16 * i + o], E, d_n + (long)i * E);
        }
    Rows::back(d_n, last, last_scale, C, E, x + (long)P * E);
    for (int layer = layers - 1; layer >= 0; layer--) {
        const float* n1 = of_layers + layer * LAYER;
        const float* keys = n1 + TE;
        const float* probable = keys + TQ;
        const float* n2 = probable + PROBABLE + TE;
        const float* h = n2 + TE;
        const float* s1 = h + 2 * TH;
        const float* s2 = s1 + T;
        float* d_keys = of_found + layer * FOUND_LAYER;
        float* d_out = d_keys + TQ;
        float* d_h = d_out + TE;
        float* d_contract = d_h + TH;
        const float* w = weights.data + layer * WEIGHTS;
        const float* of_keys = w + (long)Q * E;
        const float* of_out = w + 2l * Q * E + (long)E * E;
        const float* of_expand = w + 2l * Q * E + 2l * E * E + (long)E * H;
        const float* of_contract = w + 2l * Q * E + 2l * E * E + 3l * E * H;
        __builtin_memcpy(d_contract, x, 4 * TE);
        Rows::fill(d_h, T, H, nullptr);
        Plain::times(x, E, T, of_contract, H, E, H, d_h, H);
        for (long i = 0; i < TH; i += 16)
            Vector::store(d_h + i, Vector::load(d_h + i) * Vector::slope(Vector::load(h + i)));
        Rows::fill(d_n, T, E, nullptr);
        Plain::times(d_h, H, T, of_expand, E, H, E, d_n, E);
        Rows::back(d_n, n2, s2, T, E, x);
        __builtin_memcpy(d_out, x, 4 * TE);
        Rows::fill(d_c, T, E, nullptr);
        Plain::times(x, E, T, of_out, E, E, E, d_c, E);
        Rows::fill(d_keys, T, Q, nullptr);
        Rows::turn(keys + 2 * L, Q, T, L, turned, Tp);
        for (int k = 0; k * D < L; k++) {
            const float* p = probable + (long)k * T * Tp;
            Rows::fill(d_p, T, Tp, nullptr);
            Plain::times(d_c + k * D, E, T, turned + (long)k * D * Tp, Tp, D, Tp, d_p, Tp);
            for (int i = 0; i < T; i++) {
                const float* one = p + (long)i * Tp;
                float* d = d_p + (long)i * Tp;
                v16 sum = {};
                for (int j = 0; j < Tp; j += 16) sum = Vector::fma(Vector::load(one + j), Vector::load(d + j), sum);
                const v16 mean = Vector::all(Vector::total(sum));
                for (int j = 0; j < Tp; j += 16)
                    Vector::store(d + j, Vector::load(one + j) * (Vector::load(d + j) - mean));
            }
            Plain::times(d_p, Tp, T, keys + L + k * D, Q, T, D, d_keys + k * D, Q);
            Plain::outer(d_p, Tp, T, keys + k * D, Q, T, D, d_keys + L + k * D, Q);
            Plain::outer(p, Tp, T, d_c + k * D, E, T, D, d_keys + 2 * L + k * D, Q);
        }
        if (L < E) {
            Plain::outer(geodesic.data + (long)to * P * P, P, P, d_c + L, E, P, E - L, d_keys + 3 * L, Q);
            for (int i = P; i < T; i++)
                __builtin_memcpy(d_keys + (long)i * Q + 3 * L, d_c + (long)i * E + L, 4l * (E - L));
        }
        Rows::fill(d_n, T, E, nullptr);
        Plain::times(d_keys, Q, T, of_keys, E, Q, E, d_n, E);
        Rows::back(d_n, n1, s1, T, E, x);
    }
    for (long i = 0; i < TE; i += 16) Vector::store(d_start + i, Vector::load(d_start + i) + Vector::load(x + i));
    __builtin_memcpy(of_given.data + (long)row * C * E, d_start + (long)P * E, 4l * C * E);
    Rows::fill(d_means, C + P, F, nullptr);
    Plain::times(d_start + (long)P * E, E, C, ends + 5 * EF, F, E, F, d_means, F);
    Plain::times(d_start, E, P, ends + 3 * EF, F, E, F, d_pooled, F);
    Plain::outer(pieces.data + (long)to * C * P, P, P, d_means, F, C, F, d_pooled, F);
    for (int p = 0; p < P; p++) {
        const wp::int64* begin = pool_start.data + (long)to * P + p;
        const long end = p + 1 < P ? begin[1] : (long)members;
        for (long m = begin[0]; m < end; m++)
            Rows::add(d_pooled + (long)p * F, member_weight.data[(long)to * members + m], F,
                      result + member.data[(long)to * members + m] * F);
    }
"""
)


@wp.func_native(BACKWARD)
def gradient_row(
    row: int,
    sizes: wp.array[wp.int32],
    pool_start: wp.array[wp.int64],
    member: wp.array[wp.int64],
    member_weight: wp.array[wp.float32],
    patch: wp.array[wp.int64],
    share: wp.array[wp.float32],
    pieces: wp.array[wp.float32],
    geodesic: wp.array[wp.float32],
    weights: wp.array[wp.float32],
    biases: wp.array[wp.float32],
    kept: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    of_velocity: wp.array[wp.float32],
    room: wp.array[wp.float32],
    found: wp.array[wp.float32],
    of_faces: wp.array[wp.float32],
    of_given: wp.array[wp.float32],
): ...


@wp.func_native(
    source("""
    const int* of = table.data + 9 * part;
    float* bias = of[8] < 0 ? nullptr : sums.data + of[8];
    for (int row = 0; row < rows; row++) {
        const float* a = found.data + (long)row * found_length + of[0];
        const float* b = kept.data + (long)row * kept_length + of[3];
        Plain::outer(a, of[1], of[2], b, of[4], of[6], of[5], sums.data + of[7], of[5]);
        for (int k = 0; bias && k < of[6]; k++)
            for (int i = 0; i < of[2]; i++) bias[i] += a[(long)k * of[1] + i];
    }
""")
)
def outer_part(
    part: int,
    rows: int,
    found_length: int,
    kept_length: int,
    table: wp.array[wp.int32],
    found: wp.array[wp.float32],
    kept: wp.array[wp.float32],
    sums: wp.array[wp.float32],
): ...
