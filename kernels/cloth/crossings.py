"""Counts the pairs of triangles that cross, of different garments and of one.

Faces with a common vertex do not count. Triangles cross if no direction separates them by more than two micrometres
(triangles.py); those that touch count.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, torch_stream

from .contacts import Pairs, kept_pairs
from .triangles import TOUCHING, corners, gap_along, separating

wp.set_module_options(compiling.options())


class Crossings(NamedTuple):
    """Pairs of triangles that cross in one frame, for each garment."""

    layers: torch.Tensor  # with other garments of its outfit, int32 [B]: the two garments of a pair both count it
    itself: torch.Tensor  # of the garment with itself, int32 [B]
    unseen: torch.Tensor  # pairs that were not looked at, for lack of room, in its outfit, int32 [B]


@wp.kernel(enable_backward=False)
def crossings_kernel(
    # Model:
    pairs: Pairs,
    # In:
    normal: wp.array2d[wp.vec3],  # a guess of a separating direction; may be empty
    points: wp.array[wp.vec3],
    # Out:
    found: wp.array2d[wp.int32],  # accumulated
):
    m = wp.tid()
    face = pairs.faces[m]
    origin = points[face[0]]
    p = corners(points, face, origin)
    g = pairs.garment[m]
    kept = kept_pairs(pairs, m)
    for k in range(kept):
        o = pairs.partners[m, k]
        q = corners(points, pairs.faces[o], origin)
        apart = False
        if normal.shape[0] > 0:
            n = normal[m, k]
            apart = wp.dot(n, n) > 0.0 and gap_along(p, q, n) > TOUCHING
        if not apart:
            way = separating(p, q)
            if wp.dot(way, way) == 0.0:
                h = pairs.garment[o]
                if g == h:
                    wp.atomic_add(found, g, 1, 1)
                else:
                    wp.atomic_add(found, g, 0, 1)
                    wp.atomic_add(found, h, 0, 1)
    if pairs.count[m] > kept:
        wp.atomic_add(found, g, 2, pairs.count[m] - kept)


def crossings(pairs: Pairs, members: int, normal: torch.Tensor, points: torch.Tensor, garments: int) -> Crossings:
    """Counts crossings among the pairs of a frame; without gradients, and the host does not wait.

    Args:
        pairs: The pairs.
        members: Number of faces M that form pairs.
        normal: Directions that may separate the pairs, float32 [M,K,3] or [0,0,3].
        points: Positions [m], float32 [V,3].
        garments: Number of garments B.
    """
    found = torch.zeros((garments, 3), dtype=torch.int32, device=points.device)
    inputs = [pairs, as_argument(normal, wp.vec3), as_argument(points.detach(), wp.vec3)]
    with torch_stream(points.device) as device:
        wp.launch(crossings_kernel, dim=members, inputs=inputs, outputs=[as_argument(found, wp.int32)], device=device)
    return Crossings(*found.unbind(1))
