"""The closest point of a body, and the side of it that a point is on.

Manifold-aware transformers, section 4.2 (s_i) and supplement equation 2; formulas in query.py. The nearest face
comes from the trees of tree.py on a CPU and from Warp's on a GPU, its point from nearest_face.py in float64, the sign
from inside.py. Nothing of earlier frames is used: a perfect guess of the distance would shorten the search by a tenth
only, and a result would then depend on more than its arguments. A limit on the distance shortens the search much more
(`within`): contacts need no point that is further outside. Which face is named where several are equally near is
decided in nearest_face.py.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .inside import crossings, is_inside
from .model import Bodies, corners_of, exists, has_tree
from .nearest_face import named_face, nearest_on_triangle
from .tree_rays import crossings_by_tree
from .tree_search import nearest_by_tree

wp.set_module_options(compiling.options())
SEARCHES = compiling.apart("warpgarment.kernels.sdf.searches", max_unroll=1)
"""The module of all kernels that search closest points: the search, two seconds of the compiler, is compiled once."""

MAX_DISTANCE = wp.constant(1.0e18)  # m; larger than any distance, while its square is still a finite float32
# Bodies in pieces: distance, in radii, from which a group of faces is summed as one. On closed bodies 1, 2 and 3 give
# the same signs (20,000 points); at the mouths of open ones, signs are sure where the winding number is 0.04, 0.001 and
# less from 0.5.
WINDING_ACCURACY = wp.constant(2.0)
INSIDE = wp.constant(0.5)  # winding number of the boundary: closed surfaces have 0 outside and 1 or more inside
ROUNDING = wp.constant(2.0e-6)
"""Length [m] by which a ball without surface has to be larger than what is asked for."""
NOTHING = wp.constant(-1)
BEYOND = wp.constant(-2)


@wp.func
def found_face(bodies: wp.array[Bodies], b: int, point: wp.vec3, reach: float) -> int:
    """The face of a body, counted within it, that a search in float32 finds; NOTHING if none is nearer than `reach`."""
    face = NOTHING
    if has_tree(bodies):
        face = nearest_by_tree(bodies, b, point, reach)
    else:
        near = wp.mesh_query_point_no_sign(bodies[0].meshes[b], point, reach)
        if near.result:
            face = near.face
    return face


@wp.func
def body_crossings(bodies: wp.array[Bodies], b: int, point: wp.vec3, axis: int, side: float) -> int:
    """Signed number of crossings of a ray along an axis with a body."""
    crossed = wp.int32(0)
    if has_tree(bodies):
        crossed = crossings_by_tree(bodies, b, point, axis, side)
    else:
        crossed = crossings(bodies[0].meshes[b], point, axis, side)
    return crossed


@wp.func
def position_on(bodies: wp.array[Bodies], b: int, face: int, u: float, v: float):
    """The point with two barycentric coordinates, in float64."""
    p, q, r = corners_of(bodies, b, face)
    return p * wp.float64(u) + q * wp.float64(v) + r * wp.float64(1.0 - u - v)


@wp.func
def away_from(bodies: wp.array[Bodies], b: int, face: int, point: wp.vec3) -> wp.vec3:
    """Normal of a face, of any length, to the side of it that a point is on."""
    corner = bodies[0].faces[bodies[0].face_offsets[b] + face]
    start = bodies[0].vertices[corner[0]]
    normal = wp.cross(bodies[0].vertices[corner[1]] - start, bodies[0].vertices[corner[2]] - start)
    return wp.where(wp.dot(normal, point - start) < 0.0, -normal, normal)


@wp.func
def closest_on_body(bodies: wp.array[Bodies], b: int, point: wp.vec3, within: float):
    """Nearest surface point of a body and the point's side.

    Returns:
        Local face index, sign (+1 outside, -1 inside), barycentric coordinates, closest point [m]. The face is NOTHING
        where there is no closest point, and BEYOND where the point is outside and no nearer than `within` [m].
    """
    nowhere = wp.vec3(wp.nan)
    if not wp.isfinite(point):
        return NOTHING, 1.0, nowhere, wp.vec3d(nowhere)
    reach = wp.min(within, MAX_DISTANCE)
    face = NOTHING
    sign = wp.float32(1.0)
    if bodies[0].scattered[b] != 0:
        around = wp.mesh_query_point_sign_winding_number(
            bodies[0].meshes[b], point, MAX_DISTANCE, WINDING_ACCURACY, INSIDE
        )
        if around.result:
            sign = around.sign
            if (
                sign < 0.0
                or wp.length(wp.vec3d(point) - position_on(bodies, b, around.face, around.u, around.v)) < reach
            ):
                face = around.face
    else:
        if reach > 0.0:
            face = found_face(bodies, b, point, reach)
        # The ray leads away from the surface, where it meets fewer faces; any other ray gives the same sign.
        axis = wp.int32(2)
        side = wp.float32(1.0)
        if face >= 0:
            away = away_from(bodies, b, face, point)
            size = wp.vec3(wp.abs(away[0]), wp.abs(away[1]), wp.abs(away[2]))
            axis = wp.where(size[0] > wp.max(size[1], size[2]), 0, wp.where(size[1] > size[2], 1, 2))
            side = wp.where(away[axis] < 0.0, -1.0, 1.0)
        if is_inside(bodies, b, body_crossings(bodies, b, point, axis, side), point, axis, side):
            sign = -1.0
            if face < 0:
                face = found_face(bodies, b, point, MAX_DISTANCE)
    if face < 0:
        return wp.where(reach < MAX_DISTANCE, BEYOND, NOTHING), sign, nowhere, wp.vec3d(nowhere)
    # The search is in float32. Distances are flat around their minimum: where one is right to 1e-7 m, its point may be
    # 1e-4 m off. So the point is computed again, on the face that is named.
    named = named_face(bodies, b, face, point)
    p, q, r = corners_of(bodies, b, named)
    weights = nearest_on_triangle(wp.vec3d(point), p, q, r)
    return named, sign, wp.vec3(weights), weights[0] * p + weights[1] * q + weights[2] * r


@wp.kernel(enable_backward=False, module=SEARCHES)
def query_bodies_kernel(
    from_row: wp.int32,
    # Model:
    bodies: wp.array[Bodies],
    # In:
    points: wp.array[wp.vec3],
    body_of_point: wp.array[wp.int32],
    within: wp.array[wp.float32],
    clear: wp.array[wp.float32],  # may be empty
    # Out:
    distance: wp.array[wp.float32],
    closest: wp.array[wp.vec3],
    face: wp.array[wp.int32],
    barycentric: wp.array[wp.vec3],
):
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    b = body_of_point[i]
    distance[i] = wp.nan
    closest[i] = wp.vec3(wp.nan)
    face[i] = -1
    barycentric[i] = wp.vec3(wp.nan)
    if not exists(bodies, b):
        return
    reach = within[wp.min(i, within.shape[0] - 1)]
    if clear.shape[0] > 0:
        if clear[i] > reach + ROUNDING:
            distance[i] = wp.inf
            return
    found, sign, weights, position = closest_on_body(bodies, b, points[i], reach)
    if found == BEYOND:
        distance[i] = wp.inf
    if found < 0:
        return
    distance[i] = sign * wp.float32(wp.length(wp.vec3d(points[i]) - position))
    closest[i] = wp.vec3(position)
    face[i] = found + bodies[0].face_offsets[b]
    barycentric[i] = weights


def query_bodies(
    model: Any,
    points: torch.Tensor,
    body_of_point: torch.Tensor,
    within: torch.Tensor,
    clear: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Launches `query_bodies_kernel`.

    Args:
        model: The bodies, `BodyMeshes.argument`.
        points: Positions [m], float32 [N, 3].
        body_of_point: Body of each point, int32 [N].
        within: Distance from which points outside are not searched further [m], float32 [N], or [1] for all points.
        clear: Radius of a ball around each point that is known to hold no surface [m], float32 [N], 0 where the point
            may be inside; None if nothing is known. It changes the time only.

    Returns:
        Signed distance [m], float32 [N]; closest point [m], float32 [N, 3]; packed index of the nearest face, int32
        [N]; barycentric coordinates of the closest point on that face, float32 [N, 3].
    """
    rows, device = len(points), points.device
    distance, closest = allocate((rows,), torch.float32, device), allocate((rows, 3), torch.float32, device)
    face, barycentric = allocate((rows,), torch.int32, device), allocate((rows, 3), torch.float32, device)
    clear = distance[:0] if clear is None else clear
    if rows:
        with torch_stream(device) as warp_device:
            launch_rows(
                query_bodies_kernel,
                rows,
                inputs=[
                    model,
                    as_argument(points, wp.vec3),
                    as_argument(body_of_point, wp.int32),
                    as_argument(within, wp.float32),
                    as_argument(clear, wp.float32),
                ],
                outputs=[
                    as_argument(distance, wp.float32),
                    as_argument(closest, wp.vec3),
                    as_argument(face, wp.int32),
                    as_argument(barycentric, wp.vec3),
                ],
                device=warp_device,
            )
    return distance, closest, face, barycentric
