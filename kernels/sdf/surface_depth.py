r"""Depth of garments inside bodies: at vertices, and between them.

A vertex of a garment keeps a distance from the body, but the body can still come through an edge or a face whose
corners are all outside. The points examined are

- the vertices,
- the middles of edges and faces,
- on every face, the point c nearest to the body vertex u that stands out of it most, and less than l:
  |u - c| < l with n·(u - x) > 0, where u belongs to a body face that looks the same way. Anything pointed has a vertex
  at its tip.

Of these, the points inside the body count; their depth is the distance to its surface. An edge of the body that crosses
an edge of the garment can still be missed.

A vertex outside at a distance r from the body has a ball of that radius around it without any surface: the middles of
edges and faces and the points c within it are outside too, and are not examined. Distances are found up to a limit of
less than an edge. A point of a triangle is no further from the nearest corner than 1/√3 of the longest edge; so the
balls of a face whose corners are further from the body hold all of it.

| symbol | code | what |
| --- | --- | --- |
| x, n | `x, y, z`, `normal` | corners of a face [m], its normal |
| u, c | `tip`, `foot` | vertex of the body, the nearest point on a face of the garment [m] |
| l | `STANDS_OUT` | limit of the distance between them [m] |
| r | `clear` | distance of a vertex that is outside from the body, or the limit if that is less; 0 inside [m] |
| | `missing` | how much deeper the edges and faces at a vertex are than their corners [m] |
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, expect, launch, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .bodies import BodyMeshes
from .closest import ROUNDING, SEARCHES, closest_on_body
from .model import Bodies, exists, has_tree
from .nearest_face import closest_on_triangle
from .tree_boxes import boxes_in_box, triangles_above
from .tree_search import least, least_above, stack64
from .vertex_depth import Measured, measured

wp.set_module_options(compiling.options(max_unroll=1))

STANDS_OUT = wp.constant(0.01)
"""Limit l [m]. Of a part that stands out further, lower vertices are found; a spike without any is missed."""
ROOM = wp.constant(0.01001)
"""Margin of the box around a face in which its tips are [m], a little more than l."""
COVERED = wp.constant(0.57736)
"""1/√3, and some rounding."""


class SurfaceDepth(NamedTuple):
    """Depths that `surface_depth` returns, all in metres, float32 and at least 0."""

    garments: torch.Tensor  # of each garment's deepest point, [B]
    missing: torch.Tensor  # at each vertex, how much deeper its edges and faces are than their corners, [V]
    depth: torch.Tensor  # of each vertex, [V]
    clear: torch.Tensor  # radius of the ball around each vertex that holds no surface, [V]


@wp.func
def depth_at(bodies: wp.array[Bodies], b: int, point: wp.vec3) -> float:
    """Depth of a point inside a body [m]; 0 outside."""
    depth = wp.float32(0.0)
    _face, sign, _weights, closest = closest_on_body(bodies, b, point, 0.0)
    if sign < 0.0:
        depth = wp.float32(wp.length(wp.vec3d(point) - closest))
    return depth


@wp.func
def foot_of_tips(
    x: wp.vec3, y: wp.vec3, z: wp.vec3, normal: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, most: float, foot: wp.vec3
):
    """The corner of a body face that stands out of xyz by more than `most`, if any: by how much, and its foot."""
    if wp.dot(wp.cross(b - a, c - a), normal) > 0.0:
        for k in range(3):
            tip = wp.where(k == 0, a, wp.where(k == 1, b, c))
            height = wp.dot(normal, tip - x)
            if height > 0.0 and height < STANDS_OUT * wp.length(normal):
                nearest = wp.vec3(closest_on_triangle(wp.vec3d(tip), wp.vec3d(x), wp.vec3d(y), wp.vec3d(z)))
                away = wp.length(tip - nearest)
                if away > most and away < STANDS_OUT:
                    most = away
                    foot = nearest
    return most, foot


@wp.func
def foot_by_tree(
    bodies: wp.array[Bodies], b: int, x: wp.vec3, y: wp.vec3, z: wp.vec3, normal: wp.vec3, low: wp.vec3, high: wp.vec3
):
    """The point c of a face of the garment; the body's faces are searched in the trees of tree.py."""
    tree = bodies[0].tree
    most = wp.float32(0.0)
    foot = wp.vec3(wp.nan)
    thick = STANDS_OUT * wp.length(normal)
    nodes = stack64()
    nodes[0] = tree.nodes[b]
    top = wp.int32(1)
    while top > 0:
        top -= 1
        node = nodes[top]
        lanes = boxes_in_box(tree.boxes, node, low, high)
        first = tree.children[node]
        child = least(lanes)
        while child < 8:
            if first < 0:
                leaf = ~first + child
                above = triangles_above(tree.corners, leaf, x, normal, thick, low, high)
                r = least(above)
                while r < 8:
                    p = wp.vec3(tree.corners[leaf, 0][r], tree.corners[leaf, 1][r], tree.corners[leaf, 2][r])
                    q = wp.vec3(tree.corners[leaf, 3][r], tree.corners[leaf, 4][r], tree.corners[leaf, 5][r])
                    s = wp.vec3(tree.corners[leaf, 6][r], tree.corners[leaf, 7][r], tree.corners[leaf, 8][r])
                    most, foot = foot_of_tips(x, y, z, normal, p, q, s, most, foot)
                    r = least_above(above, r)
            else:
                nodes[top] = first + child
                top += 1
            child = least_above(lanes, child)
    return foot


@wp.kernel(enable_backward=False)
def feet_of_tips(
    from_row: wp.int32,
    # Model:
    bodies: wp.array[Bodies],
    faces: wp.array[wp.vec3i],
    # In:
    vertices: wp.array[wp.vec3],
    body_of_vertex: wp.array[wp.int32],
    clear: wp.array[wp.float32],
    # Out:
    feet: wp.array[wp.vec3],
):
    """The point c of each face, NaN where no body vertex stands out, or where it would be in a ball in any case.

    This is a kernel of its own, because two kinds of queries do not fit in the shared memory of a GPU.
    """
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    feet[i] = wp.vec3(wp.nan)
    b = body_of_vertex[faces[i][0]]
    if not exists(bodies, b):
        return
    x = vertices[faces[i][0]]
    y = vertices[faces[i][1]]
    z = vertices[faces[i][2]]
    longest = wp.max(wp.length(y - x), wp.max(wp.length(z - y), wp.length(x - z)))
    if wp.min(clear[faces[i][0]], wp.min(clear[faces[i][1]], clear[faces[i][2]])) > COVERED * longest + ROUNDING:
        return
    normal = wp.cross(y - x, z - x)
    if not (wp.length(normal) > 0.0 and wp.isfinite(normal)):
        return
    room = wp.vec3(ROOM)
    low = wp.min(x, wp.min(y, z)) - room
    high = wp.max(x, wp.max(y, z)) + room
    if has_tree(bodies):
        feet[i] = foot_by_tree(bodies, b, x, y, z, normal, low, high)
        return
    query = wp.mesh_query_aabb(bodies[0].meshes[b], low, high)
    face = wp.int32(0)
    most = wp.float32(0.0)
    foot = wp.vec3(wp.nan)
    while wp.mesh_query_aabb_next(query, face):
        corner = bodies[0].faces[face + bodies[0].face_offsets[b]]
        most, foot = foot_of_tips(
            x,
            y,
            z,
            normal,
            bodies[0].vertices[corner[0]],
            bodies[0].vertices[corner[1]],
            bodies[0].vertices[corner[2]],
            most,
            foot,
        )
    feet[i] = foot


@wp.func
def in_ball(point: wp.vec3, centre: wp.vec3, radius: float) -> bool:
    """Whether a point is in a ball without surface."""
    away = point - centre
    inner = wp.max(radius - ROUNDING, 0.0)
    return wp.dot(away, away) < inner * inner


@wp.func
def in_a_ball(point: wp.vec3, x: wp.vec3, y: wp.vec3, z: wp.vec3, radius: wp.vec3) -> bool:
    """Whether a point is in the ball without surface around a corner."""
    return in_ball(point, x, radius[0]) or in_ball(point, y, radius[1]) or in_ball(point, z, radius[2])


@wp.kernel(enable_backward=False, module=SEARCHES)
def depth_between_vertices(
    from_row: wp.int32,
    # Model:
    bodies: wp.array[Bodies],
    edges: wp.array[wp.vec2i],
    faces: wp.array[wp.vec3i],
    # In:
    vertices: wp.array[wp.vec3],
    body_of_vertex: wp.array[wp.int32],
    clear: wp.array[wp.float32],
    feet: wp.array[wp.vec3],
    # Out:
    between: wp.array[wp.float32],
):
    """Depth between the vertices of one edge or one face."""
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    corner = wp.vec3i()
    is_face = i >= edges.shape[0]
    if is_face:
        corner = faces[i - edges.shape[0]]
    else:
        corner = wp.vec3i(edges[i][0], edges[i][1], edges[i][1])
    between[i] = 0.0
    b = body_of_vertex[corner[0]]
    if not exists(bodies, b):
        return
    x = vertices[corner[0]]
    y = vertices[corner[1]]
    z = vertices[corner[2]]
    radius = wp.vec3(clear[corner[0]], clear[corner[1]], clear[corner[2]])
    middle = 0.5 * (x + y)
    worst = wp.float32(0.0)
    if is_face:
        middle = (x + y + z) / 3.0
        foot = feet[i - edges.shape[0]]
        if not (wp.isnan(foot[0]) or in_a_ball(foot, x, y, z, radius)):
            worst = depth_at(bodies, b, foot)
    if not in_a_ball(middle, x, y, z, radius):
        worst = wp.max(worst, depth_at(bodies, b, middle))
    between[i] = worst


@wp.kernel(enable_backward=False)
def collect_depth(
    # Model:
    garment_of_vertex: wp.array[wp.int32],
    edges: wp.array[wp.vec2i],
    faces: wp.array[wp.vec3i],
    # In:
    depth: wp.array[wp.float32],
    between: wp.array[wp.float32],
    # Out:
    missing: wp.array[wp.float32],  # accumulated
    deepest: wp.array[wp.float32],  # accumulated
):
    """Depths of vertices, edges and faces, in this order, for garments and vertices; on a CPU on one thread."""
    i, _ = wp.tid()  # see compiling.py
    if i < depth.shape[0]:
        if depth[i] > 0.0:
            wp.atomic_max(deepest, garment_of_vertex[i], depth[i])
        return
    i -= depth.shape[0]
    if not between[i] > 0.0:
        return
    corner = wp.vec3i()
    if i >= edges.shape[0]:
        corner = faces[i - edges.shape[0]]
    else:
        corner = wp.vec3i(edges[i][0], edges[i][1], edges[i][1])
    more = between[i] - wp.max(depth[corner[0]], wp.max(depth[corner[1]], depth[corner[2]]))
    if more > 0.0:
        wp.atomic_max(deepest, garment_of_vertex[corner[0]], between[i])
        for k in range(3):
            wp.atomic_max(missing, corner[k], more)


def surface_depth(
    vertices: torch.Tensor,
    bodies: BodyMeshes,
    body_of_vertex: torch.Tensor,
    edges: torch.Tensor,
    faces: torch.Tensor,
    garment_of_vertex: torch.Tensor,
    count: int,
    *,
    limit: float = 0.0,
    before: Measured | None = None,
) -> SurfaceDepth:
    """Depths of a packed batch of garments; without gradients.

    Args:
        vertices: Positions [m], float32 [V,3]; vertices that are not finite count as outside.
        bodies: The bodies at the same time step.
        body_of_vertex: Body of each vertex, int32 [V]; a vertex with body -1 is in no body.
        edges: Packed vertex indices of every edge, int32 [E,2].
        faces: Packed vertex indices, int32 [F,3].
        garment_of_vertex: Garment of each vertex, int32 [V].
        count: Number of garments B.
        limit: Largest distance of vertices that is looked for [m], to leave out what is around them. It changes the
            time only; a little more than half of an edge is a good one.
        before: What `measured` found of the same vertices earlier. It changes the time only.

    Raises:
        ValueError: Wrong shape or device.
        TypeError: Wrong dtype.
    """
    device, size = vertices.device, len(vertices)
    expect("vertices", vertices, (None, 3))
    expect("edges", edges, (None, 2), torch.int32, device)
    expect("faces", faces, (None, 3), torch.int32, device)
    expect("garment_of_vertex", garment_of_vertex, (size,), torch.int32, device)
    now = measured(vertices, bodies, body_of_vertex, limit=limit, before=before)
    feet, between = (allocate(shape, torch.float32, device) for shape in ((len(faces), 3), (len(edges) + len(faces),)))
    missing, deepest = (torch.zeros(length, dtype=torch.float32, device=device) for length in (size, count))
    points, body = as_argument(now.positions, wp.vec3), as_argument(body_of_vertex, wp.int32)
    lines, triangles = as_argument(edges, wp.vec2i), as_argument(faces, wp.vec3i)
    foot, depths, rest = (as_argument(feet, wp.vec3), *(as_argument(t, wp.float32) for t in (now.depth, between)))
    balls = as_argument(now.clear, wp.float32)
    with torch_stream(device) as warp_device:
        launch_rows(feet_of_tips, len(faces), [bodies.argument, triangles, points, body, balls], [foot], warp_device)
        inputs = [bodies.argument, lines, triangles, points, body, balls, foot]
        launch_rows(depth_between_vertices, len(between), inputs, [rest], warp_device)
        given = [as_argument(garment_of_vertex, wp.int32), lines, triangles, depths, rest]
        written = [as_argument(missing, wp.float32), as_argument(deepest, wp.float32)]
        launch(collect_depth, size + len(between), [*given, *written], warp_device)
    return SurfaceDepth(deepest, missing, now.depth, now.clear)
