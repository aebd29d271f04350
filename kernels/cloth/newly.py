"""Outfits whose faces cross at the start of a frame, although they did not in the last frame.

A start is the last frame moved by a smooth motion of space. Where it makes faces cross that were apart, another motion
has to be tried, which varies less.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, torch_stream

from .contacts import Contacts, Pairs, kept_pairs
from .triangles import corners, separating

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def newly_kernel(
    # Model:
    pairs: Pairs,
    # In:
    normal: wp.array2d[wp.vec3],
    before: wp.array[wp.vec3],
    # Out:
    crossing: wp.array[wp.int32],  # marked
):
    m = wp.tid()
    for k in range(kept_pairs(pairs, m)):
        n = normal[m, k]
        if wp.dot(n, n) == 0.0:
            face = pairs.faces[m]
            origin = before[face[0]]
            q = corners(before, pairs.faces[pairs.partners[m, k]], origin)
            apart = separating(corners(before, face, origin), q)
            if wp.dot(apart, apart) > 0.0:
                crossing[pairs.outfit[m]] = 1


def newly_crossing(contacts: Contacts, before: torch.Tensor, outfits: int) -> torch.Tensor:
    """Whether any pair crosses at the start that did not in the last frame, bool [O]; the host does not wait.

    Args:
        contacts: The pairs of the frame, with their normals at its start.
        before: Positions in the last frame [m], float32 [V,3].
        outfits: Number of outfits O.
    """
    crossing = torch.zeros(outfits, dtype=torch.int32, device=before.device)
    with torch_stream(before.device) as device:
        wp.launch(
            newly_kernel,
            dim=len(contacts.pairs.outfits.faces),
            inputs=[contacts.model, as_argument(contacts.normal, wp.vec3), as_argument(before, wp.vec3)],
            outputs=[as_argument(crossing, wp.int32)],
            device=device,
        )
    return crossing > 0
