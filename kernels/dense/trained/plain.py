"""Matrix products of float32 numbers as they are in memory, in C++ with the vectors of vectors.py.

    Plain::times    c [M,N] += a [M,K] b [K,N]         rows of a, b and c at distances of their own
    Plain::outer    c [M,N] += a [K,M]^T b [K,N]       a sum over the rows of two arrays, as gradients of weights are

N is a multiple of 32, M and K are any numbers. Sums of eight rows and 32 columns stay in registers; 32 columns of b are
first put next to each other. Beside products.py, whose right sides were packed before, this is for right sides that are
used once. The order of the sums does not depend on M or N.
"""

from __future__ import annotations

from warpgarment.kernels.dense.products import VECTORS_GUARD
from warpgarment.kernels.dense.vectors import TEXT

PLAIN = """
struct Plain {
    enum { DEEP = 128 };
#ifdef __AVX512F__
    enum { ALONG = 2, MOST = 8 };
#else
    enum { ALONG = 1, MOST = 4 };
#endif
    // `rows` rows of c, whose sums stay in registers, since it is a number where this is inlined
    __attribute__((always_inline)) static inline void part(const int rows, const float* a, long down, long along,
                                                           const float* b, int deep, float* c, long ldc) {
        v16 sum[MOST][ALONG];
        for (int i = 0; i < rows; i++)
            for (int j = 0; j < ALONG; j++) sum[i][j] = Vector::load(c + i * ldc + 16 * j);
        for (int k = 0; k < deep; k++) {
            v16 y[ALONG];
            for (int j = 0; j < ALONG; j++) y[j] = Vector::load(b + 16 * (ALONG * k + j));
            for (int i = 0; i < rows; i++) {
                const v16 one = Vector::all(a[i * down + k * along]);
                for (int j = 0; j < ALONG; j++) sum[i][j] = Vector::fma(one, y[j], sum[i][j]);
            }
        }
        for (int i = 0; i < rows; i++)
            for (int j = 0; j < ALONG; j++) Vector::store(c + i * ldc + 16 * j, sum[i][j]);
    }
    __attribute__((always_inline)) static inline void product(const float* a, long down, long along, int rows,
                                                              const float* b, long ldb, int deep, int columns, float* c,
                                                              long ldc) {
        alignas(64) float some[DEEP * 16 * ALONG];
        for (int from = 0; from < deep; from += DEEP) {
            const int many = deep - from < DEEP ? deep - from : DEEP;
            const float* x = a + from * along;
            for (int n = 0; n < columns; n += 16 * ALONG) {
                for (int k = 0; k < many; k++)
                    for (int j = 0; j < ALONG; j++)
                        Vector::store(some + 16 * (ALONG * k + j), Vector::load(b + (from + k) * ldb + n + 16 * j));
                int m = 0;
                for (; m + MOST <= rows; m += MOST)
                    part(MOST, x + m * down, down, along, some, many, c + m * ldc + n, ldc);
                for (; m + 2 <= rows; m += 2) part(2, x + m * down, down, along, some, many, c + m * ldc + n, ldc);
                if (m < rows) part(1, x + m * down, down, along, some, many, c + m * ldc + n, ldc);
            }
        }
    }
    __attribute__((noinline)) static void times(const float* a, long lda, int rows, const float* b, long ldb, int deep,
                                                int columns, float* c, long ldc) {
        product(a, lda, 1, rows, b, ldb, deep, columns, c, ldc);
    }
    __attribute__((noinline)) static void outer(const float* a, long lda, int rows, const float* b, long ldb, int deep,
                                                int columns, float* c, long ldc) {
        product(a, 1, lda, rows, b, ldb, deep, columns, c, ldc);
    }
};
"""


def source(body: str) -> str:
    """The text of a native function that uses `Vector` and `Plain`; it does nothing where there are no vectors."""
    return VECTORS_GUARD + TEXT + PLAIN + body + "\n#endif\n"
