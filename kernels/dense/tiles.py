"""Matrix products on the tiles of a processor with AMX: `Matrix` of products.py.

A float32 number is the sum of two of bfloat16, up to 2^-17 of its size, so a product is the sum of three products of
bfloat16, added up in float32 by the tiles:

    x = hi + lo        x y = hi hi' + hi lo' + lo hi'  (+ lo lo', which is left out: 2^-18 of x y)
"""

from __future__ import annotations

import functools
import platform

import torch

GUARD = """
#if defined(__AMX_TILE__) && defined(__AMX_BF16__) && defined(__AVX512F__) && defined(__AVX512BF16__)
"""
TEXT = """
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


@functools.cache
def present() -> bool:
    """Whether this processor has the tiles of AMX, and the system lets this process use them."""
    names = "_is_amx_tile_supported", "_is_avx512_bf16_supported", "_init_amx"
    asked = [getattr(torch.cpu, name, None) for name in names]
    if platform.machine() not in ("x86_64", "AMD64") or not all(asked):
        return False
    return all(ask() for ask in asked if ask is not None)


def pack(weight: torch.Tensor) -> torch.Tensor:
    """The matrix of a linear layer as `Matrix::product` reads it.

    Args:
        weight: Weights, float32, shape [O,I]; both are multiples of 32.

    Returns:
        The memory of bfloat16 numbers [O/16, I/32, 2, 16, 16, 2] (hi or lo, pair of inputs, output, input of the pair),
        as float32 [O/16, I/32, 512].
    """
    high = weight.to(torch.bfloat16)
    both = torch.stack([high, (weight - high.float()).to(torch.bfloat16)])
    split = both.unflatten(1, (-1, 16)).unflatten(3, (-1, 16, 2))  # [2, O/16, 16, I/32, 16, 2]
    return split.permute(1, 3, 0, 4, 2, 5).flatten(2).view(torch.float32)
