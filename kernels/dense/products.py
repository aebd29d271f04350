"""Matrix products of float32 numbers for blocks of 32 rows, as the kernels of this folder call them in C++.

    c [32,N] += a [32,K] b [K,N]        K and N multiples of 32

The right side b is packed in tiles of 32 rows and 16 columns, four bytes a number. The left side a is what `LEFT` makes
room for. A row of a product depends on no other row, so results do not depend on how many rows there are, nor on which
thread computes them. There are several kinds, of which a process uses one:

**Vectors.** Tiles hold float32 numbers, row by row. Eight rows of a and two tiles of b make sixteen sums, which stay in
registers; with AVX2 and NEON, six or four rows and one tile. `Vector` is that of vectors.py.

**Tiles of AMX.** Products are sums of three of bfloat16, on the tiles of the processor (tiles.py).

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
they can be used. Functions that loop over a row or a product are not inlined: they would be compiled at each call, and
a call takes no time beside the loop.
"""

from __future__ import annotations

import functools
import os
import platform

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, flat_argument

from . import integers, tiles
from .vectors import TEXT

wp.set_module_options(compiling.options())

BLOCK = 32  # rows of a block: two tiles of AMX
STEP = 32  # rows of a tile: widths are padded to a multiple of it
WIDEST = 256  # most columns of a layer, for which blocks have room
COLUMNS = 16  # of a tile

VECTORS_GUARD = """
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
    __attribute__((noinline)) static void product(Left a, int lda, const float* right, int from, int steps,
                                                  int depth, int columns, float* c, int ldc, int down = 32) {
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


ON_TILES = tiles.present() and os.environ.get("WARPGARMENT_TILES") != "0"
"""Whether this process multiplies on tiles of AMX; the environment can say no, with WARPGARMENT_TILES=0."""
_asked = [getattr(torch.cpu, name, bool) for name in ("_is_vnni_supported", "_is_avx512_supported")]
INTEGERS = not ON_TILES and all(ask() for ask in _asked)
"""Whether inner layers are products of integers in this process."""
_GUARD = tiles.GUARD if ON_TILES else integers.GUARD if INTEGERS else VECTORS_GUARD


def source(body: str) -> str:
    """The text of a native function that uses `Vector`, `Matrix` and `Inner`; it does nothing where there are none."""
    inner = integers.TEXT if INTEGERS else _INNER
    return _GUARD + TEXT + (tiles.TEXT if ON_TILES else _VECTORS) + inner + body + "\n#endif\n"


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
    return tiles.pack(whole)


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
