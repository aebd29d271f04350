"""What a thread of trained.py does, as functions in C++ on the tiles of tiles.py: a layer of faces and its gradients.

A sum over faces, as the gradient of weights is, is a product whose left side has faces as columns and whose right side
has them as rows:

    Turned::columns    32 rows as hi and lo of their transpose
    Turned::pairs      32 rows as the right side of a product
    Turned::slope      the derivative of GELU, 1 - T'(x) or T'(-x), by the derivatives of the polynomials; error 1e-6
"""

from __future__ import annotations

import warp as wp

from .tiles import source

TURNED = """
struct Turned {
    static inline void columns(const float* x, int width, __bf16* hi, __bf16* lo) {
        for (int j = 0; j < width; j += 16)
            for (int half = 0; half < 32; half += 16) {
                v16 r[16], n[16];
                for (int i = 0; i < 16; i++) r[i] = Tiles::load(x + (half + i) * width + j);
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
                    Tiles::split(r[i], hi + 32 * (j + i) + half, lo + 32 * (j + i) + half);
            }
    }
    typedef __bf16 h32 __attribute__((vector_size(64), aligned(2)));
    static inline void pairs(const float* x, int width, __bf16* to) {
        for (int i = 0; i < 32; i += 2)
            for (int j = 0; j < width; j += 16) {
                alignas(64) __bf16 both[2][2][16];
                for (int n = 0; n < 2; n++) Tiles::split(Tiles::load(x + (i + n) * width + j), both[0][n], both[1][n]);
                for (int part = 0; part < 2; part++)
                    *(h32*)(to + (j / 16) * 1024 + 512 * part + 16 * i) = __builtin_shufflevector(
                        *(h16*)both[part][0], *(h16*)both[part][1], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7,
                        23, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
            }
    }
    static inline v16 slope(v16 x) {
        v16 a = __builtin_elementwise_min(__builtin_elementwise_abs(x), Tiles::all(5.999f));
        v16 u = Tiles::fma(a, Tiles::all(32.0f / 6.0f), Tiles::all(-0.5f));
        v16 place = u + Tiles::all(12582912.0f);
        v16 t = u - (place - Tiles::all(12582912.0f));
        i16 piece = (i16)place;
        v16 p = Tiles::all(4.0f) * __builtin_ia32_vpermi2varps512(T4);
        p = Tiles::fma(p, t, Tiles::all(3.0f) * __builtin_ia32_vpermi2varps512(T3));
        p = Tiles::fma(p, t, Tiles::all(2.0f) * __builtin_ia32_vpermi2varps512(T2));
        p = Tiles::fma(p, t, __builtin_ia32_vpermi2varps512(T1)) * Tiles::all(32.0f / 6.0f);
        return x > 0.0f ? Tiles::all(1.0f) - p : p;
    }
    // rows of [own, mean of own over three neighbours]
    static inline void heard(const float* own, const wp::int64* side, int from, int many, int width, int hears,
                             float* to) {
        const int wide = hears ? 2 * width : width;
        for (int i = 0; i < 32; i++)
            for (int j = 0; j < width; j += 16) {
                Tiles::store(to + i * wide + j, i < many ? Tiles::load(own + (long)(from + i) * width + j) : v16{});
                if (!hears) continue;
                v16 sum = {};
                for (int k = 0; k < 3 && i < many; k++)
                    sum += Tiles::load(own + side[3 * (long)(from + i) + k] * width + j);
                Tiles::store(to + i * wide + width + j, sum * Tiles::all(1.0f / 3.0f));
            }
    }
};
"""


@wp.func_native(
    source("""
    for (int i = 32 * t; i < 32 * t + 32 && i < count; i++)
        scale.data[i] = Tiles::norm(faces.data + (long)i * width, width, own.data + (long)i * width);
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
    alignas(64) __bf16 hi[32 * 512], lo[32 * 512];
    const int from = 32 * t, many = count - from < 32 ? count - from : 32, wide = hears ? 2 * width : width;
    Turned::heard(own.data, side.data, from, many, width, hears, o);
    for (int i = 0; i < 32 * wide; i += 16) Tiles::split(Tiles::load(o + i), hi + i, lo + i);
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < hidden; j += 16) Tiles::store(h + i * hidden + j, Tiles::load(expand_bias.data + j));
    Tiles::begin();
    Tiles::product(hi, lo, wide, (const __bf16*)expand.data, 0, wide / 32, wide / 32, hidden, h, hidden);
    __builtin_memcpy(inner.data + (long)from * hidden, h, 4l * many * hidden);
    for (int i = 0; i < 32 * hidden; i += 16) Tiles::split(Tiles::gelu(Tiles::load(h + i)), hi + i, lo + i);
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16) {
            v16 old = i < many ? Tiles::load(faces.data + (long)(from + i) * width + j) : v16{};
            Tiles::store(c + i * width + j, old + Tiles::load(contract_bias.data + j));
        }
    Tiles::product(hi, lo, hidden, (const __bf16*)contract.data, 0, hidden / 32, hidden / 32, width, c, width);
    Tiles::end();
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
    expand: wp.array[wp.int16],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.int16],
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
    alignas(64) __bf16 hi[32 * 256], lo[32 * 256], right[32 * 1024];
    const int wide = hears ? 2 * width : width, blocks = (count + 31) / 32;
    float* of_expand = sums.data + (long)t * (hidden * (wide + 1) + width * (hidden + 1));
    float* of_expand_bias = of_expand + (long)hidden * wide;
    float* of_contract = of_expand_bias + hidden;
    float* of_contract_bias = of_contract + (long)width * hidden;
    __builtin_memset(of_expand, 0, 4l * (hidden * (wide + 1) + width * (hidden + 1)));
    Tiles::begin();
    for (int block = t * blocks / parts; block < (t + 1) * blocks / parts; block++) {
        const int from = 32 * block, many = count - from < 32 ? count - from : 32;
        for (int i = 0; i < 32; i++)
            for (int j = 0; j < width; j += 16) {
                v16 x = i < many ? Tiles::load(gradient.data + (long)(from + i) * width + j) : v16{};
                Tiles::store(g + i * width + j, x);
                Tiles::split(x, hi + i * width + j, lo + i * width + j);
                Tiles::store(of_contract_bias + j, Tiles::load(of_contract_bias + j) + x);
            }
        for (int i = 0; i < 32 * hidden; i += 16) Tiles::store(s + i, v16{});
        Tiles::product(hi, lo, width, (const __bf16*)contract.data, 0, width / 32, width / 32, hidden, s, hidden);
        for (int i = 0; i < 32; i++)
            for (int j = 0; j < hidden; j += 16) {
                v16 x = i < many ? Tiles::load(inner.data + (long)(from + i) * hidden + j) : v16{};
                v16 d = Tiles::load(s + i * hidden + j) * Turned::slope(x);
                Tiles::store(a + i * hidden + j, Tiles::gelu(x));
                Tiles::store(s + i * hidden + j, d);
                Tiles::store(of_expand_bias + j, Tiles::load(of_expand_bias + j) + d);
            }
        Turned::columns(g, width, hi, lo);
        Turned::pairs(a, hidden, right);
        for (int m = 0; m < width; m += 32)
            Tiles::product(hi + 32 * m, lo + 32 * m, 32, right, 0, 1, 1, hidden, of_contract + (long)m * hidden,
                           hidden);
        Turned::heard(own.data, side.data, from, many, width, hears, o);
        Turned::columns(s, hidden, hi, lo);
        Turned::pairs(o, wide, right);
        for (int m = 0; m < hidden; m += 32)
            Tiles::product(hi + 32 * m, lo + 32 * m, 32, right, 0, 1, 1, wide, of_expand + (long)m * wide, wide);
        for (int i = 0; i < 32 * hidden; i += 16) Tiles::split(Tiles::load(s + i), hi + i, lo + i);
        for (int i = 0; i < 32 * wide; i += 16) Tiles::store(o + i, v16{});
        Tiles::product(hi, lo, hidden, (const __bf16*)expand.data, 0, hidden / 32, hidden / 32, wide, o, wide);
        __builtin_memcpy(heard.data + (long)from * wide, o, 4l * many * wide);
    }
    Tiles::end();
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
    expand: wp.array[wp.int16],
    contract: wp.array[wp.int16],
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
                d += Tiles::load(heard.data + owner.data[e] * wide + width + j);
            d = Tiles::fma(d, Tiles::all(1.0f / 3.0f), Tiles::load(heard.data + (long)i * wide + j));
            Tiles::store(x + j, d);
            sum += d;
            along = Tiles::fma(d, Tiles::load(n + j), along);
        }
        const v16 mean = Tiles::all(Tiles::total(sum) / (float)width);
        const v16 part = Tiles::all(Tiles::total(along) / (float)width);
        const v16 over = Tiles::all(scale.data[i]);
        for (int j = 0; j < width; j += 16) {
            v16 d = Tiles::load(x + j) - mean - Tiles::load(n + j) * part;
            Tiles::store(x + j, Tiles::fma(d, over, Tiles::load(g + j)));
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
