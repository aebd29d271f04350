"""What a thread of faces.py does with its block of 32 faces, as functions in C++ on the products of products.py.

Row `row` begins at face `at` of all, and has `many` faces in the block. Layouts and weights of the first layer may have
one row that serves all: `row % layouts`, `row % packs`.
"""

from __future__ import annotations

import warp as wp

from .products import source

PLACE = """
    const int blocks = (count + 31) / 32, row = t / blocks, from = 32 * (t % blocks);
    const int many = count - from < 32 ? count - from : 32;
    const long at = (long)row * count + from;
"""


@wp.func_native(
    source(
        PLACE
        + """
    alignas(64) float c[32 * 256], line[256 + 1024];
    LEFT(left, 32 * 256);
    const int columns = frames.shape[0] * channels, depth = (columns + 31) / 32;
    const float* middle = centre.data + (long)(row % packs) * 32 * depth;
    const float* w = weight.data + (long)(row % packs) * width * depth * 32;
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16) Vector::store(c + i * width + j, Vector::load(bias.data + j));
    Matrix::begin();
    for (int k = 0; k < depth; k += 8) {
        const int steps = depth - k < 8 ? depth - k : 8, begin = 32 * k, end = begin + 32 * steps;
        for (int i = 0; i < 32; i++) {
            const long face = i < many ? index.data[at + i] : -1;
            for (int h = begin / channels; h < frames.shape[0] && h * channels < end; h++)
                if (face >= 0)
                    __builtin_memcpy(line + h * channels - begin / channels * channels,
                                     (const float*)frames.data[h] + face * pitch, 4l * channels);
            const float* to = line + begin % channels;  // at column `begin`
            for (int j = 0; j < 32 * steps; j += 16)
                left.put(i * 256 + j, face < 0 ? v16{} : Vector::load(to + j, columns - begin - j)
                                                             - Vector::load(middle + begin + j));
        }
        Matrix::product(left, 256, w, k, steps, depth, width, c, width);
    }
    Matrix::end();
    __builtin_memcpy(result.data + at * width, c, 4l * many * width);
"""
    )
)
def embed_block(
    t: int,
    count: int,
    channels: int,
    pitch: int,
    width: int,
    packs: int,
    index: wp.array[wp.int64],
    frames: wp.array[wp.int64],
    centre: wp.array[wp.float32],
    weight: wp.array[wp.float32],
    bias: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...


HEAD = """
    const int wide_head = (outputs + 31) / 32 * 32;
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < wide_head; j++) h[i * wide_head + j] = j < outputs ? head_bias.data[j] : 0.0f;
    Matrix::begin();
    Matrix::product(last, width, head.data, 0, width / 32, width / 32, wide_head, h, wide_head);
    Matrix::end();
    for (int i = 0; i < many; i++)
        for (int j = 0; j < outputs; j++) result.data[(at + i) * outputs + j] = h[i * wide_head + j];
"""

PERCEPTRON = """
    Matrix::begin();
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < hidden; j += 16) Vector::store(h + i * hidden + j, Vector::load(expand_bias.data + j));
    Inner::product(left, wide, expand.data, wide / 32, hidden, h, hidden);
    for (int i = 0; i < 32; i++) {
        float* y = h + i * hidden;
        for (int j = 0; j < hidden; j += 16) Vector::store(y + j, Vector::gelu(Vector::load(y + j)));
        left.row(i, y, hidden);
        for (int j = 0; j < width; j += 16) {
            v16 old = i < many ? Vector::load(x + i * width + j) : v16{};
            Vector::store(c + i * width + j, old + Vector::load(contract_bias.data + j));
        }
    }
    Inner::product(left, hidden, contract.data, hidden / 32, width, c, width);
    Matrix::end();
    if (!outputs) __builtin_memcpy(x, c, 4l * many * width);
"""


@wp.func_native(
    source(
        PLACE
        + """
    alignas(64) float h[32 * 256], c[32 * 256];
    INNER(left, 32 * 256);
    const int wide = width, outputs = 0;
    float* x = faces.data + at * width;
    __builtin_memset(c, 0, 4l * width);
    for (int i = 0; i < 32; i++) {
        if (i < many) Vector::norm(x + i * width, width, c);
        left.row(i, c, width);
    }
"""
        + PERCEPTRON
    )
)
def first_block(
    t: int,
    count: int,
    width: int,
    hidden: int,
    expand: wp.array[wp.float32],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    contract_bias: wp.array[wp.float32],
    faces: wp.array[wp.float32],
): ...


@wp.func_native(
    source(
        PLACE
        + """
    const long to = (long)(row % layouts) * count + from;
    for (int i = 0; i < many; i++) {
        float* x = faces.data + (at + i) * width;
        const wp::int64* p = patch.data + 4 * (to + i);
        const float* s = share.data + 4 * (to + i);
        const float* all = heard.data + (long)row * patches * width;
        const float *a = all + p[0] * width, *b = all + p[1] * width, *c = all + p[2] * width, *d = all + p[3] * width;
        for (int j = 0; j < width; j += 16) {
            v16 sum = Vector::load(x + j);
            sum = Vector::fma(Vector::all(s[0]), Vector::load(a + j), sum);
            sum = Vector::fma(Vector::all(s[1]), Vector::load(b + j), sum);
            sum = Vector::fma(Vector::all(s[2]), Vector::load(c + j), sum);
            sum = Vector::fma(Vector::all(s[3]), Vector::load(d + j), sum);
            Vector::store(x + j, sum);
        }
        Vector::norm(x, width, own.data + (at + i) * width);
    }
"""
    )
)
def spread_block(
    t: int,
    count: int,
    width: int,
    patches: int,
    layouts: int,
    patch: wp.array[wp.int64],
    share: wp.array[wp.float32],
    heard: wp.array[wp.float32],
    faces: wp.array[wp.float32],
    own: wp.array[wp.float32],
): ...


@wp.func_native(
    source(
        PLACE
        + """
    alignas(64) float h[32 * 256], c[32 * 256];
    alignas(64) float line[512] = {0.0f};
    INNER(left, 32 * 512);
    LEFT(last, 32 * 256);
    const long to = (long)(row % layouts) * count + from;
    const int wide = hears ? 2 * width : width;
    float* x = faces.data + at * width;
    const float* all = own.data + (long)row * count * width;
    for (int i = 0; i < 32; i++) {
        for (int j = 0; j < width && i < many; j += 16) {
            Vector::store(line + j, Vector::load(own.data + (at + i) * width + j));
            if (!hears) continue;
            v16 sum = {};
            for (int k = 0; k < 3; k++) sum += Vector::load(all + side.data[3 * (to + i) + k] * width + j);
            Vector::store(line + width + j, sum * Vector::all(1.0f / 3.0f));
        }
        left.row(i, line, wide);
    }
"""
        + PERCEPTRON
        + """
    for (int i = 0; i < many && !outputs; i++) Vector::norm(c + i * width, width, result.data + (at + i) * width);
    for (int i = 0; i < 32 && outputs; i++) Vector::norm(c + i * width, width, c + i * width);
    if (outputs) {
        for (int i = 0; i < 32 * width; i += 16) last.put(i, Vector::load(c + i));
"""
        + HEAD
        + """
    }
"""
    )
)
def hear_block(
    t: int,
    count: int,
    width: int,
    hidden: int,
    layouts: int,
    hears: int,
    outputs: int,
    side: wp.array[wp.int64],
    expand: wp.array[wp.float32],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    contract_bias: wp.array[wp.float32],
    head: wp.array[wp.float32],
    head_bias: wp.array[wp.float32],
    own: wp.array[wp.float32],
    faces: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...


@wp.func_native(
    source(
        PLACE
        + """
    alignas(64) float h[32 * 256];
    LEFT(last, 32 * 256);
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16)
            last.put(i * width + j, i < many ? Vector::load(own.data + (at + i) * width + j) : v16{});
"""
        + HEAD
    )
)
def head_block(
    t: int,
    count: int,
    width: int,
    outputs: int,
    head: wp.array[wp.float32],
    head_bias: wp.array[wp.float32],
    own: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...
