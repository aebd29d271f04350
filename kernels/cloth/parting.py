r"""Parts pairs of faces that pushes have left too close, so that little of the frame's motion has to be given up.

Pushes (contacts.py) keep those two points of a pair apart that were nearest at the start. Faces that turn against each
other can still cross beside these points. A pair that is not safe (steps.py) is therefore parted by two planes across
the direction n that separates it at the start C:

    d = h - g(n) > 0,    h = min(2 SAFE, g_C(n)),
    n·a_i >= min_i n·a_i + d s_A / (s_A + s_B),    n·b_j <= max_j n·b_j - d s_B / (s_A + s_B)

Every corner beyond its plane is moved to it along n. Where all corners arrive, n separates the pair at the start and at
the end, and it is safe. A vertex moves by the mean of what its pairs ask, in which larger moves count more, in several
rounds; pairs that have become safe ask for nothing. Outfits of which every pair is safe are left alone.

| symbol | code | what |
| --- | --- | --- |
| C | `start` | positions [m] |
| n | `normal` | of each pair at C (contacts.py); zero for pairs that cross there |
| d | `missing` | what is missing of the gap h [m] |
| s | `share_of` | how readily a side moves |
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, torch_stream

from .contacts import Contacts, Pairs, add_push, kept_pairs, move_kernel, share_of
from .steps import SAFE, is_safe
from .triangles import corners, gap_along

wp.set_module_options(compiling.options())

ONE_MOVE = wp.constant(0.004)
"""Length [m] of a move that has the weight 1; others have one in proportion, up to `MOST`."""
MOST = wp.constant(4.0)


@wp.kernel(enable_backward=False)
def part_kernel(
    # Model:
    pairs: Pairs,
    # In:
    normal: wp.array2d[wp.vec3],
    start: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    before: wp.array[wp.int32],  # outfits that were not safe a round before
    # Out:
    sums: wp.array2d[wp.int32],  # accumulated
    unsafe: wp.array[wp.int32],  # marked, of each outfit
):
    m = wp.tid()
    if before[pairs.outfit[m]] == 0:
        return
    face = pairs.faces[m]
    for k in range(kept_pairs(pairs, m)):
        n = normal[m, k]
        if wp.dot(n, n) > 0.0:
            o = pairs.partners[m, k]
            if not is_safe(pairs, m, o, n, start, points):
                unsafe[pairs.outfit[m]] = 1
                other = pairs.faces[o]
                origin = points[face[0]]
                p = corners(points, face, origin)
                q = corners(points, other, origin)
                first = start[face[0]]
                kept = gap_along(corners(start, face, first), corners(start, other, first), n)
                missing = wp.min(2.0 * SAFE, kept) - gap_along(p, q, n)
                here = share_of(pairs, m, o)
                there = share_of(pairs, o, m)
                heights = p * n
                depths = q * n
                above = wp.min(heights) + missing * here / (here + there)
                below = wp.max(depths) - missing * there / (here + there)
                for i in range(3):
                    up = above - heights[i]
                    down = depths[i] - below
                    if up > 0.0:
                        add_push(sums, face[i], wp.min(up / ONE_MOVE, MOST), up * n)
                    if down > 0.0:
                        add_push(sums, other[i], wp.min(down / ONE_MOVE, MOST), -down * n)


def parted(
    contacts: Contacts,
    start: torch.Tensor,
    end: torch.Tensor,
    points: torch.Tensor,
    outfits: int,
    *,
    rounds: int,
    early_exit: bool = False,
) -> torch.Tensor:
    """Positions in which as many pairs as possible are safe [m], float32 [V,3]; without gradients.

    Args:
        contacts: The pairs of the frame and their normals at the start.
        start: Positions C [m], float32 [V,3].
        end: Positions at the end of the frame [m], float32 [V,3], in whose boxes with those of the start vertices stay.
        points: The end with pushes [m], float32 [V,3]; not changed.
        outfits: Number of outfits O.
        rounds: Number of rounds.
        early_exit: Whether the host looks if another round is needed, which makes no difference to the result.
    """
    device, members = start.device, len(contacts.pairs.outfits.faces)
    moved = points.clone()
    unsafe = torch.zeros((rounds + 1, outfits), dtype=torch.int32, device=device)
    unsafe[0] = 1
    flags = [as_argument(row, wp.int32) for row in unsafe]
    normal, now, at_start, at_end = (as_argument(t, wp.vec3) for t in (contacts.normal, moved, start, end))
    sums = as_argument(contacts.sums, wp.int32)
    with torch_stream(device) as warp_device:
        for number in range(rounds):
            inputs = [contacts.model, normal, at_start, now, flags[number]]
            outputs = [sums, flags[number + 1]]
            wp.launch(part_kernel, dim=members, inputs=inputs, outputs=outputs, device=warp_device)
            if early_exit and not unsafe[number + 1].any():
                break
            inputs = [contacts.pairs.margin, at_start, at_end]
            wp.launch(move_kernel, dim=len(moved), inputs=inputs, outputs=[now, sums], device=warp_device)
    return moved
