"""The contacts of a garment with a body: closest points and outward directions in float64. Symbols: collision.py."""

from __future__ import annotations

import torch
import warp as wp

from . import cg
from ._operator import allocate
from ._torch import torch_stream
from .body_meshes import BodyMeshes

AT_SURFACE = wp.constant(wp.float64(1e-7))
"""Below this distance [m] the direction from the closest point is noise, and the face's normal is taken."""


@wp.func
def closest_on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """The point of a triangle closest to p: the foot of the perpendicular if inside, or else on the nearest edge."""
    n = wp.cross(b - a, c - a)
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    outside = wp.int32(0)
    best = a
    for k in range(3):
        start = wp.where(k == 0, a, wp.where(k == 1, b, c))
        edge = wp.where(k == 0, b, wp.where(k == 1, c, a)) - start
        if wp.dot(wp.cross(n, edge), p - start) < zero:
            outside += 1
        t = wp.clamp(wp.dot(p - start, edge) / wp.max(wp.dot(edge, edge), wp.float64(1e-300)), zero, one)
        q = start + t * edge
        if wp.length_sq(p - q) < wp.length_sq(p - best):
            best = q
    if outside == 0 and wp.length_sq(n) > zero:
        best = p - n * (wp.dot(n, p - a) / wp.length_sq(n))
    return best


@wp.kernel(enable_backward=False)
def find_contacts(
    # Body:
    body_vertices: wp.array[wp.vec3],
    body_faces: wp.array2d[wp.int32],
    # In:
    vertices: wp.array[wp.vec3],
    distance: wp.array[wp.float32],
    face: wp.array[wp.int32],
    epsilon: wp.float64,
    # Out:
    closest: wp.array[wp.vec3d],
    normal: wp.array[wp.vec3d],
):
    """Closest points and outward directions at the vertices closer than epsilon, zero elsewhere.

    The closest point is computed again in float64: of a direction over 0.1 mm, float32 leaves three digits.
    """
    i = wp.tid()
    n = wp.vec3d()
    u = wp.vec3d()
    if wp.float64(distance[i]) < epsilon:
        p = wp.vec3d(vertices[i])
        j = face[i]
        a = wp.vec3d(body_vertices[body_faces[j, 0]])
        b = wp.vec3d(body_vertices[body_faces[j, 1]])
        c = wp.vec3d(body_vertices[body_faces[j, 2]])
        u = closest_on_triangle(p, a, b, c)
        length = wp.length(p - u)
        if length > AT_SURFACE:
            n = (p - u) / length
            if distance[i] < 0.0:
                n = -n
        else:
            n = wp.normalize(wp.cross(b - a, c - a))
    closest[i] = u
    normal[i] = n


@wp.kernel(enable_backward=False)
def contact_gap(
    # In:
    vertices: wp.array[wp.vec3],
    normal: wp.array[wp.vec3d],
    closest: wp.array[wp.vec3d],
    epsilon: wp.float64,
    # Out:
    gap: wp.array[wp.float64],
):
    """c = ε - n·(Ṽ - U) at the contacts, zero elsewhere."""
    i = wp.tid()
    n = normal[i]
    c = wp.float64(0.0)
    if wp.dot(n, n) > c:
        c = epsilon - wp.dot(n, wp.vec3d(vertices[i]) - closest[i])
    gap[i] = c


def contacts(
    vertices: torch.Tensor, distance: torch.Tensor, face: torch.Tensor, bodies: BodyMeshes, epsilon: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The set C: what a body query found closer than epsilon.

    Args:
        vertices: Positions [m], float32 [V,3].
        distance: Signed distance [m], float32 [V], negative inside.
        face: Nearest body face, int32 [V].
        bodies: The bodies in the frame of `vertices`.
        epsilon: Distance kept from the body [m].

    Returns:
        Closest points [m] and outward directions, float64 [V,3]; zero at vertices that are not in C.
    """
    vertices, body_vertices, body_faces = vertices.detach().contiguous(), bodies.vertices, bodies.faces
    closest, normal = allocate((2, len(vertices), 3), torch.float64, vertices.device)
    with torch_stream(vertices.device) as device:
        wp.launch(
            find_contacts,
            dim=len(vertices),
            inputs=[
                cg.view(body_vertices, wp.vec3),
                cg.view(body_faces, wp.int32),
                cg.view(vertices, wp.vec3),
                cg.view(distance, wp.float32),
                cg.view(face, wp.int32),
                float(epsilon),
                cg.view(closest, wp.vec3d),
                cg.view(normal, wp.vec3d),
            ],
            device=device,
        )
    return closest, normal
