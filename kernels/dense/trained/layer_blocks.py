"""What a thread of layer.py does, in C++: a layer of faces and its gradients.

Products with weights are those of products.py; sums over faces are outer products of plain.py.
"""

from __future__ import annotations

import warp as wp

from warpgarment.kernels.dense.products import source

from . import plain

HEARD = """
struct Heard {
    // the mean of own over three neighbours of each face
    static inline void mean(const float* own, const wp::int64* side, long from, int many, int width, float* to,
                            int wide) {
        for (int i = 0; i < many; i++)
            for (int j = 0; j < width; j += 16) {
                v16 sum = {};
                for (int k = 0; k < 3; k++) sum += Vector::load(own + side[3 * (from + i) + k] * width + j);
                Vector::store(to + (long)i * wide + j, sum * Vector::all(1.0f / 3.0f));
            }
    }
    // rows of [own, mean], 32 of them, with zeros after the first `many`
    static inline void rows(const float* own, const wp::int64* side, long from, int many, int width, int hears,
                            float* to) {
        const int wide = hears ? 2 * width : width;
        for (int i = 0; i < 32; i++)
            for (int j = 0; j < wide; j += 16) {
                v16 x = i < many && j < width ? Vector::load(own + (from + i) * width + j) : v16{};
                Vector::store(to + i * wide + j, x);
            }
        if (hears) mean(own, side, from, many, width, to + width, wide);
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
        HEARD
        + """
    alignas(64) float o[32 * 512], h[32 * 256], c[32 * 256];
    LEFT(left, 32 * 512);
    const int from = 32 * t, many = count - from < 32 ? count - from : 32, wide = hears ? 2 * width : width;
    Heard::rows(own.data, side.data, from, many, width, hears, o);
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
    source("""
    alignas(64) float s[32 * 256], o[32 * 512];
    LEFT(left, 32 * 256);
    const int wide = hears ? 2 * width : width, from = 32 * t, many = count - from < 32 ? count - from : 32;
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16)
            left.put(i * width + j, i < many ? Vector::load(gradient.data + (long)(from + i) * width + j) : v16{});
    for (int i = 0; i < 32 * hidden; i += 16) Vector::store(s + i, v16{});
    Matrix::begin();
    Matrix::product(left, width, contract.data, 0, width / 32, width / 32, hidden, s, hidden);
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < hidden; j += 16) {
            v16 x = i < many ? Vector::load(inner.data + (long)(from + i) * hidden + j) : v16{};
            v16 d = Vector::load(s + i * hidden + j) * Vector::slope(x);
            Vector::store(s + i * hidden + j, d);
            left.put(i * hidden + j, d);
        }
    __builtin_memcpy(slopes.data + (long)from * hidden, s, 4l * many * hidden);
    for (int i = 0; i < 32 * wide; i += 16) Vector::store(o + i, v16{});
    Matrix::product(left, hidden, expand.data, 0, hidden / 32, hidden / 32, wide, o, wide);
    Matrix::end();
    __builtin_memcpy(heard.data + (long)from * wide, o, 4l * many * wide);
""")
)
def slope_block(
    t: int,
    count: int,
    width: int,
    hidden: int,
    hears: int,
    expand: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    inner: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    slopes: wp.array[wp.float32],
    heard: wp.array[wp.float32],
): ...


@wp.func_native(
    plain.source(
        HEARD
        + """
    alignas(64) float a[128 * 256];
    const int wide = hears ? 2 * width : width;
    float* of_expand = sums.data;
    float* of_expand_bias = of_expand + (long)hidden * wide;
    float* of_contract = of_expand_bias + hidden;
    float* of_contract_bias = of_contract + (long)width * hidden;
    for (long from = begin; from < end; from += 128) {
        const int many = end - from < 128 ? end - from : 128;
        const float* g = gradient.data + from * width;
        const float* s = slopes.data + from * hidden;
        for (int i = 0; i < many; i++) {
            for (int j = 0; j < width; j += 16) {
                v16 sum = Vector::load(of_contract_bias + j) + Vector::load(g + i * width + j);
                Vector::store(of_contract_bias + j, sum);
            }
            for (int j = 0; j < hidden; j += 16)
                Vector::store(of_expand_bias + j, Vector::load(of_expand_bias + j) + Vector::load(s + i * hidden + j));
        }
        for (int i = 0; i < many * hidden; i += 16)
            Vector::store(a + i, Vector::gelu(Vector::load(inner.data + from * hidden + i)));
        Plain::outer(g, width, width, a, hidden, many, hidden, of_contract, hidden);
        Plain::outer(s, hidden, hidden, own.data + from * width, width, many, width, of_expand, wide);
        if (!hears) continue;
        Heard::mean(own.data, side.data, from, many, width, a, width);
        Plain::outer(s, hidden, hidden, a, width, many, width, of_expand + width, wide);
    }
"""
    )
)
def outer_faces(
    begin: int,
    end: int,
    width: int,
    hidden: int,
    hears: int,
    side: wp.array[wp.int64],
    own: wp.array[wp.float32],
    inner: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    slopes: wp.array[wp.float32],
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
