"""Matrix products of float32 numbers for blocks of 32 rows, as the kernels of this folder call them in C++.

    c [32,N] += a [32,K] b [K,N]        K and N multiples of 32

The right side b is packed in tiles of 32 rows and 16 columns, four bytes a number. The left side a is what `LEFT` makes
room for. A row of a product depends on no other row, so results do not depend on how many rows there are, nor on which
thread computes them. There are several kinds, of which a process uses one:

**Vectors.** Tiles hold float32 numbers, row by row. Eight rows of a and two tiles of b make sixteen sums, which stay in
registers; with AVX2 and NEON, six or four rows and one tile. `Vector` is that of vectors.py.

**Tiles of AMX.** A float32 number is the sum of two of bfloat16, up to 2^-17 of its size, so a product is the sum of
three products of bfloat16, added up in float32 by the tiles of the processor:

    x = hi + lo        x y = hi hi' + hi lo' + lo hi'  (+ lo lo', which is left out: 2^-18 of x y)

**Integers.** The layers between those whose inputs or outputs are physical quantities can do with less: `Inner` is
`Matrix` again, but on processors with VNNI its products are of 16-bit integers (integers.py).

| C++ | what |
| --- | --- |
| `LEFT(a, n)`, `a.put(i, x)`, `a.after(i)` | room for n numbers of left sides; puts sixteen; the part from i on |
| `Matrix::product` | c += a b |
| `Matrix::rows` | puts rows k and k + 1 of a tile, k even |
| `Matrix::column` | puts column n of a tile |
| `Matrix::begin`, `end` | stand around products |
| `INNER(a, n)`, `a.row(i, x, width)`, `Inner::product` | the same for products of inner layers; puts row i |
| `Inner::size` | numbers in memory of b [rows, columns], packed |

The kernels that use this are functions in C++ (`wp.func_native`), since Warp's vectors are no registers, and it has no
word for tiles of AMX. They do nothing where the compiler is told of no vectors, as on GPUs; `available` says whether
they can be used.
"""

from __future__ import annotations

import functools
import os
import platform

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, flat_argument

from . import integers
from .vectors import TEXT

wp.set_module_options(compiling.options())

BLOCK = 32  # rows of a block: two tiles of AMX
STEP = 32  # rows of a tile: widths are padded to a multiple of it
WIDEST = 256  # most columns of a layer, for which blocks have room
COLUMNS = 16  # of a tile

_TILES_GUARD = """
#if defined(__AMX_TILE__) && defined(__AMX_BF16__) && defined(__AVX512F__) && defined(__AVX512BF16__)
"""
_TILES = """
typedef __bf16 h16 __attribute__((vector_size(32), aligned(2)));
typedef __bf16 h32 __attribute__((vector_size(64), aligned(2)));
#define LEFT(a, n) alignas(64) __bf16 a##_hi[n], a##_lo[n]; const Matrix::Left a = {a##_hi, a##_lo}
struct Matrix {
    static inline void split(v16 x, __bf16* hi, __bf16* lo) {
        h16 h = __builtin_convertvector(x, h16);
        *(h16*)hi = h;
        *(h16*)lo = __builtin_convertvector(x - __builtin_convertvector(h, v16), h16);
    }
    struct Left {
        __bf16 *hi, *lo;
        inline void put(long i, v16 x) const { split(x, hi + i, lo + i); }
        inline Left after(long i) const { return {hi + i, lo + i}; }
    };
    static inline void rows(float* tile, int k, v16 x, v16 y) {  // two rows are a row of pairs
        alignas(64) __bf16 both[2][2][16];
        split(x, both[0][0], both[1][0]);
        split(y, both[0][1], both[1][1]);
        for (int part = 0; part < 2; part++)
            *(h32*)((__bf16*)tile + 512 * part + 16 * k) = __builtin_shufflevector(
                *(h16*)both[part][0], *(h16*)both[part][1], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23, 8,
                24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
    }
    static inline void column(float* tile, int n, v16 x, v16 y) {  // 32 numbers are a column of pairs
        alignas(64) __bf16 both[2][32];
        split(x, both[0], both[1]);
        split(y, both[0] + 16, both[1] + 16);
        for (int part = 0; part < 2; part++)
            for (int pair = 0; pair < 16; pair++)
                ((int*)tile)[256 * part + 16 * pair + n] = ((int*)both[part])[pair];
    }
    static void begin() {
        alignas(64) unsigned char c[64] = {0};
        c[0] = 1;
        for (int t = 0; t < 8; t++) {
            c[16 + 2 * t] = 64;
            c[48 + t] = 16;
        }
        __builtin_ia32_tile_loadconfig(c);
    }
    static void end() { __builtin_ia32_tilerelease(); }
    // a has lda numbers a row; b is packed with `depth` steps in all, of which the first is `from`; rows of c beyond
    // `down` need not be computed
    static void product(Left a, int lda, const float* right, int from, int steps, int depth, int columns, float* c,
                        int ldc, int = 32) {
        const __bf16 *hi = a.hi, *lo = a.lo, *b = (const __bf16*)right;
        long down = 16 * (long)lda, a_row = 2 * (long)lda, c_row = 4 * (long)ldc;
        for (int n = 0; n < columns; n += 32) {
            const __bf16* b0 = b + ((long)(n / 16) * depth + from) * 1024;
            const __bf16* b1 = b0 + (long)depth * 1024;
            float* c0 = c + n;
            float* c1 = c0 + 16 * (long)ldc;
            __builtin_ia32_tileloadd64(0, c0, c_row);
            __builtin_ia32_tileloadd64(1, c0 + 16, c_row);
            __builtin_ia32_tileloadd64(2, c1, c_row);
            __builtin_ia32_tileloadd64(3, c1 + 16, c_row);
            for (int k = 0; k < steps; k++, b0 += 1024, b1 += 1024) {
                __builtin_ia32_tileloadd64(4, hi + 32 * k, a_row);
                __builtin_ia32_tileloadd64(6, b0, 64);
                __builtin_ia32_tdpbf16ps(0, 4, 6);
                __builtin_ia32_tileloadd64(7, b1, 64);
                __builtin_ia32_tdpbf16ps(1, 4, 7);
                __builtin_ia32_tileloadd64(5, hi + down + 32 * k, a_row);
                __builtin_ia32_tdpbf16ps(2, 5, 6);
                __builtin_ia32_tdpbf16ps(3, 5, 7);
                __builtin_ia32_tileloadd64(6, b0 + 512, 64);
                __builtin_ia32_tdpbf16ps(0, 4, 6);
                __builtin_ia32_tdpbf16ps(2, 5, 6);
                __builtin_ia32_tileloadd64(7, b1 + 512, 64);
                __builtin_ia32_tdpbf16ps(1, 4, 7);
                __builtin_ia32_tdpbf16ps(3, 5, 7);
                __builtin_ia32_tileloadd64(4, lo + 32 * k, a_row);
                __builtin_ia32_tileloadd64(6, b0, 64);
                __builtin_ia32_tdpbf16ps(0, 4, 6);
                __builtin_ia32_tileloadd64(7, b1, 64);
                __builtin_ia32_tdpbf16ps(1, 4, 7);
                __builtin_ia32_tileloadd64(5, lo + down + 32 * k, a_row);
                __builtin_ia32_tdpbf16ps(2, 5, 6);
                __builtin_ia32_tdpbf16ps(3, 5, 7);
            }
            __builtin_ia32_tilestored64(0, c0, c_row);
            __builtin_ia32_tilestored64(1, c0 + 16, c_row);
            __builtin_ia32_tilestored64(2, c1, c_row);
            __builtin_ia32_tilestored64(3, c1 + 16, c_row);
        }
    }
};
"""

_VECTORS_GUARD = """
#if defined(__AVX512F__) || (defined(__AVX2__) && defined(__FMA__)) || (defined(__aarch64__) && defined(__ARM_NEON))
"""
_VECTORS = """
#define LEFT(a, n) alignas(64) float a##_all[n]; const Matrix::Left a = {a##_all}
struct Matrix {
    struct Left {
        float* all;
        inline void put(long i, v16 x) const { Vector::store(all + i, x); }
        inline Left after(long i) const { return {all + i}; }
    };
    static inline void rows(float* tile, int k, v16 x, v16 y) {
        Vector::store(tile + 16 * k, x);
        Vector::store(tile + 16 * k + 16, y);
    }
    static inline void column(float* tile, int n, v16 x, v16 y) {
        for (int k = 0; k < 16; k++) {
            tile[16 * k + n] = x[k];
            tile[16 * k + 256 + n] = y[k];
        }
    }
    static void begin() {}
    static void end() {}
#ifdef __AVX512F__
    enum { ALONG = 2 };
#else
    enum { ALONG = 1 };
#endif
    // c [down, 16 ALONG] += x [down, deep] b; sums stay in registers, since `down` is a number where this is inlined
    __attribute__((always_inline)) static inline void part(const int down, const float* x, int lda, const float* b,
                                                           long next, int deep, float* c, int ldc) {
        v16 sum[8][ALONG];
        for (int i = 0; i < down; i++)
            for (int j = 0; j < ALONG; j++) sum[i][j] = Vector::load(c + (long)i * ldc + 16 * j);
        for (int k = 0; k < deep; k++) {
            v16 y[ALONG];
            for (int j = 0; j < ALONG; j++) y[j] = Vector::load(b + j * next + 16 * k);
            for (int i = 0; i < down; i++) {
                const v16 one = Vector::all(x[(long)i * lda + k]);
                for (int j = 0; j < ALONG; j++) sum[i][j] = Vector::fma(one, y[j], sum[i][j]);
            }
        }
        for (int i = 0; i < down; i++)
            for (int j = 0; j < ALONG; j++) Vector::store(c + (long)i * ldc + 16 * j, sum[i][j]);
    }
    // a has lda numbers a row; b is packed with `depth` steps in all, of which the first is `from`; rows of c beyond
    // `down` need not be computed
    static void product(Left a, int lda, const float* right, int from, int steps, int depth, int columns, float* c,
                        int ldc, int down = 32) {
        const long next = 512l * depth;
        for (int n = 0; n < columns; n += 16 * ALONG) {
            const float* b = right + (n / 16) * next + 512l * from;
            const int deep = 32 * steps;
#ifdef __AVX512F__
            for (int m = 0; m < down; m += 8)
                part(8, a.all + (long)m * lda, lda, b, next, deep, c + (long)m * ldc + n, ldc);
#else
            for (int m = 0; m < 24 && m < down; m += 6)
                part(6, a.all + (long)m * lda, lda, b, next, deep, c + (long)m * ldc + n, ldc);
            for (int m = 24; m < down; m += 4)
                part(4, a.all + (long)m * lda, lda, b, next, deep, c + (long)m * ldc + n, ldc);
#endif
        }
    }
};
"""

_INNER = """
#define INNER(a, n) LEFT(a##_plain, n); const Inner::Left a = {a##_plain}
struct Inner {
    struct Left {
        Matrix::Left plain;
        inline void row(int i, const float* x, int width) const {
            for (int j = 0; j < width; j += 16) plain.put((long)i * width + j, Vector::load(x + j));
        }
    };
    static inline long size(int columns, int rows) { return (long)columns * rows; }
    static inline void product(Left a, int lda, const float* right, int depth, int columns, float* c, int ldc,
                               int down = 32) {
        Matrix::product(a.plain, lda, right, 0, depth, depth, columns, c, ldc, down);
    }
};
"""


@functools.cache
def tiles_present() -> bool:
    """Whether this processor has the tiles of AMX, and the system lets this process use them."""
    names = "_is_amx_tile_supported", "_is_avx512_bf16_supported", "_init_amx"
    asked = [getattr(torch.cpu, name, None) for name in names]
    if platform.machine() not in ("x86_64", "AMD64") or not all(asked):
        return False
    return all(ask() for ask in asked if ask is not None)


ON_TILES = tiles_present() and os.environ.get("WARPGARMENT_TILES") != "0"
"""Whether this process multiplies on tiles of AMX; the environment can say no, with WARPGARMENT_TILES=0."""
INTEGERS = not ON_TILES and bool(getattr(torch.cpu, "_is_vnni_supported", bool)())
"""Whether inner layers are products of integers in this process."""
_GUARD = _TILES_GUARD if ON_TILES else integers.GUARD if INTEGERS else _VECTORS_GUARD


def source(body: str) -> str:
    """The text of a native function that uses `Vector`, `Matrix` and `Inner`; it does nothing where there are none."""
    inner = integers.TEXT if INTEGERS else _INNER
    return _GUARD + TEXT + (_TILES if ON_TILES else _VECTORS) + inner + body + "\n#endif\n"


@functools.cache
def present() -> bool:
    """Whether this processor should have vectors that are wide enough, without compiling anything."""
    avx2 = getattr(torch.cpu, "_is_avx2_supported", None)
    return ON_TILES or platform.machine() in ("arm64", "aarch64") or bool(avx2 and avx2())


@wp.func_native(_GUARD + "return 1;\n#else\nreturn 0;\n#endif\n")
def compiled() -> wp.int32: ...


@wp.kernel(enable_backward=False)
def probe(result: wp.array[wp.int32]):
    result[0] = compiled()


@functools.cache
def available() -> bool:
    """Whether they are `present`, and Warp's compiler knows them."""
    if not present():
        return False
    found = torch.zeros(1, dtype=torch.int32)
    wp.launch(probe, dim=1, outputs=[as_argument(found, wp.int32)], device="cpu")
    return bool(found.item())


def padded(width: int) -> int:
    """The next multiple of `STEP`."""
    return -(-width // STEP) * STEP


def pack(weight: torch.Tensor) -> torch.Tensor:
    """The matrix of a linear layer as `Matrix::product` reads it.

    Args:
        weight: Weights, float32, shape [O,I].

    Returns:
        Tiles, float32, shape [O'/16, I'/32, 512], with O' and I' the widths of `padded`, and zeros beyond the weights.
        With vectors a tile is [input, output]. With tiles of AMX it is the memory of bfloat16 numbers [2, 16, 16, 2]:
        hi or lo, pair of inputs, output, input of the pair.
    """
    outputs, inputs = weight.shape
    whole = torch.nn.functional.pad(weight, (0, padded(inputs) - inputs, 0, padded(outputs) - outputs))
    if not ON_TILES:
        return whole.unflatten(0, (-1, COLUMNS)).unflatten(2, (-1, STEP)).permute(0, 2, 3, 1).flatten(2)
    high = whole.to(torch.bfloat16)
    both = torch.stack([high, (whole - high.float()).to(torch.bfloat16)])
    tiles = both.unflatten(1, (-1, 16)).unflatten(3, (-1, 16, 2))  # [2, O/16, 16, I/32, 16, 2]
    return tiles.permute(1, 3, 0, 4, 2, 5).flatten(2).view(torch.float32)


def pack_inner(weight: torch.Tensor) -> torch.Tensor:
    """The matrix of a linear layer as `Inner::product` reads it.

    Args:
        weight: Weights, float32, shape [O,I]; both are multiples of 32.

    Returns:
        Tiles, float32, in one dimension: those of `pack`, or the memory of int16 [O/16, I/32, 16, 16, 2] (pair of
        inputs, output, input of the pair) and then the units of the outputs, float32 [O].
    """
    if not INTEGERS:
        return pack(weight).flatten()
    return integers.pack(weight)


_TYPES = {torch.float32: wp.float32, torch.int32: wp.int32, torch.int64: wp.int64, torch.uint8: wp.uint8}


def argument(values: torch.Tensor) -> object:
    """A tensor as the argument of a launch, in one dimension."""
    return flat_argument(values, _TYPES[values.dtype])
