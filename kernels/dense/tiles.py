"""Matrix products of float32 numbers on the tiles of a processor with AMX, and what layers need around them.

A float32 number is the sum of two of bfloat16, up to 2^-17 of its size, so a product is the sum of three products of
bfloat16, added up in float32 by the tiles:

    x = hi + lo        x y = hi hi' + hi lo' + lo hi'  (+ lo lo', which is left out: 2^-18 of x y)

A tile has 16 rows of 32 numbers. Kernels work on blocks of `BLOCK` rows, and a row of a product depends on no other
row, so results do not depend on how many rows there are, nor on which thread computes them.

The kernels that use this are functions in C++ (`wp.func_native`), since Warp has no word for tiles of AMX. They do
nothing where the compiler is told of no AMX, as on GPUs; `available` says whether they can be used.

| C++ | what |
| --- | --- |
| `Tiles::split` | sixteen numbers as hi and lo |
| `Tiles::product` | c += a b, for 32 rows of a; b is packed by `pack` |
| `Tiles::norm` | rows with their mean subtracted, over their standard deviation; returns one over that |
| `Tiles::gelu` | x Phi(x) = max(x, 0) - T(|x|), T(a) = a Phi(-a) by 32 polynomials on [0, 6), error 3e-8 |
"""

from __future__ import annotations

import functools
import math
import platform

import numpy as np
import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument

wp.set_module_options(compiling.options())

BLOCK = 32  # rows of a block: two tiles
STEP = 32  # columns of a tile: widths are padded to a multiple of it
WIDEST = 256  # most columns of a layer, for which blocks have room

PIECES, END, DEGREE = 32, 6.0, 4  # of the polynomials for T: `Tiles::gelu`


def _pieces() -> str:
    """The coefficients of T as text: polynomials through its values at five points of each of 32 pieces of [0, 6)."""
    nodes = 0.5 * np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
    at = END / PIECES * (np.arange(PIECES) + 0.5 + nodes[:, None])
    value = [[0.5 * a * math.erfc(a / math.sqrt(2.0)) for a in row] for row in at]
    coefficients = np.linalg.solve(np.vander(nodes, increasing=True), value)
    halves = [["{" + ", ".join(f"{c:.9e}f" for c in part) + "}" for part in row.reshape(2, 16)] for row in coefficients]
    return "".join(f"#define T{k} (v16{low}), piece, (v16{high})\n" for k, (low, high) in enumerate(halves))


GUARD = "#if defined(__AMX_TILE__) && defined(__AMX_BF16__) && defined(__AVX512F__) && defined(__AVX512BF16__)\n"
COEFFICIENTS = _pieces()
TILES = """
typedef float v16 __attribute__((vector_size(64), aligned(4)));
typedef float v8 __attribute__((vector_size(32)));
typedef float v4 __attribute__((vector_size(16)));
typedef int i16 __attribute__((vector_size(64)));
typedef __bf16 h16 __attribute__((vector_size(32), aligned(2)));
struct Tiles {
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
    static inline v16 load(const float* p, int left) {  // zeros beyond the first `left`
        return __builtin_ia32_loadups512_mask(p, v16{}, left >= 16 ? 0xffff : left > 0 ? (1 << left) - 1 : 0);
    }
    static inline v16 load(const float* p) { return *(const v16*)p; }
    static inline void store(float* p, v16 x) { *(v16*)p = x; }
    static inline v16 all(float x) { return v16{} + x; }
    static inline float total(v16 x) {
        v8 a = __builtin_shufflevector(x, x, 0, 1, 2, 3, 4, 5, 6, 7)
             + __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15);
        v4 b = __builtin_shufflevector(a, a, 0, 1, 2, 3) + __builtin_shufflevector(a, a, 4, 5, 6, 7);
        return (b[0] + b[2]) + (b[1] + b[3]);
    }
    static inline void split(v16 x, __bf16* hi, __bf16* lo) {
        h16 h = __builtin_convertvector(x, h16);
        *(h16*)hi = h;
        *(h16*)lo = __builtin_convertvector(x - __builtin_convertvector(h, v16), h16);
    }
    // c [32, ldc] += a [32, 32 steps] b; a as hi and lo with lda numbers a row; b packed with `depth` steps in all, of
    // which the first is `from`
    static void product(const __bf16* hi, const __bf16* lo, int lda, const __bf16* b, int from, int steps, int depth,
                        int columns, float* c, int ldc) {
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
    static inline float norm(const float* x, int width, float* result) {
        v16 sum = all(0.0f), square = all(0.0f);
        for (int j = 0; j < width; j += 16) sum += load(x + j);
        v16 mean = all(total(sum) / (float)width);
        for (int j = 0; j < width; j += 16) {
            v16 d = load(x + j) - mean;
            square = fma(d, d, square);
        }
        v16 scale = all(1.0f / __builtin_sqrtf(total(square) / (float)width + 1.0e-5f));
        for (int j = 0; j < width; j += 16) store(result + j, (load(x + j) - mean) * scale);
        return scale[0];
    }
    static inline v16 fma(v16 a, v16 b, v16 c) { return __builtin_elementwise_fma(a, b, c); }
    static inline v16 exp(v16 x) {  // of numbers <= 0; error 2e-7 of the result
        x = __builtin_elementwise_max(x, all(-87.0f));
        v16 n = fma(x, all(1.44269504f), all(12582912.0f)) - all(12582912.0f);
        v16 r = fma(n, all(2.12194440e-4f), fma(n, all(-0.693359375f), x));
        v16 p = all(1.0f / 720.0f);
        p = fma(p, r, all(1.0f / 120.0f));
        p = fma(p, r, all(1.0f / 24.0f));
        p = fma(p, r, all(1.0f / 6.0f));
        p = fma(p, r, all(0.5f));
        p = fma(p, r, all(1.0f));
        p = fma(p, r, all(1.0f));
        i16 power = (__builtin_convertvector(n, i16) + 127) << 23;
        return p * (v16)power;
    }
    static inline v16 gelu(v16 x) {  // max(x, 0) - T(|x|)
        v16 a = __builtin_elementwise_min(__builtin_elementwise_abs(x), all(5.999f));
        v16 u = fma(a, all(32.0f / 6.0f), all(-0.5f));
        v16 place = u + all(12582912.0f);  // rounds to the number of a piece, in the lowest bits
        v16 t = u - (place - all(12582912.0f));
        i16 piece = (i16)place;
        v16 p = __builtin_ia32_vpermi2varps512(T4);
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T3));
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T2));
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T1));
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T0));
        return __builtin_elementwise_max(x, all(0.0f)) - p;
    }
};
"""


def source(body: str) -> str:
    """The text of a native function that uses `Tiles`; it does nothing where there are none."""
    return GUARD + COEFFICIENTS + TILES + body + "\n#endif\n"


@wp.func_native(GUARD + "return 1;\n#else\nreturn 0;\n#endif\n")
def compiled() -> wp.int32: ...


@wp.kernel(enable_backward=False)
def probe(result: wp.array[wp.int32]):
    result[0] = compiled()


@functools.cache
def present() -> bool:
    """Whether this processor has the tiles, and the system lets this process use them."""
    names = "_is_amx_tile_supported", "_is_avx512_bf16_supported", "_init_amx"
    asked = [getattr(torch.cpu, name, None) for name in names]
    if platform.machine() not in ("x86_64", "AMD64") or not all(asked):
        return False
    return all(ask() for ask in asked if ask is not None)


@functools.cache
def available() -> bool:
    """Whether the tiles are `present`, and Warp's compiler knows them."""
    if not present():
        return False
    found = torch.zeros(1, dtype=torch.int32)
    wp.launch(probe, dim=1, outputs=[as_argument(found, wp.int32)], device="cpu")
    return bool(found.item())


def padded(width: int) -> int:
    """The next multiple of `STEP`."""
    return -(-width // STEP) * STEP


def pack(weight: torch.Tensor) -> torch.Tensor:
    """The matrix of a linear layer as `Tiles::product` reads it.

    Args:
        weight: Weights, float32, shape [O,I].

    Returns:
        Tiles of hi and lo, bfloat16, shape [O'/16, I'/32, 2, 16, 16, 2]: outputs by sixteen, inputs by thirty-two, hi
        or lo, pair of inputs, output, input of the pair; O' and I' are O and I padded with zeros to multiples of 32.
    """
    outputs, inputs = weight.shape
    whole = torch.nn.functional.pad(weight, (0, padded(inputs) - inputs, 0, padded(outputs) - outputs))
    high = whole.to(torch.bfloat16)
    both = torch.stack([high, (whole - high.float()).to(torch.bfloat16)])
    tiles = both.unflatten(1, (-1, 16)).unflatten(3, (-1, 16, 2))  # [2, O/16, 16, I/32, 16, 2]
    return tiles.permute(1, 3, 0, 4, 2, 5).contiguous()


_TYPES = {
    torch.float32: wp.float32,
    torch.int16: wp.int16,
    torch.int32: wp.int32,
    torch.int64: wp.int64,
    torch.uint8: wp.uint8,
}


def argument(values: torch.Tensor) -> object:
    """A tensor as the argument of a launch, in one dimension."""
    return as_argument(values if values.dim() == 1 else values.reshape(-1), _TYPES[values.dtype])
