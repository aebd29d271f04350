r"""Steps of garments that no pair of faces crosses on the way: what was free stays free.

Vertices move from the start C of a frame towards its end V, each by a share α of its way, S = C + α (V - C). A pair of
faces is safe if one direction n separates it at C and at S,

    g_C(n) = min_i n·a_i(C) - max_j n·b_j(C) > 0,    g_S(n) > 0,

since on straight ways the gap along n is at least the mean of both, weighted by time. The pair may move as it likes as
long as it stays apart, which bounds by distances would forbid. Where no such n is found, the α of the corners are made
smaller, those of vertices around them follow, and all pairs of the outfit are looked at again, until all are safe. At
α = 0 every pair is safe that was apart at C. If some pair is not safe after the last round, its whole outfit stays at C
for this frame.

| symbol | code | what |
| --- | --- | --- |
| C, V, S | `start`, `end`, `points` | positions [m] |
| α | `share` | of each vertex |
| n | `normal` | of each pair at C (contacts.py); zero for pairs that cross there, which are only counted |
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, torch_stream
from warpgarment.kernels.operator import allocate

from .contacts import Contacts, Pairs, kept_pairs
from .triangles import TOUCHING, corners, gap_along, separating

wp.set_module_options(compiling.options())

SAFE = wp.constant(5.0e-4)
"""Gap [m] that a pair keeps; if it has less at the start, nine tenths of what it has there beyond `TOUCHING`."""
SLOPE = wp.constant(0.34)
"""By how much α may differ between the corners of a face."""
SHRINK = (0.5, 0.5, 0.4, *[0.0] * 13)
"""Factors of α in the rounds: at first all may still move, then what is not safe stays, and what is around it."""


class Steps(NamedTuple):
    """Where a frame ends; see `Met` in meet.py for the other figures."""

    positions: torch.Tensor  # S [m], float32 [V,3]
    held: torch.Tensor  # whether an outfit stayed at C, bool [O]


@wp.func
def one_axis(p0: wp.mat33, q0: wp.mat33, p: wp.mat33, q: wp.mat33, axis: wp.vec3) -> bool:
    """Whether one direction separates two triangles at C (p0, q0) and at S (p, q)."""
    length = wp.length(axis)
    found = False
    if length > 0.0:
        n = axis / length
        before = gap_along(p0, q0, n)
        found = before > TOUCHING and gap_along(p, q, n) > wp.min(SAFE, TOUCHING + 0.9 * (before - TOUCHING))
    return found


@wp.func
def is_safe(pairs: Pairs, m: int, o: int, n: wp.vec3, start: wp.array[wp.vec3], points: wp.array[wp.vec3]) -> bool:
    """Whether a pair is safe; n is its normal at C, not zero."""
    origin = points[pairs.faces[m][0]]
    p = corners(points, pairs.faces[m], origin)
    q = corners(points, pairs.faces[o], origin)
    safe = gap_along(p, q, n) > SAFE
    if not safe:
        first = start[pairs.faces[m][0]]
        p0 = corners(start, pairs.faces[m], first)
        q0 = corners(start, pairs.faces[o], first)
        safe = one_axis(p0, q0, p, q, n)
        if not safe:
            now = separating(p, q)
            if wp.dot(now, now) > 0.0:
                safe = one_axis(p0, q0, p, q, now)
                if not safe:
                    safe = one_axis(p0, q0, p, q, now + n)
    return safe


@wp.kernel(enable_backward=False)
def shrink_kernel(
    # Model:
    pairs: Pairs,
    shrink: wp.float32,
    # In:
    normal: wp.array2d[wp.vec3],
    start: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    share: wp.array[wp.float32],
    # Out:
    smaller: wp.array[wp.float32],  # made smaller
    unsafe: wp.array[wp.int32],  # marked, of each outfit
):
    m = wp.tid()
    for k in range(kept_pairs(pairs, m)):
        n = normal[m, k]
        if wp.dot(n, n) > 0.0:
            o = pairs.partners[m, k]
            if not is_safe(pairs, m, o, n, start, points):
                unsafe[pairs.outfit[m]] = 1
                for i in range(3):
                    wp.atomic_min(smaller, pairs.faces[m][i], shrink * share[pairs.faces[m][i]])
                    wp.atomic_min(smaller, pairs.faces[o][i], shrink * share[pairs.faces[o][i]])


@wp.kernel(enable_backward=False)
def spread_kernel(
    # Model:
    pairs: Pairs,
    # In:
    share: wp.array[wp.float32],
    unsafe: wp.array[wp.int32],
    # Out:
    smaller: wp.array[wp.float32],  # made smaller
):
    """Vertices around one whose α is small follow it, in outfits that are not safe yet."""
    m = wp.tid()
    if unsafe[pairs.outfit[m]] == 0:
        return
    face = pairs.faces[m]
    least = wp.min(share[face[0]], wp.min(share[face[1]], share[face[2]])) + SLOPE
    if least < 1.0:
        for i in range(3):
            wp.atomic_min(smaller, face[i], least)


@wp.kernel(enable_backward=False)
def place_kernel(
    # In:
    start: wp.array[wp.vec3],
    end: wp.array[wp.vec3],
    smaller: wp.array[wp.float32],
    # Out:
    share: wp.array[wp.float32],
    points: wp.array[wp.vec3],
):
    i = wp.tid()
    a = smaller[i]
    share[i] = a
    if a < 1.0:
        points[i] = start[i] + a * (end[i] - start[i])


@wp.kernel(enable_backward=False)
def unsafe_kernel(
    # Model:
    pairs: Pairs,
    # In:
    normal: wp.array2d[wp.vec3],
    start: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    # Out:
    held: wp.array[wp.int32],  # marked
):
    m = wp.tid()
    for k in range(kept_pairs(pairs, m)):
        n = normal[m, k]
        if wp.dot(n, n) > 0.0:
            if not is_safe(pairs, m, pairs.partners[m, k], n, start, points):
                held[pairs.outfit[m]] = 1


def safe_steps(
    contacts: Contacts,
    start: torch.Tensor,
    end: torch.Tensor,
    outfit_of_vertex: torch.Tensor,
    outfits: int,
    *,
    early_exit: bool = False,
) -> Steps:
    """Moves vertices as far as all pairs of faces stay apart; without gradients.

    Args:
        contacts: The pairs of the frame and their normals at the start.
        start: Positions C [m], float32 [V,3].
        end: Positions V [m], float32 [V,3], in the boxes for which the pairs were found.
        outfit_of_vertex: Outfit of each vertex, int32 [V]; -1 for vertices that nothing holds.
        outfits: Number of outfits O.
        early_exit: Whether the host looks if another round is needed, which makes no difference to the result.
    """
    device, members, model = start.device, len(contacts.pairs.outfits.faces), contacts.model
    share, smaller = allocate((2, len(start)), torch.float32, device)
    share.fill_(1.0)
    smaller.fill_(1.0)
    points = end.clone()
    held = torch.zeros(outfits, dtype=torch.int32, device=device)
    unsafe = torch.zeros((len(SHRINK), outfits), dtype=torch.int32, device=device)
    at_start, at_end, now = (as_argument(tensor, wp.vec3) for tensor in (start, end, points))
    old, new = as_argument(share, wp.float32), as_argument(smaller, wp.float32)
    normal = as_argument(contacts.normal, wp.vec3)
    with torch_stream(device) as warp_device:
        for shrink, failed in zip(SHRINK, unsafe, strict=True):
            failing = as_argument(failed, wp.int32)
            inputs = [model, shrink, normal, at_start, now, old]
            wp.launch(shrink_kernel, dim=members, inputs=inputs, outputs=[new, failing], device=warp_device)
            if early_exit and not failed.any():
                break
            share.copy_(smaller)
            wp.launch(spread_kernel, dim=members, inputs=[model, old, failing], outputs=[new], device=warp_device)
            inputs = [at_start, at_end, new]
            wp.launch(place_kernel, dim=len(start), inputs=inputs, outputs=[old, now], device=warp_device)
        inputs = [model, normal, at_start, now]
        wp.launch(unsafe_kernel, dim=members, inputs=inputs, outputs=[as_argument(held, wp.int32)], device=warp_device)
    stays = torch.cat([held > 0, held.new_zeros(1, dtype=torch.bool)])  # the last entry is that of outfit -1
    return Steps(torch.where(stays[outfit_of_vertex.long()][:, None], start, points), stays[:-1])
