"""The contacts of a garment with a body: closest points and outward directions in float64. Symbols: solver.py.

For a vertex that is past the middle of a limb, the nearest point of the surface is on the wrong side. If the origin of
a vertex is known, the segment from the origin to the vertex is followed to the first face of the body. If that face
and the nearest surface have opposite directions, the contact is with that face.

Parts of a body may overlap or leave little room between them. A contact whose direction leads into another part is
replaced by one that leads out of both (way_out.py). Where another part is opposite the surface, closer than twice the
distance to keep, half of the room is kept, so that cloth stays between the two.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.first_hit import first_hit
from warpgarment.kernels.sdf.model import Bodies, corners_of, exists
from warpgarment.kernels.sdf.nearest_face import closest_on_triangle

from .contact_set import ContactFrame, Contacts
from .way_out import leads_out, way_out

wp.set_module_options(compiling.options(max_unroll=1))

AT_SURFACE = wp.constant(wp.float64(1e-7))
"""Below this distance [m] the direction from the closest point is noise, and the normal of the face is used."""

BEYOND = wp.constant(wp.float64(1e-4))
"""Distance from the surface [m] at which a way has to be outside."""


@wp.func
def entered(bodies: wp.array[Bodies], b: int, origin: wp.vec3, end: wp.vec3) -> int:
    """Face of a body by which a segment enters it; -1 if its first hit is an exit, or there is none."""
    way = end - origin
    length = wp.length(way)
    if not exists(bodies, b) or not (length > 0.0 and wp.isfinite(length)):
        return -1
    face, _far, turned = first_hit(bodies, b, origin, way / length, length)
    if face < 0 or turned > 0.0:
        return -1
    return face


@wp.func
def half_of_the_room(bodies: wp.array[Bodies], b: int, point: wp.vec3, outward: wp.vec3, distance: float) -> float:
    """Half of the way from a surface to what is opposite [m]; infinite where that is further than twice a distance."""
    start = wp.float32(BEYOND)
    face, far, turned = first_hit(bodies, b, point + start * outward, outward, 2.0 * distance)
    half = wp.float32(wp.inf)
    if face >= 0 and turned < 0.0:
        half = 0.5 * (start + far)
    return half


@wp.kernel(enable_backward=False)
def find_contacts(
    from_row: wp.int32,
    # Body:
    bodies: wp.array[Bodies],
    # In:
    vertices: wp.array[wp.vec3],
    distance: wp.array[wp.float32],
    face: wp.array[wp.int32],
    body_of_vertex: wp.array[wp.int32],
    origin: wp.array[wp.vec3],  # may be empty
    epsilon: wp.array[wp.float32],  # of each vertex, or of all
    # Out:
    closest: wp.array[wp.vec3d],
    normal: wp.array[wp.vec3d],
    kept: wp.array[wp.float32],
):
    """Closest points and outward directions at the vertices closer than epsilon, zero elsewhere.

    The closest point is computed again in float64: in float32, a direction over 0.1 mm has three digits.
    """
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    n = wp.vec3d()
    u = wp.vec3d()
    keep = epsilon[wp.min(i, epsilon.shape[0] - 1)]
    if distance[i] < keep:
        body = body_of_vertex[i]
        p = wp.vec3d(vertices[i])
        first = bodies[0].face_offsets[body]
        a, b, c = corners_of(bodies, body, face[i] - first)
        u = closest_on_triangle(p, a, b, c)
        edge = b - a
        length = wp.length(p - u)
        if length > AT_SURFACE:
            n = (p - u) / length
            if distance[i] < 0.0:
                n = -n
        else:
            n = wp.normalize(wp.cross(b - a, c - a))
        if distance[i] < 0.0 and origin.shape[0] > 0:
            entry = entered(bodies, body, origin[i], vertices[i])
            if entry >= 0:
                a, b, c = corners_of(bodies, body, entry)
                outward = wp.normalize(wp.cross(b - a, c - a))
                if wp.dot(outward, n) < wp.float64(0.0):
                    edge = b - a
                    u = p - wp.dot(outward, p - a) * outward  # as good as any point of its plane
                    n = outward
        if distance[i] < 0.0:
            if not leads_out(bodies, body, wp.vec3(u + BEYOND * n), wp.vec3(n)):
                way, far = way_out(bodies, body, vertices[i], wp.vec3(n), wp.vec3(edge))
                if far >= 0.0:
                    n = wp.vec3d(way)
                    u = p + wp.float64(far) * n
        keep = wp.min(keep, half_of_the_room(bodies, body, wp.vec3(u), wp.vec3(n), keep))
        if not wp.dot(n, p - u) < wp.float64(keep):
            n = wp.vec3d()
    closest[i] = u
    normal[i] = n
    kept[i] = keep


def contacts(
    vertices: torch.Tensor,
    distance: torch.Tensor,
    face: torch.Tensor,
    bodies: BodyMeshes,
    epsilon: torch.Tensor | float,
    *,
    body_of_vertex: torch.Tensor | None = None,
    origin: torch.Tensor | None = None,
) -> Contacts:
    """The set C: contacts of the vertices that are closer to a body than epsilon.

    Args:
        vertices: Positions [m], float32 [V,3].
        distance: Signed distance [m], float32 [V], negative inside.
        face: Nearest body face, int32 [V].
        bodies: The bodies in the frame of `vertices`.
        epsilon: Distance to keep from the body [m], a number or float32 [V].
        body_of_vertex: Body of each vertex, int32 [V]; None if there is one body.
        origin: Origin of each vertex [m], float32 [V,3], outside the body or NaN: vertices inside are moved to the side
            on which they entered. None moves them to the nearest point of the surface.

    Returns:
        Contacts without stencils, [V]; normals are zero at vertices that are not in C. Anchors are on the surface, or,
        for vertices moved to the side on which they entered, on the plane of the face of entry. Distances are epsilon,
        or half of the room between two parts of the body if that is less.
    """
    vertices = vertices.detach().contiguous()
    device = vertices.device
    body_of_vertex = bodies.body_of("body_of_vertex", body_of_vertex, len(vertices))
    origin = vertices.new_empty((0, 3)) if origin is None else origin.detach().contiguous()
    if not isinstance(epsilon, torch.Tensor):
        epsilon = torch.full((1,), epsilon, dtype=torch.float32, device=device)
    closest, normal = allocate((2, len(vertices), 3), torch.float64, device)
    kept = allocate((len(vertices),), torch.float32, device)
    with torch_stream(device) as warp_device:
        launch_rows(
            find_contacts,
            len(vertices),
            inputs=[
                bodies.argument,
                as_argument(vertices, wp.vec3),
                as_argument(distance, wp.float32),
                as_argument(face, wp.int32),
                as_argument(body_of_vertex, wp.int32),
                as_argument(origin, wp.vec3),
                as_argument(epsilon, wp.float32),
                as_argument(closest, wp.vec3d),
                as_argument(normal, wp.vec3d),
                as_argument(kept, wp.float32),
            ],
            outputs=[],
            device=warp_device,
        )
    return Contacts(normal, closest, kept)


class BodyContacts:
    """Source of the contacts of garments with their bodies."""

    name = "body"

    def find(self, vertices: torch.Tensor, frame: ContactFrame) -> Contacts:
        """One contact at each vertex that is closer to its body than `frame.epsilon`.

        Args:
            vertices: Positions [m], float32 [V,3].
            frame: Bodies, body of each vertex, distance to keep, and origins of the vertices.

        Returns:
            V contacts without stencils.
        """
        bodies, on_body, _, epsilon, origin, clear = frame
        query = bodies.query(vertices.detach(), on_body, within=epsilon, clear=clear)
        return contacts(vertices, query.distance, query.face, bodies, epsilon, body_of_vertex=on_body, origin=origin)
