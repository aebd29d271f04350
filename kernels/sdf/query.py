"""Signed distance from points to a body, differentiable.

Manifold-aware transformers, section 4.2 (d_i in s_i) and supplement equation 2; sign by generalised winding numbers
(Jacobson et al. 2013, Barill et al. 2018), since limbs of posed bodies overlap and normals or ray parity are wrong in
there.

    c = argmin_{x on the body} |p − x| = Σ_k b_k u_k,    d = σ |p − c|,    σ = −1 where the winding number exceeds 1/2

    | paper  | code                      | what                                              |
    | ------ | ------------------------- | ------------------------------------------------- |
    | U, T^b | body_vertices, body_faces | the body                                          |
    | d      | distance                  | signed distance [m], negative inside              |
    | c      | closest                   | nearest surface point [m]                         |
    | b      | barycentric               | coordinates of c on the nearest face (corners u_k) |

Gradients hold face and barycentric coordinates fixed: ∂d/∂p = n with n = σ (p − c)/|p − c|,
∂d/∂u_k = −b_k n, ∂c/∂u_k = b_k, ∂c/∂p = 0. For d this is exact, since c is a minimiser. On the surface itself, n is the
normal of the face.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import expect, torch_stream
from warpgarment.kernels.operator import allocate, launch
from warpgarment.kernels.registered import operator

from .bodies import BodyMeshes
from .closest import query_bodies
from .nearest_face import nearest_on_triangle

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def signed_distance_gradient_kernel(
    # In:
    points: wp.array[wp.vec3],
    body_vertices: wp.array[wp.vec3],
    body_faces: wp.array[wp.vec3i],
    distance: wp.array[wp.float32],
    face: wp.array[wp.int32],
    grad_distance: wp.array[wp.float32],
    grad_closest: wp.array[wp.vec3],
    # Out:
    grad_points: wp.array[wp.vec3],
    grad_vertices: wp.array[wp.vec3],  # accumulated
):
    i = wp.tid()
    grad_points[i] = wp.vec3(0.0)
    if face[i] < 0:
        return
    corner = body_faces[face[i]]
    a = wp.vec3d(body_vertices[corner[0]])
    b = wp.vec3d(body_vertices[corner[1]])
    c = wp.vec3d(body_vertices[corner[2]])
    weights = nearest_on_triangle(wp.vec3d(points[i]), a, b, c)  # in float64: close to the face, less turns `away`
    away = wp.vec3d(points[i]) - (a * weights[0] + b * weights[1] + c * weights[2])
    length = wp.length(away)
    size = wp.max(wp.length(b - a), wp.length(c - a))
    if length > wp.float64(1.0e-6) * size:
        outward = away * wp.float64(wp.sign(distance[i])) / length
    else:  # rounding decides where `away` points
        outward = wp.normalize(wp.cross(b - a, c - a))
    pull = outward * wp.float64(grad_distance[i])
    grad_points[i] = wp.vec3(pull)
    push = wp.vec3d(grad_closest[i]) - pull
    for k in range(3):
        wp.atomic_add(grad_vertices, corner[k], wp.vec3(push * weights[k]))


@operator("warpgarment::signed_distance")
def _signed_distance(
    points: torch.Tensor, body_vertices: torch.Tensor, body_faces: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    bodies = BodyMeshes(body_vertices, body_faces)
    body = bodies.body_of("body", None, len(points))
    result = query_bodies(bodies.argument, points, body, torch.full((1,), float("inf"), device=points.device))
    with torch_stream(points.device):
        del bodies  # freed in stream order, after the launch
    return result


@_signed_distance.register_fake
def _(points: torch.Tensor, body_vertices: torch.Tensor, body_faces: torch.Tensor) -> tuple[torch.Tensor, ...]:
    n = points.shape[0]
    return (
        points.new_empty(n),
        points.new_empty((n, 3)),
        points.new_empty(n, dtype=torch.int32),
        points.new_empty((n, 3)),
    )


@operator("warpgarment::signed_distance_backward")
def _signed_distance_backward(
    points: torch.Tensor,
    body_vertices: torch.Tensor,
    body_faces: torch.Tensor,
    distance: torch.Tensor,
    face: torch.Tensor,
    grad_distance: torch.Tensor,
    grad_closest: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    grad_points = allocate(points.shape, points.dtype, points.device)
    grad_vertices = torch.zeros(body_vertices.shape, dtype=torch.float32, device=points.device)
    launch(
        signed_distance_gradient_kernel,
        points.shape[0],
        [
            (points, wp.vec3),
            (body_vertices, wp.vec3),
            (body_faces, wp.vec3i),
            (distance, wp.float32),
            (face, wp.int32),
            (grad_distance, wp.float32),
            (grad_closest, wp.vec3),
        ],
        [(grad_points, wp.vec3), (grad_vertices, wp.vec3)],
        points.device,
    )
    return grad_points, grad_vertices


@_signed_distance_backward.register_fake
def _(points: torch.Tensor, body_vertices: torch.Tensor, *rest: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return points.new_empty(points.shape), body_vertices.new_empty(body_vertices.shape)


def _save(ctx: Any, inputs: tuple[torch.Tensor, ...], output: tuple[torch.Tensor, ...]) -> None:
    distance, _, face, barycentric = output
    ctx.save_for_backward(*inputs, distance, face)
    ctx.mark_non_differentiable(face, barycentric)


def _pull_back(ctx: Any, grad_distance: torch.Tensor, grad_closest: torch.Tensor, *rest: Any) -> tuple[Any, ...]:
    grad_points, grad_vertices = _signed_distance_backward(*ctx.saved_tensors, grad_distance, grad_closest)
    needs = ctx.needs_input_grad
    return grad_points if needs[0] else None, grad_vertices if needs[1] else None, None


_signed_distance.register_autograd(_pull_back, setup_context=_save)


def signed_distance(
    points: torch.Tensor, body_vertices: torch.Tensor, body_faces: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Signed distances and closest points of one body.

    The body's hierarchy is built anew in each call; for many queries of one body, keep a `BodyMeshes`.

    Args:
        points: Positions [m], float32 [N, 3].
        body_vertices: Vertex positions of the body [m], float32 [U, 3].
        body_faces: Vertex indices of the body's faces, int32 [G, 3], counter-clockwise seen from outside.

    Returns:
        Signed distance [m], float32 [N], negative inside; nearest surface points [m], float32 [N, 3]; nearest faces,
        int32 [N]. They are NaN, NaN and -1 for a point that is not finite. The first two are differentiable in points
        and body_vertices.

    Raises:
        TypeError: Wrong dtypes.
        ValueError: Wrong shapes, no faces, faces that name missing vertices, vertices that are not finite.
    """
    expect("points", points, (None, 3))
    expect("body_vertices", body_vertices, (None, 3), device=points.device)
    expect("body_faces", body_faces, (None, 3), torch.int32, points.device)
    return _signed_distance(points, body_vertices, body_faces)[:3]
