"""What a thread of tokens.py does with its block of 32 tokens, as functions in C++ on the products of products.py.

Each stage reads keys and values of all blocks and writes those of its own block for the next stage, so there are two
rooms for them. T, P, C, E and F are those of tokens.py; L are the learned columns, H the hidden width, D the width of a
head.

| in `room`, for each row | numbers | |
| --- | --- | --- |
| x, start | T' E each | T' is T padded to blocks |
| y | T' F | |
| q, k, v, twice | T' learned, T' learned, T' E | k and v packed as the right side of a product, |
"""

from __future__ import annotations

import warp as wp

from .products import source

SIZES = """
    const int T = sizes.data[0], P = sizes.data[1], E = sizes.data[2], F = sizes.data[3], L = sizes.data[4];
    const int H = sizes.data[5], D = sizes.data[6], layouts = sizes.data[7], layers = sizes.data[8], C = T - P;
    const int blocks = (T + 31) / 32, Tp = 32 * blocks, Q = 2 * L + E;
"""

POOL = source(
    SIZES
    + """
    alignas(64) float c[32 * 256];
    LEFT(left, 32 * 256);
    const int parts = (P + 31) / 32, row = t / parts, from = 32 * (t % parts), many = P - from < 32 ? P - from : 32;
    const long stride = (long)Tp * (2 * E + F) + 2l * Tp * Q, to = row % layouts;
    float* x = room.data + row * stride;
    float* y = x + 2l * Tp * E;
    const float* all = faces.data + (long)row * count * F;
    for (int i = 0; i < 32; i++) {
        v16 sum[16] = {};
        if (i < many) {
            const wp::int64* begin = start.data + to * P + from + i;
            const long end = from + i + 1 < P ? begin[1] : (long)members;
            for (long m = begin[0]; m < end; m++) {
                const float* face = all + member.data[to * members + m] * F;
                v16 w = Vector::all(weight.data[to * members + m]);
                for (int j = 0; j < F / 16; j++) sum[j] = Vector::fma(w, Vector::load(face + 16 * j), sum[j]);
            }
            for (int j = 0; j < F / 16; j++) Vector::store(y + (from + i) * F + 16 * j, sum[j]);
        }
        for (int j = 0; j < F / 16; j++) left.put(i * F + 16 * j, sum[j]);
        for (int j = 0; j < E; j += 16) Vector::store(c + i * E + j, Vector::load(bias.data + j));
    }
    Matrix::begin();
    Matrix::product(left, F, packed.data, 0, F / 32, F / 32, E, c, E);
    Matrix::end();
    __builtin_memcpy(x + from * E, c, 4l * many * E);
    __builtin_memcpy(x + (Tp + from) * E, c, 4l * many * E);
"""
)


@wp.func_native(POOL)
def pool_block(
    t: int,
    sizes: wp.array[wp.int32],
    count: int,
    members: int,
    start: wp.array[wp.int64],
    member: wp.array[wp.int64],
    weight: wp.array[wp.float32],
    packed: wp.array[wp.float32],
    bias: wp.array[wp.float32],
    faces: wp.array[wp.float32],
    room: wp.array[wp.float32],
): ...


LAYER = """
    if (stage > 0) {  // attention
        const float* w = weights.data + (stage - 1) * layer_weights;
        const float* b = biases.data + (stage - 1) * layer_biases;
        const float* q = keys_of(stage - 1);
        const float* k = q + (long)Tp * L;
        const float* v = q + 2l * Tp * L;
        for (int j = 0; j < Tp; j++) open[j] = j < T && (!masks || mask.data[(long)row * T + j]) ? 1.0f : 0.0f;
        for (int i = 0; i < down * E; i += 16) Vector::store(c + i, v16{});
        for (int h = 0; h < L / D; h++) {
            for (int i = 0; i < down; i++) {
                for (int j = 0; j < D; j += 16)
                    left.put(i * D + j, Vector::load(q + (long)(from + i) * L + h * D + j));
                for (int j = 0; j < Tp; j += 16) Vector::store(s + i * Tp + j, v16{});
            }
            Matrix::product(left, D, k + (long)h * Tp * D, 0, D / 32, D / 32, Tp, s, Tp, down);
            for (int i = 0; i < down; i++) {
                v16 most = Vector::all(-1e30f), sum = {};
                for (int j = 0; j < Tp; j += 16)
                    most = __builtin_elementwise_max(most, Vector::load(open + j) > 0.0f ? Vector::load(s + i * Tp + j)
                                                                                        : Vector::all(-1e30f));
                float highest = most[0];
                for (int j = 1; j < 16; j++) highest = most[j] > highest ? most[j] : highest;
                for (int j = 0; j < Tp; j += 16) {
                    v16 p = Vector::exp(Vector::load(s + i * Tp + j) - Vector::all(highest));
                    p = Vector::load(open + j) > 0.0f ? p : v16{};
                    sum += p;
                    left.put(i * Tp + j, p);
                }
                scale[i] = 1.0f / Vector::total(sum);
            }
            Matrix::product(left, Tp, v + (long)h * D * Tp, 0, blocks, blocks, D, c + h * D, E, down);
            for (int i = 0; i < down; i++)
                for (int j = h * D; j < h * D + D; j += 16)
                    Vector::store(c + i * E + j, Vector::load(c + i * E + j) * Vector::all(scale[i]));
        }
        if (L < E) {
            const float* g = geodesic.data + (long)(row % layouts) * P * P;
            for (int i = 0; i < down; i++)
                for (int j = 0; j < Tp; j += 16) {
                    const int r = from + i;
                    v16 a = Vector::load(g + (long)r * P + j, r < P ? P - j : 0);
                    if (r >= P && r < T && j <= r && r < j + 16) a[r - j] = 1.0f;
                    left.put(i * Tp + j, a);
                }
            Matrix::product(left, Tp, v + (long)L * Tp, 0, blocks, blocks, E - L, c + L, E, down);
        }
        for (int i = 0; i < down; i++) {
            inner.row(i, c + i * E, E);
            for (int j = 0; j < E; j += 16)
                Vector::store(x + i * E + j, Vector::load(x + i * E + j) + Vector::load(b + Q + j));
        }
        w += Inner::size(Q, E);
        Inner::product(inner, E, w, E / 32, E, x, E, down);
        for (int i = 0; i < down; i++) {  // feed-forward
            Vector::norm(x + i * E, E, c);
            inner.row(i, c, E);
            for (int j = 0; j < E; j += 16)
                Vector::store(x + i * E + j, Vector::load(x + i * E + j) + Vector::load(b + Q + E + H + j));
            for (int j = 0; j < H; j += 16) Vector::store(s + i * H + j, Vector::load(b + Q + E + j));
        }
        w += Inner::size(E, E);
        Inner::product(inner, E, w, E / 32, H, s, H, down);
        for (int i = 0; i < down; i++) {
            float* y = s + i * H;
            for (int j = 0; j < H; j += 16) Vector::store(y + j, Vector::gelu(Vector::load(y + j)));
            inner.row(i, y, H);
        }
        w += Inner::size(H, E);
        Inner::product(inner, H, w, H / 32, E, x, E, down);
    }
"""

KEYS = """
    if (stage < layers) {
        const float* w = weights.data + stage * layer_weights;
        const float* b = biases.data + stage * layer_biases;
        float* q = (float*)keys_of(stage);
        float* k = q + (long)Tp * L;
        float* v = q + 2l * Tp * L;
        for (int i = 0; i < down; i++) {
            Vector::norm(x + i * E, E, c);
            inner.row(i, c, E);
            for (int j = 0; j < Q; j += 16) Vector::store(s + i * Q + j, Vector::load(b + j));
        }
        Inner::product(inner, E, w, E / 32, Q, s, Q, down);
        for (int i = 0; i < 32; i++) {
            if (i >= many)
                for (int j = 0; j < Q; j += 16) Vector::store(s + i * Q + j, v16{});
            __builtin_memcpy(q + (long)(from + i) * L, s + i * Q, 4l * L);
            for (int j = 0; j < L; j += 32) {  // 32 numbers of a key are a column of a tile
                const int h = j / D, step = (j % D) / 32, tile = (from + i) / 16;
                const float* key = s + i * Q + L + j;
                Matrix::column(k + (long)h * Tp * D + ((long)tile * (D / 32) + step) * 512, i % 16, Vector::load(key),
                               Vector::load(key + 16));
            }
        }
        for (int i = 0; i < 32; i += 2)
            for (int j = 0; j < E; j += 16) {
                const float* value = s + i * Q + 2 * L + j;
                Matrix::rows(v + ((long)(j / 16) * blocks + from / 32) * 512, i, Vector::load(value),
                             Vector::load(value + Q));
            }
    }
"""

LAST = """
    if (stage == layers) {
        const float* b = biases.data + layers * layer_biases;
        const float* at_start = x + (long)Tp * E;
        for (int i = 0; i < down; i++) {
            for (int j = 0; j < E; j += 16) {
                v16 change = Vector::load(x + i * E + j) - Vector::load(at_start + i * E + j);
                left.put(i * E + j, change);
            }
            for (int j = 0; j < F; j += 16) Vector::store(s + i * F + j, Vector::load(b + j));
        }
        const float* w = weights.data + layers * layer_weights;
        Matrix::product(left, E, w, 0, E / 32, E / 32, F, s, F, down);
        const int patches = P - from < 0 ? 0 : (P - from < 32 ? P - from : 32);
        __builtin_memcpy(heard.data + ((long)row * P + from) * F, s, 4l * patches * F);
        for (int i = patches; i < many; i++) {
            Vector::norm(x + i * E, E, c);
            for (int o = 0; o < 3; o++) {
                v16 sum = {};
                const float* w = b + F + 3 + o * E;
                for (int j = 0; j < E; j += 16) sum = Vector::fma(Vector::load(w + j), Vector::load(c + j), sum);
                velocity.data[((long)row * C + from + i - P) * 3 + o] = Vector::total(sum) + b[F + o];
            }
        }
    }
"""

STAGE = source(
    SIZES
    + """
    alignas(64) float c[32 * 256], s[32 * 1024], open[1024], scale[32];
    LEFT(left, 32 * 1024);
    INNER(inner, 32 * 256);
    const int row = t / blocks, from = 32 * (t % blocks), many = T - from < 32 ? T - from : 32;
    const int down = (many + 7) / 8 * 8;
    const long layer_weights = Inner::size(Q, E) + Inner::size(E, E) + Inner::size(H, E) + Inner::size(E, H);
    const long layer_biases = Q + 2 * E + H;
    const long stride = (long)Tp * (2 * E + F) + 2l * Tp * Q;
    float* mine = room.data + row * stride;
    float* x = mine + (long)from * E;
    const float* y = mine + 2l * Tp * E;
    auto keys_of = [=](int number) { return y + (long)Tp * F + (number % 2) * (long)Tp * Q; };
    if (stage == 0) {
        const float* lift = biases.data + layers * layer_biases + F + 3 + 3 * E;
        for (int i = 0; i < down; i++) {
            const int token = from + i - P;
            if (token < 0) continue;
            for (int j = 0; j < F; j += 16) {
                v16 mean = {};
                for (int p = 0; token < C && p < P; p++) {
                    const float part = pieces.data[((long)(row % layouts) * C + token) * P + p];
                    mean = Vector::fma(Vector::all(part), Vector::load(y + (long)p * F + j), mean);
                }
                Vector::store(c + j, mean);
            }
            for (int e = 0; e < E; e++) {
                v16 sum = {};
                const float* w = lift + (long)e * F;
                for (int j = 0; j < F; j += 16) sum = Vector::fma(Vector::load(w + j), Vector::load(c + j), sum);
                x[i * E + e] = token < C ? given.data[((long)row * C + token) * E + e] + Vector::total(sum) : 0.0f;
            }
            __builtin_memcpy(x + ((long)Tp + i) * E, x + i * E, 4l * E);
        }
    }
    Matrix::begin();
"""
    + LAYER
    + KEYS
    + LAST
    + """
    Matrix::end();
"""
)


@wp.func_native(STAGE)
def stage_block(
    t: int,
    stage: int,
    masks: int,
    sizes: wp.array[wp.int32],
    pieces: wp.array[wp.float32],
    geodesic: wp.array[wp.float32],
    mask: wp.array[wp.uint8],
    weights: wp.array[wp.float32],
    biases: wp.array[wp.float32],
    given: wp.array[wp.float32],
    room: wp.array[wp.float32],
    heard: wp.array[wp.float32],
    velocity: wp.array[wp.float32],
): ...
