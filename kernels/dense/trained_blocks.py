"""What a thread of trained.py does, in C++ with the products of products.py: a layer of faces and its gradients.

A sum over faces, as the gradient of weights is, is a product whose left side has faces as columns and whose right side
has them as rows:

    Turned::columns    32 rows as the left side, turned
    Turned::rows       32 rows as the right side
"""

from __future__ import annotations

import warp as wp

from .products import source

TURNED = """
struct Turned {
    static inline void columns(const float* x, int width, Matrix::Left left) {
        for (int j = 0; j < width; j += 16)
            for (int half = 0; half < 32; half += 16) {
                v16 r[16], n[16];
                for (int i = 0; i < 16; i++) r[i] = Vector::load(x + (half + i) * width + j);
                for (int s = 0; s < 4; s++) {
                    for (int i = 0; i < 8; i++) {
                        n[2 * i] = __builtin_shufflevector(r[i], r[i + 8], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6,
                                                           22, 7, 23);
                        n[2 * i + 1] = __builtin_shufflevector(r[i], r[i + 8], 8, 24, 9, 25, 10, 26, 11, 27, 12, 28,
                                                               13, 29, 14, 30, 15, 31);
                    }
                    for (int i = 0; i < 16; i++) r[i] = n[i];
                }
                for (int i = 0; i < 16; i++)
                    left.put(32 * (j + i) + half, r[i]);
            }
    }
    static inline void rows(const float* x, int width, float* to) {
        for (int i = 0; i < 32; i += 2)
            for (int j = 0; j < width; j += 16)
                Matrix::rows(to + 32 * j, i, Vector::load(x + i * width + j), Vector::load(x + (i + 1) * width + j));
    }
    // rows of [own, mean of own over three neighbours]
    static inline void heard(const float* own, const wp::int64* side, int from, int many, int width, int hears,
                             float* to) {
        const int wide = hears ? 2 * width : width;
        for (int i = 0; i < 32; i++)
            for (int j = 0; j < width; j += 16) {
                Vector::store(to + i * wide + j, i < many ? Vector::load(own + (long)(from + i) * width + j) : v16{});
                if (!hears) continue;
                v16 sum = {};
                for (int k = 0; k < 3 && i < many; k++)
                    sum += Vector::load(own + side[3 * (long)(from + i) + k] * width + j);
                Vector::store(to + i * wide + width + j, sum * Vector::all(1.0f / 3.0f));
            }
    }
};
"""


@wp.func_native(
    source("""
    for (int i = 32 * t; i < 32 * t + 32 && i < count; i++)
        scale.data[i] = Vector::norm(faces.data + (long)i * width, width, own.data + (long)i * width);
""")
)
def norm_block(
    t: int,
    count: int,
    width: int,
    faces: wp.array[wp.float32],
    own: wp.array[wp.float32],
    scale: wp.array[wp.float32],
): ...


@wp.func_native(
    source(
        TURNED
        + """
    alignas(64) float o[32 * 512], h[32 * 256], c[32 * 256];
    LEFT(left, 32 * 512);
    const int from = 32 * t, many = count - from < 32 ? count - from : 32, wide = hears ? 2 * width : width;
    Turned::heard(own.data, side.data, from, many, width, hears, o);
    for (int i = 0; i < 32 * wide; i += 16) left.put(i, Vector::load(o + i));
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < hidden; j += 16) Vector::store(h + i * hidden + j, Vector::load(expand_bias.data + j));
    Matrix::begin();
    Matrix::product(left, wide, expand.data, 0, wide / 32, wide / 32, hidden, h, hidden);
    __builtin_memcpy(inner.data + (long)from * hidden, h, 4l * many * hidden);
    for (int i = 0; i < 32 * hidden; i += 16) left.put(i, Vector::gelu(Vector::load(h + i)));
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16) {
            v16 old = i < many ? Vector::load(faces.data + (long)(from + i) * width + j) : v16{};
            Vector::store(c + i * width + j, old + Vector::load(contract_bias.data + j));
        }
    Matrix::product(left, hidden, contract.data, 0, hidden / 32, hidden / 32, width, c, width);
    Matrix::end();
    __builtin_memcpy(result.data + (long)from * width, c, 4l * many * width);
"""
    )
)
def layer_block(
    t: int,
    count: int,
    width: int,
    hidden: int,
    hears: int,
    side: wp.array[wp.int64],
    expand: wp.array[wp.float32],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    contract_bias: wp.array[wp.float32],
    faces: wp.array[wp.float32],
    own: wp.array[wp.float32],
    inner: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...


@wp.func_native(
    source(
        TURNED
        + """
    alignas(64) float g[32 * 256], s[32 * 256], a[32 * 256], o[32 * 512];
    LEFT(left, 32 * 256);
    alignas(64) float right[32 * 512];
    const int wide = hears ? 2 * width : width, blocks = (count + 31) / 32;
    float* of_expand = sums.data + (long)t * (hidden * (wide + 1) + width * (hidden + 1));
    float* of_expand_bias = of_expand + (long)hidden * wide;
    float* of_contract = of_expand_bias + hidden;
    float* of_contract_bias = of_contract + (long)width * hidden;
    __builtin_memset(of_expand, 0, 4l * (hidden * (wide + 1) + width * (hidden + 1)));
    Matrix::begin();
    for (int block = t * blocks / parts; block < (t + 1) * blocks / parts; block++) {
        const int from = 32 * block, many = count - from < 32 ? count - from : 32;
        for (int i = 0; i < 32; i++)
            for (int j = 0; j < width; j += 16) {
                v16 x = i < many ? Vector::load(gradient.data + (long)(from + i) * width + j) : v16{};
                Vector::store(g + i * width + j, x);
                left.put(i * width + j, x);
                Vector::store(of_contract_bias + j, Vector::load(of_contract_bias + j) + x);
            }
        for (int i = 0; i < 32 * hidden; i += 16) Vector::store(s + i, v16{});
        Matrix::product(left, width, contract.data, 0, width / 32, width / 32, hidden, s, hidden);
        for (int i = 0; i < 32; i++)
            for (int j = 0; j < hidden; j += 16) {
                v16 x = i < many ? Vector::load(inner.data + (long)(from + i) * hidden + j) : v16{};
                v16 d = Vector::load(s + i * hidden + j) * Vector::slope(x);
                Vector::store(a + i * hidden + j, Vector::gelu(x));
                Vector::store(s + i * hidden + j, d);
                Vector::store(of_expand_bias + j, Vector::load(of_expand_bias + j) + d);
            }
        Turned::columns(g, width, left);
        Turned::rows(a, hidden, right);
        for (int m = 0; m < width; m += 32)
            Matrix::product(left.after(32 * m), 32, right, 0, 1, 1, hidden, of_contract + (long)m * hidden,
                           hidden);
        Turned::heard(own.data, side.data, from, many, width, hears, o);
        Turned::columns(s, hidden, left);
        Turned::rows(o, wide, right);
        for (int m = 0; m < hidden; m += 32)
            Matrix::product(left.after(32 * m), 32, right, 0, 1, 1, wide, of_expand + (long)m * wide, wide);
        for (int i = 0; i < 32 * hidden; i += 16) left.put(i, Vector::load(s + i));
        for (int i = 0; i < 32 * wide; i += 16) Vector::store(o + i, v16{});
        Matrix::product(left, hidden, expand.data, 0, hidden / 32, hidden / 32, wide, o, wide);
        __builtin_memcpy(heard.data + (long)from * wide, o, 4l * many * wide);
    }
    Matrix::end();
"""
    )
)
def gradient_part(
    t: int,
    parts: int,
    count: int,
    width: int,
    hidden: int,
    hears: int,
    side: wp.array[wp.int64],
    expand: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    own: wp.array[wp.float32],
    inner: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    heard: wp.array[wp.float32],
    sums: wp.array[wp.float32],
): ...


@wp.func_native(
    source("""
    const int wide = hears ? 2 * width : width;
    for (int i = 32 * t; i < 32 * t + 32 && i < count; i++) {
        float* x = result.data + (long)i * width;
        const float *n = own.data + (long)i * width, *g = gradient.data + (long)i * width;
        const long last = !hears ? 0 : i + 1 < count ? start.data[i + 1] : 3l * count;
        v16 sum = {}, along = {};
        for (int j = 0; j < width; j += 16) {
            v16 d = {};
            for (long e = hears ? start.data[i] : 0; e < last; e++)
                d += Vector::load(heard.data + owner.data[e] * wide + width + j);
            d = Vector::fma(d, Vector::all(1.0f / 3.0f), Vector::load(heard.data + (long)i * wide + j));
            Vector::store(x + j, d);
            sum += d;
            along = Vector::fma(d, Vector::load(n + j), along);
        }
        const v16 mean = Vector::all(Vector::total(sum) / (float)width);
        const v16 part = Vector::all(Vector::total(along) / (float)width);
        const v16 over = Vector::all(scale.data[i]);
        for (int j = 0; j < width; j += 16) {
            v16 d = Vector::load(x + j) - mean - Vector::load(n + j) * part;
            Vector::store(x + j, Vector::fma(d, over, Vector::load(g + j)));
        }
    }
""")
)
def back_block(
    t: int,
    count: int,
    width: int,
    hears: int,
    start: wp.array[wp.int64],
    owner: wp.array[wp.int64],
    own: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    heard: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...
