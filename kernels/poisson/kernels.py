"""Kernels of the Poisson solve: right-hand side, placement, and their adjoints. Equations and symbols: solver.py."""

from __future__ import annotations

import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.linear.system import block_sum

wp.set_module_options(compiling.options())
_ADJOINT = compiling.apart(f"{__name__}.adjoint")

FREE = wp.constant(0)  # translation from `mean`
PINNED = wp.constant(1)  # translation from the pins
ISOLATED = wp.constant(2)  # a vertex without faces or pin, which is not moved


@wp.func
def rest_edge(rest_vertices: wp.array[wp.vec3], a: int, b: int) -> wp.vec3d:
    return wp.vec3d(rest_vertices[a]) - wp.vec3d(rest_vertices[b])


@wp.kernel(enable_backward=False)
def right_hand_side(
    from_row: wp.int32,
    # Model:
    faces: wp.array[wp.vec3i],
    half_cotangent: wp.array[wp.vec3d],
    corner_start: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    corner_edge: wp.array[wp.vec3d],
    pin_of_vertex: wp.array[wp.int32],
    pin_stiffness: wp.array[wp.float64],
    # In:
    phi: wp.array[wp.mat33],
    initial: wp.array[wp.vec3d],
    pin_target: wp.array[wp.vec3],
    # Out:
    rhs: wp.array[wp.vec3d],
):
    """The right-hand side g of solver.py, gathered by each vertex from its corners in a fixed order."""
    thread, _ = wp.tid()  # see compiling.py
    a = from_row + thread
    v = initial[a]
    g = wp.vec3d()
    e = corner_start[a]
    last = corner_start[a + 1]
    while e < last:
        i = corners[e] / 3
        k = corners[e] - 3 * i
        j = wp.where(k == 2, 0, k + 1)
        l = wp.where(k == 0, 2, k - 1)
        f = faces[i]
        w = half_cotangent[i]  # indexed by the corner opposite to the edge
        g += wp.mat33d(phi[i]) * corner_edge[e]
        g -= w[l] * (v - initial[f[j]]) + w[j] * (v - initial[f[l]])
        e += 1
    pin = pin_of_vertex[a]
    if pin >= 0:
        g += pin_stiffness[a] * (wp.vec3d(pin_target[pin]) - v)
    rhs[a] = g


@wp.kernel(enable_backward=False)
def place(
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    kind: wp.array[wp.int32],
    centroid_weight: wp.array[wp.float64],
    # In:
    initial: wp.array[wp.vec3d],
    increment: wp.array[wp.vec3d],
    mean: wp.array[wp.vec3],
    # Out:
    vertices: wp.array[wp.vec3],
):
    """Adds the increment and moves a free component to its mean."""
    component, lane = wp.tid()
    stride = wp.block_dim()
    shift = wp.vec3d()
    k = start[component] + lane
    while k < start[component + 1]:
        i = rows[k]
        shift -= centroid_weight[i] * (initial[i] + increment[i])
        k += stride
    shift = wp.vec3d(block_sum(shift[0]), block_sum(shift[1]), block_sum(shift[2]))
    shift += wp.vec3d(mean[component])
    if kind[component] != FREE:
        shift = wp.vec3d()
    k = start[component] + lane
    while k < start[component + 1]:
        i = rows[k]
        vertices[i] = wp.vec3(initial[i] + increment[i] + shift)
        k += stride


@wp.kernel(module=_ADJOINT, enable_backward=False)
def place_adjoint(
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    kind: wp.array[wp.int32],
    centroid_weight: wp.array[wp.float64],
    # In:
    grad_vertices: wp.array[wp.vec3],
    # Out:
    rhs: wp.array[wp.vec3d],
    grad_mean: wp.array[wp.vec3],
):
    """The transpose of `place`: gradients with respect to the increment and the mean."""
    component, lane = wp.tid()
    stride = wp.block_dim()
    total = wp.vec3d()
    k = start[component] + lane
    while k < start[component + 1]:
        total += wp.vec3d(grad_vertices[rows[k]])
        k += stride
    total = wp.vec3d(block_sum(total[0]), block_sum(total[1]), block_sum(total[2]))
    if kind[component] != FREE:
        total = wp.vec3d()
    k = start[component] + lane
    while k < start[component + 1]:
        i = rows[k]
        g = wp.vec3d(grad_vertices[i]) - centroid_weight[i] * total
        if kind[component] == ISOLATED:
            g = wp.vec3d()
        rhs[i] = g
        k += stride
    if lane == 0:
        grad_mean[component] = wp.vec3(total)


@wp.kernel(module=_ADJOINT, enable_backward=False)
def phi_adjoint(
    # Model:
    rest_vertices: wp.array[wp.vec3],
    faces: wp.array2d[wp.int32],
    half_cotangent: wp.array2d[wp.float64],
    # In:
    adjoint: wp.array[wp.vec3d],
    # Out:
    grad_phi: wp.array3d[wp.float32],
):
    """∂/∂Φ_i = Σ_edges w (λ_a - λ_b)(X_a - X_b)ᵀ, where λ is the adjoint solution."""
    i = wp.tid()
    g = wp.mat33d()
    for k in range(3):
        a = faces[i, (k + 1) % 3]
        b = faces[i, (k + 2) % 3]
        g += half_cotangent[i, k] * wp.outer(adjoint[a] - adjoint[b], rest_edge(rest_vertices, a, b))
    for r in range(3):
        for c in range(3):
            grad_phi[i, r, c] = wp.float32(g[r, c])
