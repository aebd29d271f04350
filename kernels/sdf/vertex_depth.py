"""Depth of the vertices of garments inside bodies, and how far those outside are from them.

A vertex outside has a ball around it without any surface, see surface_depth.py. One that has moved by a small part of
its ball since an earlier measurement, on a body that has not moved, is still outside, with a ball that is smaller by
that.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels.launch import as_argument, expect, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .bodies import BodyMeshes
from .closest import BEYOND, ROUNDING, SEARCHES, closest_on_body
from .model import Bodies, exists

MOVED = wp.constant(0.25)
"""Part of its ball by which a vertex may have moved since it was measured."""


class Measured(NamedTuple):
    """What is known of vertices, on bodies that have not moved since."""

    positions: torch.Tensor
    """Where they were measured [m], float32 [V,3]."""
    depth: torch.Tensor
    """Depth of each vertex [m], float32 [V]."""
    clear: torch.Tensor
    """Radius of the ball around each vertex that holds no surface [m], float32 [V]."""


@wp.kernel(enable_backward=False, module=SEARCHES)
def depth_of_vertices(
    from_row: wp.int32,
    # Model:
    bodies: wp.array[Bodies],
    # In:
    vertices: wp.array[wp.vec3],
    body_of_vertex: wp.array[wp.int32],
    limit: wp.float32,
    measured: wp.array[wp.vec3],  # where vertices were measured before, with the next two; or empty
    depth_before: wp.array[wp.float32],
    clear_before: wp.array[wp.float32],
    # Out:
    depth: wp.array[wp.float32],
    clear: wp.array[wp.float32],
):
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    depth[i] = 0.0
    clear[i] = 0.0
    b = body_of_vertex[i]
    if exists(bodies, b):
        if measured.shape[0] > 0:
            moved = wp.length(vertices[i] - measured[i])
            if moved == 0.0:
                depth[i] = depth_before[i]
                clear[i] = clear_before[i]
                return
            if moved < MOVED * clear_before[i]:
                clear[i] = clear_before[i] - moved - ROUNDING
                return
        found, sign, _weights, closest = closest_on_body(bodies, b, vertices[i], limit)
        if found >= 0:
            away = wp.float32(wp.length(wp.vec3d(vertices[i]) - closest))
            depth[i] = wp.where(sign < 0.0, away, 0.0)
            clear[i] = wp.where(sign < 0.0, 0.0, away)
        elif found == BEYOND:
            clear[i] = limit


def measured(
    vertices: torch.Tensor,
    bodies: BodyMeshes,
    body_of_vertex: torch.Tensor,
    *,
    limit: float = 0.0,
    before: Measured | None = None,
) -> Measured:
    """Depths of vertices, and the balls around those that are outside; without gradients.

    Args:
        vertices: Positions [m], float32 [V,3]; vertices that are not finite count as outside, without a ball.
        bodies: The bodies at the same time step.
        body_of_vertex: Body of each vertex, int32 [V]; a vertex with body -1 is in no body.
        limit: Largest radius of a ball that is looked for [m].
        before: What was found of the same vertices earlier, on the bodies where they are now, with the same
            `body_of_vertex` or more of them on a body. Balls of vertices that hardly moved are then smaller by that.

    Raises:
        ValueError: Wrong shape or device.
        TypeError: Wrong dtype.
    """
    device, size = vertices.device, len(vertices)
    expect("vertices", vertices, (None, 3))
    expect("body_of_vertex", body_of_vertex, (size,), torch.int32, device)
    vertices = vertices.detach()
    depth, clear = allocate((2, size), torch.float32, device)
    earlier = Measured(depth.new_empty((0, 3)), depth[:0], depth[:0]) if before is None else before
    if before is not None:
        expect("before.positions", before.positions, (size, 3), device=device)
    with torch_stream(device) as warp_device:
        points, body = as_argument(vertices, wp.vec3), as_argument(body_of_vertex, wp.int32)
        inputs = [bodies.argument, points, body, float(limit), as_argument(earlier.positions, wp.vec3)]
        inputs += [as_argument(earlier.depth, wp.float32), as_argument(earlier.clear, wp.float32)]
        found = [as_argument(depth, wp.float32), as_argument(clear, wp.float32)]
        launch_rows(depth_of_vertices, size, inputs, found, warp_device)
    return Measured(vertices, depth, clear)
