"""What a thread of faces.py does with its block of 32 faces, as functions in C++ on the tiles of tiles.py.

Row `row` begins at face `at` of all, and has `many` faces in the block. Layouts and weights of the first layer may have
one row that serves all: `row % layouts`, `row % packs`.
"""

from __future__ import annotations

import warp as wp

from .tiles import source

PLACE = """
    const int blocks = (count + 31) / 32, row = t / blocks, from = 32 * (t % blocks);
    const int many = count - from < 32 ? count - from : 32;
    const long at = (long)row * count + from;
"""


@wp.func_native(
    source(
        PLACE
        + """
    alignas(64) float c[32 * 256];
    alignas(64) __bf16 hi[32 * 256], lo[32 * 256];
    const int depth = (columns + 31) / 32;
    const float* middle = centre.data + (long)(row % packs) * 32 * depth;
    const __bf16* w = (const __bf16*)weight.data + (long)(row % packs) * width * depth * 64;
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16) Tiles::store(c + i * width + j, Tiles::load(bias.data + j));
    Tiles::begin();
    for (int k = 0; k < depth; k += 8) {
        const int steps = depth - k < 8 ? depth - k : 8;
        for (int i = 0; i < 32; i++)
            for (int j = 0; j < 32 * steps; j += 16) {
                const float* f = features.data + (at + i) * pitch + 32 * k + j;
                const v16 x = Tiles::load(f, i < many ? columns - 32 * k - j : 0);
                Tiles::split(x - Tiles::load(middle + 32 * k + j), hi + i * 256 + j, lo + i * 256 + j);
            }
        Tiles::product(hi, lo, 256, w, k, steps, depth, width, c, width);
    }
    Tiles::end();
    __builtin_memcpy(result.data + at * width, c, 4l * many * width);
"""
    )
)
def embed_block(
    t: int,
    count: int,
    columns: int,
    pitch: int,
    width: int,
    packs: int,
    features: wp.array[wp.float32],
    centre: wp.array[wp.float32],
    weight: wp.array[wp.int16],
    bias: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...


HEAD = """
    const int wide_head = (outputs + 31) / 32 * 32;
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < wide_head; j++) h[i * wide_head + j] = j < outputs ? head_bias.data[j] : 0.0f;
    Tiles::begin();
    Tiles::product(hi, lo, width, (const __bf16*)head.data, 0, width / 32, width / 32, wide_head, h, wide_head);
    Tiles::end();
    for (int i = 0; i < many; i++)
        for (int j = 0; j < outputs; j++) result.data[(at + i) * outputs + j] = h[i * wide_head + j];
"""

PERCEPTRON = """
    Tiles::begin();
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < hidden; j += 16) Tiles::store(h + i * hidden + j, Tiles::load(expand_bias.data + j));
    Tiles::product(hi, lo, wide, (const __bf16*)expand.data, 0, wide / 32, wide / 32, hidden, h, hidden);
    for (int i = 0; i < 32 * hidden; i += 16) Tiles::split(Tiles::gelu(Tiles::load(h + i)), hi + i, lo + i);
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16) {
            v16 old = i < many ? Tiles::load(x + i * width + j) : v16{};
            Tiles::store(c + i * width + j, old + Tiles::load(contract_bias.data + j));
        }
    Tiles::product(hi, lo, hidden, (const __bf16*)contract.data, 0, hidden / 32, hidden / 32, width, c, width);
    Tiles::end();
    if (!outputs) __builtin_memcpy(x, c, 4l * many * width);
"""


@wp.func_native(
    source(
        PLACE
        + """
    alignas(64) float h[32 * 256], c[32 * 256];
    alignas(64) __bf16 hi[32 * 256], lo[32 * 256];
    const int wide = width, outputs = 0;
    float* x = faces.data + at * width;
    for (int i = 0; i < 32; i++) {
        if (i < many) Tiles::norm(x + i * width, width, c);
        for (int j = 0; j < width; j += 16)
            Tiles::split(i < many ? Tiles::load(c + j) : v16{}, hi + i * wide + j, lo + i * wide + j);
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
    expand: wp.array[wp.int16],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.int16],
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
            v16 sum = Tiles::load(x + j);
            sum = Tiles::fma(Tiles::all(s[0]), Tiles::load(a + j), sum);
            sum = Tiles::fma(Tiles::all(s[1]), Tiles::load(b + j), sum);
            sum = Tiles::fma(Tiles::all(s[2]), Tiles::load(c + j), sum);
            sum = Tiles::fma(Tiles::all(s[3]), Tiles::load(d + j), sum);
            Tiles::store(x + j, sum);
        }
        Tiles::norm(x, width, own.data + (at + i) * width);
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
    alignas(64) __bf16 hi[32 * 512], lo[32 * 512];
    const long to = (long)(row % layouts) * count + from;
    const int wide = hears ? 2 * width : width;
    float* x = faces.data + at * width;
    const float* all = own.data + (long)row * count * width;
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16) {
            v16 mine = i < many ? Tiles::load(own.data + (at + i) * width + j) : v16{};
            Tiles::split(mine, hi + i * wide + j, lo + i * wide + j);
            if (!hears) continue;
            v16 sum = {};
            for (int k = 0; k < 3 && i < many; k++) sum += Tiles::load(all + side.data[3 * (to + i) + k] * width + j);
            Tiles::split(sum * Tiles::all(1.0f / 3.0f), hi + i * wide + width + j, lo + i * wide + width + j);
        }
"""
        + PERCEPTRON
        + """
    for (int i = 0; i < many && !outputs; i++) Tiles::norm(c + i * width, width, result.data + (at + i) * width);
    for (int i = 0; i < 32 && outputs; i++) Tiles::norm(c + i * width, width, c + i * width);
    if (outputs) {
        for (int i = 0; i < 32 * width; i += 16) Tiles::split(Tiles::load(c + i), hi + i, lo + i);
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
    expand: wp.array[wp.int16],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.int16],
    contract_bias: wp.array[wp.float32],
    head: wp.array[wp.int16],
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
    alignas(64) __bf16 hi[32 * 256], lo[32 * 256];
    for (int i = 0; i < 32; i++)
        for (int j = 0; j < width; j += 16)
            Tiles::split(i < many ? Tiles::load(own.data + (at + i) * width + j) : v16{},
                         hi + i * width + j, lo + i * width + j);
"""
        + HEAD
    )
)
def head_block(
    t: int,
    count: int,
    width: int,
    outputs: int,
    head: wp.array[wp.int16],
    head_bias: wp.array[wp.float32],
    own: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...
