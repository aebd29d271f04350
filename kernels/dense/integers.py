"""Matrix products of inner layers with integers: `Inner` of products.py on processors with VNNI (AVX-512).

These multiply pairs of 16-bit integers as fast as single float32 numbers. Each row of a and each column of b is divided
by a unit of its own, such that no number is beyond 2^15 and the norm of none beyond `LONGEST`. By the inequality of
Cauchy and Schwarz no sum of products then leaves 32 bits, so sums are exact:

    a_i = u_i A_i,  b_j = v_j B_j,   |A_i| |B_j| < 2^31,   c_ij += u_i v_j (A_i . B_j)

A number of a row of 128 is off by 1e-4 of the row's deviation. A row with a number that is not finite has no unit, and
its products are NaN.
"""

from __future__ import annotations

import torch

LONGEST = 46_300.0
"""Norm of a row or column of integers: with rounding, less than the root of 2^31."""
GUARD = """
#if defined(__AVX512F__) && defined(__AVX512BW__) && defined(__AVX512VNNI__)
"""
TEXT = """
typedef short s16 __attribute__((vector_size(32), aligned(2)));
#define INNER(a, n) alignas(64) short a##_all[n]; float a##_unit[32]; const Inner::Left a = {a##_all, a##_unit}
struct Inner {
    struct Left {
        short* all;
        float* unit;  // of each row
        __attribute__((noinline)) void row(int i, const float* x, int width) const {
            v16 square = {}, most = {};
            for (int j = 0; j < width; j += 16) {
                v16 y = Vector::load(x + j);
                square = Vector::fma(y, y, square);
                most = __builtin_elementwise_max(most, __builtin_elementwise_abs(y));
            }
            const float largest = __builtin_reduce_max(most) / 32767.0f;
            float u = __builtin_sqrtf(Vector::total(square)) / 46300.0f;
            u = largest > u ? largest : u;
            if (!(u < 1.0e30f)) {  // a number that is not finite: so are the products
                unit[i] = __builtin_nanf("");
                __builtin_memset(all + (long)i * width, 0, 2l * width);
                return;
            }
            u = u > 1.0e-30f ? u : 1.0e-30f;
            unit[i] = u;
            const v16 over = Vector::all(1.0f / u), half = Vector::all(12582912.0f);
            for (int j = 0; j < width; j += 16) {
                i16 whole = (i16)(Vector::load(x + j) * over + half) - (i16)half;  // rounds to the nearest
                *(s16*)(all + (long)i * width + j) = __builtin_convertvector(whole, s16);
            }
        }
    };
    // after the tiles of b, [pair of rows, column, row of the pair], are the units of its columns
    static inline long size(int columns, int rows) { return (long)columns * (rows / 2 + 1); }
    __attribute__((noinline)) static void product(Left a, int lda, const float* right, int depth, int columns,
                                                  float* c, int ldc, int down = 32) {
        const float* units = right + (long)columns * depth * 16;
        for (int n = 0; n < columns; n += 32) {
            const int* b = (const int*)right + (long)(n / 16) * depth * 256;
            const int* next = b + (long)depth * 256;
            for (int m = 0; m < down; m += 8) {
                const int* x = (const int*)(a.all + (long)m * lda);
                i16 sum[8][2];
                for (int i = 0; i < 8; i++) sum[i][0] = sum[i][1] = i16{};
                for (int k = 0; k < 16 * depth; k++) {
                    const i16 y = *(const i16*)(b + 16 * k), z = *(const i16*)(next + 16 * k);
                    for (int i = 0; i < 8; i++) {
                        const i16 one = x[(long)i * (lda / 2) + k] - i16{};
                        sum[i][0] = __builtin_ia32_vpdpwssd512(sum[i][0], one, y);
                        sum[i][1] = __builtin_ia32_vpdpwssd512(sum[i][1], one, z);
                    }
                }
                for (int i = 0; i < 8; i++)
                    for (int j = 0; j < 2; j++) {
                        float* to = c + (long)(m + i) * ldc + n + 16 * j;
                        const v16 u = Vector::load(units + n + 16 * j) * Vector::all(a.unit[m + i]);
                        Vector::store(to, Vector::fma(__builtin_convertvector(sum[i][j], v16), u, Vector::load(to)));
                    }
            }
        }
    }
};
"""


def pack(weight: torch.Tensor) -> torch.Tensor:
    """The matrix of a linear layer as `Inner::product` reads it.

    Args:
        weight: Weights, float32, shape [O,I]; both are multiples of 32.

    Returns:
        The memory of int16 [O/16, I/32, 16, 16, 2] (pair of inputs, output, input of the pair) and then the units of
        the outputs [O], as float32 in one dimension.
    """
    unit = torch.maximum(weight.norm(dim=1) / LONGEST, weight.abs().amax(dim=1) / 32767.0).clamp(min=1e-30)
    whole = torch.round(weight / unit[:, None]).to(torch.int16)
    tiles = whole.unflatten(0, (-1, 16)).unflatten(2, (-1, 16, 2)).permute(0, 2, 3, 1, 4)
    return torch.cat([tiles.flatten().view(torch.float32), unit])
