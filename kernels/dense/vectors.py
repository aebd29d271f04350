"""Vectors of sixteen float32 numbers in C++, for the kernels of this folder, with what layers need between products.

They are the compiler's own vectors, which it makes of the registers that a processor has: one of AVX-512, two of AVX2,
four of NEON. `Vector` has

| C++ | what |
| --- | --- |
| `load`, `store`, `all`, `total`, `fma` | to and from memory, one number sixteen times, their sum, a b + c |
| `norm` | rows with their mean subtracted, over their standard deviation; returns one over that |
| `exp` | of numbers that are not positive, error 2e-7 of the result |
| `gelu` | x Phi(x) = max(x, 0) - T(abs x), with T(a) = a Phi(-a); NaN of NaN |
| `slope` | its derivative, 1 - T'(x) for x > 0 and T'(-x) elsewhere |

With AVX-512, T is one of 32 polynomials on [0, 6), chosen by lane from two registers: errors 3e-8 and, of T', 1e-6.
Elsewhere Phi has the coefficients of Press et al., Numerical Recipes in C (1992), 6.2, with an error of 1.2e-7 of it.
"""

from __future__ import annotations

import math

import numpy as np

PIECES, END, DEGREE = 32, 6.0, 4  # of the polynomials for T


def _pieces() -> str:
    """The coefficients of T as text: polynomials through its values at five points of each of 32 pieces of [0, 6)."""
    nodes = 0.5 * np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
    at = END / PIECES * (np.arange(PIECES) + 0.5 + nodes[:, None])
    value = [[0.5 * a * math.erfc(a / math.sqrt(2.0)) for a in row] for row in at]
    coefficients = np.linalg.solve(np.vander(nodes, increasing=True), value)
    halves = [["{" + ", ".join(f"{c:.9e}f" for c in part) + "}" for part in row.reshape(2, 16)] for row in coefficients]
    return "".join(f"#define T{k} (v16{low}), piece, (v16{high})\n" for k, (low, high) in enumerate(halves))


VECTOR = """
typedef float v16 __attribute__((vector_size(64), aligned(4)));
typedef float v8 __attribute__((vector_size(32)));
typedef float v4 __attribute__((vector_size(16)));
typedef int i16 __attribute__((vector_size(64)));
struct Vector {
    static inline v16 load(const float* p) { return *(const v16*)p; }
    static inline v16 load(const float* p, int left) {  // zeros beyond the first `left`
#ifdef __AVX512F__
        return __builtin_ia32_loadups512_mask(p, v16{}, left >= 16 ? 0xffff : left > 0 ? (1 << left) - 1 : 0);
#else
        if (left >= 16) return load(p);
        float some[16] = {0.0f};
        for (int i = 0; i < left; i++) some[i] = p[i];
        return load(some);
#endif
    }
    static inline void store(float* p, v16 x) { *(v16*)p = x; }
    static inline v16 all(float x) { return x - v16{}; }
    static inline v16 fma(v16 a, v16 b, v16 c) { return __builtin_elementwise_fma(a, b, c); }
    static inline float total(v16 x) {
        v8 a = __builtin_shufflevector(x, x, 0, 1, 2, 3, 4, 5, 6, 7)
             + __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15);
        v4 b = __builtin_shufflevector(a, a, 0, 1, 2, 3) + __builtin_shufflevector(a, a, 4, 5, 6, 7);
        return (b[0] + b[2]) + (b[1] + b[3]);
    }
    __attribute__((noinline)) static float norm(const float* x, int width, float* result) {
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
    static inline v16 exp(v16 x) {
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
#ifdef __AVX512F__
    static inline v16 within(v16 x, i16* piece) {  // the piece of the polynomials, and the place in it
        v16 a = __builtin_elementwise_min(__builtin_elementwise_abs(x), all(5.999f));
        v16 u = fma(a, all(32.0f / 6.0f), all(-0.5f));
        v16 place = u + all(12582912.0f);  // rounds to the number of a piece, in the lowest bits
        *piece = (i16)place;
        return u - (place - all(12582912.0f));
    }
    static inline v16 gelu(v16 x) {
        i16 piece;
        v16 t = within(x, &piece);
        v16 p = __builtin_ia32_vpermi2varps512(T4);
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T3));
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T2));
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T1));
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T0));
        return (x < 0.0f ? v16{} : x) - p;
    }
    static inline v16 slope(v16 x) {
        i16 piece;
        v16 t = within(x, &piece);
        v16 p = all(4.0f) * __builtin_ia32_vpermi2varps512(T4);
        p = fma(p, t, all(3.0f) * __builtin_ia32_vpermi2varps512(T3));
        p = fma(p, t, all(2.0f) * __builtin_ia32_vpermi2varps512(T2));
        p = fma(p, t, __builtin_ia32_vpermi2varps512(T1)) * all(32.0f / 6.0f);
        return x > 0.0f ? all(1.0f) - p : p;
    }
#else
    static inline v16 tail(v16 a) {  // Phi(-a)
        v16 z = a * all(0.707106781f), t = all(1.0f) / fma(z, all(0.5f), all(1.0f));
        v16 p = all(0.17087277f);
        p = fma(p, t, all(-0.82215223f));
        p = fma(p, t, all(1.48851587f));
        p = fma(p, t, all(-1.13520398f));
        p = fma(p, t, all(0.27886807f));
        p = fma(p, t, all(-0.18628806f));
        p = fma(p, t, all(0.09678418f));
        p = fma(p, t, all(0.37409196f));
        p = fma(p, t, all(1.00002368f));
        p = fma(p, t, all(-1.26551223f));
        return all(0.5f) * t * exp(p - z * z);
    }
    static inline v16 gelu(v16 x) {
        v16 a = __builtin_elementwise_abs(x);
        return (x < 0.0f ? v16{} : x) - a * tail(a);
    }
    static inline v16 slope(v16 x) {
        v16 a = __builtin_elementwise_abs(x);
        v16 p = tail(a) - all(0.398942280f) * a * exp(all(-0.5f) * a * a);
        return x > 0.0f ? all(1.0f) - p : p;
    }
#endif
};
"""

TEXT = _pieces() + VECTOR
"""The text that products.py puts before a function."""
