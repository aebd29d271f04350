"""ΨΦ with replaced singular values on a CPU, for eight faces at a time in vector instructions.

The decomposition is that of svd.py, operation by operation, on vectors of eight float64. A rotation of two columns is
the identity in lanes where they are orthogonal already, and sweeps end when it is in all lanes. A lane depends on no
other, so a face gets the same bits wherever it is.

The function is in C++ (`wp.func_native`), since Warp has no vectors that choose by lanes; on GPUs it does nothing.
"""

from __future__ import annotations

import warp as wp

from warpgarment.kernels import compiling

wp.set_module_options(compiling.options())

LANES = 8

LANES_OF_EIGHT = """
#if !defined(__CUDA_ARCH__)
    typedef double v8 __attribute__((vector_size(64)));
    typedef long long m8 __attribute__((vector_size(64)));
    struct Lanes {
        static inline v8 dot(const v8* x, const v8* y) { return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; }
        static inline void cross(const v8* x, const v8* y, v8* z) {
            z[0] = x[1] * y[2] - x[2] * y[1];
            z[1] = x[2] * y[0] - x[0] * y[2];
            z[2] = x[0] * y[1] - x[1] * y[0];
        }
        static inline v8 root(v8 x) { return __builtin_elementwise_sqrt(x); }
        static inline long long any(m8 x) {
            long long found = 0;
            for (int r = 0; r < 8; r++) found |= x[r];
            return found;
        }
        static inline void rotate(v8 c, v8 s, v8* x, v8* y) {
            for (int k = 0; k < 3; k++) {
                const v8 old = x[k];
                x[k] = c * old - s * y[k];
                y[k] = s * old + c * y[k];
            }
        }
        static inline m8 turn(v8* x, v8* y, v8* vx, v8* vy) {
            const v8 one = v8{} + 1.0, xx = dot(x, x), yy = dot(y, y), xy = dot(x, y);
            const m8 apart = xy * xy > 1.0e-26 * xx * yy;
            if (!any(apart)) return apart;
            const v8 zeta = (yy - xx) / (2.0 * xy);
            v8 t = one / (__builtin_elementwise_abs(zeta) + root(one + zeta * zeta));
            t = zeta < 0.0 ? -t : t;
            v8 c = one / root(one + t * t), s = c * t;
            c = apart ? c : one;
            s = apart ? s : v8{};
            rotate(c, s, x, y);
            rotate(c, s, vx, vy);
            return apart;
        }
        static inline void order(v8* x, v8* y, v8* vx, v8* vy) {  // the longer one first
            const m8 swap = dot(y, y) > dot(x, x);
            for (int k = 0; k < 3; k++) {
                const v8 p = x[k], q = vx[k];
                x[k] = swap ? y[k] : p;
                y[k] = swap ? p : y[k];
                vx[k] = swap ? vy[k] : q;
                vy[k] = swap ? q : vy[k];
            }
        }
        // columns u of matrices become U, v becomes V, and s the singular values
        static inline void svd(v8 (*u)[3], v8 (*v)[3], v8* s) {
            const v8 zero = {}, one = zero + 1.0;
            for (int i = 0; i < 3; i++)
                for (int k = 0; k < 3; k++) v[i][k] = i == k ? one : zero;
            for (int sweep = 0; sweep < 16; sweep++) {
                m8 turned = turn(u[0], u[1], v[0], v[1]);
                turned |= turn(u[0], u[2], v[0], v[2]);
                turned |= turn(u[1], u[2], v[1], v[2]);
                if (!any(turned)) break;
            }
            order(u[0], u[1], v[0], v[1]);
            order(u[1], u[2], v[1], v[2]);
            order(u[0], u[1], v[0], v[1]);
            const v8 first = root(dot(u[0], u[0])), second = root(dot(u[1], u[1]));
            for (int k = 0; k < 3; k++) u[0][k] = first != 0.0 ? u[0][k] / first : (k ? zero : one);
            const m8 flat = second <= 1.0e-14 * first;
            v8 across[3] = {};
            if (any(flat)) {  // any direction across
                v8 size[3], axis[3];
                for (int k = 0; k < 3; k++) size[k] = __builtin_elementwise_abs(u[0][k]);
                const m8 x = size[0] < size[1] & size[0] < size[2], y = ~x & (size[1] < size[2]);
                axis[0] = x ? one : zero;
                axis[1] = y ? one : zero;
                axis[2] = x | y ? zero : one;
                cross(u[0], axis, across);
                const v8 length = root(dot(across, across));
                for (int k = 0; k < 3; k++) across[k] /= length;
            }
            for (int k = 0; k < 3; k++) u[1][k] = flat ? across[k] : u[1][k] / second;
            v8 last[3], turned[3];
            cross(u[0], u[1], last);
            cross(v[0], v[1], turned);
            s[0] = first;
            s[1] = second;
            s[2] = dot(last, u[2]) * dot(turned, v[2]);
            for (int k = 0; k < 3; k++) {
                u[2][k] = last[k];
                v[2][k] = turned[k];
            }
        }
    };
"""

REPLACED = (
    LANES_OF_EIGHT
    + """
    const int from = 8 * t, many = count - from < 8 ? count - from : 8;
    v8 f[9] = {}, g[9] = {}, s[3];
    for (int k = 0; k < 9; k += 4) f[k] = g[k] = v8{} + 1.0;
    for (int k = 0; k < 3; k++) s[k] = v8{} + 1.0;
    for (int r = 0; r < many; r++) {
        const float* phi = features.data + (long)(from + r) * pitch;
        const float* step = psi.data + 9l * (from + r);
        for (int k = 0; k < 9; k++) f[k][r] = (double)phi[k];
        if (broken.data[garment_of_face.data[from + r]]) continue;
        for (int k = 0; k < 9; k++) g[k][r] = (double)step[k];
        for (int k = 0; k < 3; k++) {
            const float wanted = singular_values.data[3l * (from + r) + k];
            s[k][r] = (double)(wanted > smallest ? wanted : smallest);
        }
    }
    v8 u[3][3], v[3][3], old[3];  // columns
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < 3; i++) u[k][i] = g[3 * i] * f[k] + g[3 * i + 1] * f[3 + k] + g[3 * i + 2] * f[6 + k];
    Lanes::svd(u, v, old);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const v8 x = u[0][i] * s[0] * v[0][j] + u[1][i] * s[1] * v[1][j] + u[2][i] * s[2] * v[2][j];
            for (int r = 0; r < many; r++) target.data[9l * (from + r) + 3 * i + j] = (float)x[r];
        }
#endif
"""
)


@wp.func_native(REPLACED)
def replace_eight(
    t: int,
    count: int,
    pitch: int,
    smallest: float,
    garment_of_face: wp.array[wp.int32],
    features: wp.array[wp.float32],
    psi: wp.array[wp.float32],
    singular_values: wp.array[wp.float32],
    broken: wp.array[wp.int32],
    target: wp.array[wp.float32],
): ...


@wp.kernel(enable_backward=False)
def replaced_eight_kernel(
    from_row: wp.int32,
    count: wp.int32,
    pitch: wp.int32,
    smallest: wp.float32,
    # Model:
    garment_of_face: wp.array[wp.int32],
    # In:
    features: wp.array[wp.float32],
    psi: wp.array[wp.float32],
    singular_values: wp.array[wp.float32],
    broken: wp.array[wp.int32],
    # Out:
    target: wp.array[wp.float32],
):
    """Eight faces in a thread; the arguments are those of `next_gradients_kernel`, as numbers."""
    t = from_row + wp.tid()
    replace_eight(t, count, pitch, smallest, garment_of_face, features, psi, singular_values, broken, target)
