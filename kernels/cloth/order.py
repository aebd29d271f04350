r"""Layers that cross at the start of a frame: around the crossing, their order decides on which side a face belongs.

Everywhere else faces are kept on the side on which they are (contacts.py). Around a crossing some of them are on the
wrong side, and keeping them there would keep the crossing. So pairs of two layers are set free if they are joined to a
crossing pair by faces of such pairs, and lie against the order:

    n·w < LEAST,    w = (n_A + n_B) / |n_A + n_B|,    n_A·n_B > 0

where n separates them, seen from the inner to the outer face, and n_A, n_B are the normals of the faces. Free pairs
lose their n, and are then treated like those that cross: they are pushed by their order, nothing holds them, and they
count if they cross. From one frame to the next, the crossing moves to the border of what is on the wrong side, and is
gone when all of it has been pushed through. Faces of a garment that crosses itself have no order, and go on crossing.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, torch_stream

from .contacts import Contacts, Pairs, kept_pairs
from .triangles import corners

wp.set_module_options(compiling.options())

LEAST = wp.constant(0.3)
ROUNDS = 6
"""Rounds in which pairs around are set free: rings of faces around a crossing."""


@wp.func
def is_marked(face: wp.vec3i, mark: wp.array[wp.int32]) -> bool:
    """Whether a corner of a face is marked."""
    return mark[face[0]] + mark[face[1]] + mark[face[2]] > 0


@wp.func
def add_mark(face: wp.vec3i, mark: wp.array[wp.int32]):
    for k in range(3):
        mark[face[k]] = 1


@wp.kernel(enable_backward=False)
def mark_kernel(
    # Model:
    pairs: Pairs,
    # In:
    normal: wp.array2d[wp.vec3],
    # Out:
    mark: wp.array[wp.int32],  # marked, of each vertex
    crossing: wp.array[wp.int32],  # marked, of each outfit
):
    """Corners of faces of different layers that cross."""
    m = wp.tid()
    for k in range(kept_pairs(pairs, m)):
        n = normal[m, k]
        o = pairs.partners[m, k]
        if wp.dot(n, n) == 0.0 and pairs.garment[m] != pairs.garment[o]:
            crossing[pairs.outfit[m]] = 1
            add_mark(pairs.faces[m], mark)
            add_mark(pairs.faces[o], mark)


@wp.kernel(enable_backward=False)
def free_kernel(
    # Model:
    pairs: Pairs,
    # In:
    start: wp.array[wp.vec3],
    mark: wp.array[wp.int32],
    crossing: wp.array[wp.int32],
    # Out:
    normal: wp.array2d[wp.vec3],  # zero where pairs are set free
    more: wp.array[wp.int32],  # marked, of each vertex
):
    m = wp.tid()
    if crossing[pairs.outfit[m]] == 0:
        return
    face = pairs.faces[m]
    here = is_marked(face, mark)
    origin = start[face[0]]
    p = corners(start, face, origin)
    across = wp.normalize(wp.cross(p[1], p[2]))
    for k in range(kept_pairs(pairs, m)):
        n = normal[m, k]
        o = pairs.partners[m, k]
        if pairs.garment[m] != pairs.garment[o] and wp.dot(n, n) > 0.0:
            other = pairs.faces[o]
            if here or is_marked(other, mark):
                q = corners(start, other, origin)
                there = wp.normalize(wp.cross(q[1] - q[0], q[2] - q[0]))
                outer_first = pairs.rank[pairs.garment[m]] > pairs.rank[pairs.garment[o]]
                along = wp.dot(wp.where(outer_first, n, -n), wp.normalize(across + there))
                if wp.dot(across, there) > 0.0 and along < LEAST:
                    normal[m, k] = wp.vec3()
                    add_mark(face, more)
                    add_mark(other, more)


def set_free(contacts: Contacts, start: torch.Tensor, outfits: int, *, early_exit: bool = False) -> None:
    """Sets pairs around crossings of layers free; changes the normals of `contacts`.

    Args:
        contacts: The pairs of the frame and their normals at the start.
        start: Positions at the start [m], float32 [V,3].
        outfits: Number of outfits O.
        early_exit: Whether the host looks if any layers cross, which makes no difference to the result.
    """
    device, members = start.device, len(contacts.pairs.outfits.faces)
    mark = torch.zeros(len(start), dtype=torch.int32, device=device)
    crossing = torch.zeros(outfits, dtype=torch.int32, device=device)
    normal, points = as_argument(contacts.normal, wp.vec3), as_argument(start, wp.vec3)
    flags = as_argument(crossing, wp.int32)
    with torch_stream(device) as warp_device:
        outputs = [as_argument(mark, wp.int32), flags]
        wp.launch(mark_kernel, dim=members, inputs=[contacts.model, normal], outputs=outputs, device=warp_device)
        if early_exit and not crossing.any():
            return
        for _ in range(ROUNDS):
            more = mark.clone()
            inputs = [contacts.model, points, as_argument(mark, wp.int32), flags]
            outputs = [normal, as_argument(more, wp.int32)]
            wp.launch(free_kernel, dim=members, inputs=inputs, outputs=outputs, device=warp_device)
            mark = more
