"""Pairs of faces of an outfit that can meet within a frame: their boxes over the whole motion overlap.

A box holds a face at the start and at the end of the frame, and a margin on all sides. Every position that a vertex
takes within the frame lies in the boxes of its faces (apart.py sees to it), so faces that cross at any time are a pair.
Faces with a common vertex are none. One tree holds the boxes of the whole batch, grouped by outfit, so that outfits
at the same place do not see each other.
"""

from __future__ import annotations

import dataclasses

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, as_warp, expect, torch_stream
from warpgarment.kernels.operator import allocate

wp.set_module_options(compiling.options())

MARGIN = 0.006
"""How much larger boxes are than the motion, on each side [m]. Pushes beyond it are cut off."""
NOWHERE = wp.constant(1.0e18)
PARTNERS = 64
"""Room for partners of a face, each pair being kept by one of its two faces."""


@dataclasses.dataclass(frozen=True)
class Outfits:
    """Which faces of a batch meet each other. Members are the faces of garments that belong to an outfit."""

    faces: torch.Tensor  # int32 [M,3], packed vertex indices of the members
    garment: torch.Tensor  # int32 [M], garment of each member
    outfit: torch.Tensor  # int32 [M], outfit of each member
    rank: torch.Tensor  # int32 [B], place of each garment in its outfit, innermost 0; -1 for one in no outfit
    itself: bool = True  # whether a garment meets itself


@wp.kernel(enable_backward=False)
def boxes_kernel(
    # Model:
    faces: wp.array[wp.vec3i],
    garment: wp.array[wp.int32],
    margin: wp.float32,
    # In:
    start: wp.array[wp.vec3],
    end: wp.array[wp.vec3],
    moving: wp.array[wp.bool],
    # Out:
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
):
    m = wp.tid()
    low = wp.vec3(NOWHERE)
    high = -low
    if moving[garment[m]]:
        for k in range(3):
            i = faces[m][k]
            low = wp.min(low, wp.min(start[i], end[i]))
            high = wp.max(high, wp.max(start[i], end[i]))
        low -= wp.vec3(margin)
        high += wp.vec3(margin)
    lower[m] = low
    upper[m] = high


@wp.func
def share_a_vertex(a: wp.vec3i, b: wp.vec3i) -> bool:
    """Whether two faces have a common vertex."""
    found = False
    for i in range(3):
        for j in range(3):
            found = found or a[i] == b[j]
    return found


@wp.func
def keeps(m: int, o: int) -> bool:
    """Whether face m keeps its pair with face o, which it does for about half of them; else o does."""
    return m != o and (m < o) == ((m + o) % 2 == 0)


@wp.kernel(enable_backward=False)
def pairs_kernel(
    # Model:
    tree: wp.uint64,
    faces: wp.array[wp.vec3i],
    garment: wp.array[wp.int32],
    outfit: wp.array[wp.int32],
    itself: wp.bool,
    # In:
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    # Out:
    partners: wp.array2d[wp.int32],
    count: wp.array[wp.int32],
):
    """Partners of face m of which it keeps the pair; those beyond the room are counted, but not kept."""
    m = wp.tid()
    found = wp.int32(0)
    if lower[m][0] < NOWHERE:
        query = wp.bvh_query_aabb(tree, lower[m], upper[m], wp.bvh_get_group_root(tree, outfit[m]))
        other = wp.int32(0)
        while wp.bvh_query_next(query, other):
            if keeps(m, other) and (itself or garment[other] != garment[m]) and lower[other][0] < NOWHERE:
                if garment[other] != garment[m] or not share_a_vertex(faces[m], faces[other]):
                    if found < partners.shape[1]:
                        partners[m, found] = other
                    found += 1
    count[m] = found


class FacePairs:
    """Finds pairs of faces that can meet.

    Args:
        outfits: Which faces meet each other.
        vertices: Positions in the first frame [m], packed, float32 [V,3].
        partners: Room for partners of a face.
        margin: Margin of the boxes [m].

    Attributes:
        partners: Members with which each member forms a pair, int32 [M,K].
        count: Number of partners of each member, int32 [M]; those beyond K are not in `partners`.
    """

    def __init__(
        self, outfits: Outfits, vertices: torch.Tensor, *, partners: int = PARTNERS, margin: float = MARGIN
    ) -> None:
        self.outfits, self.margin, device = outfits, margin, vertices.device
        members = len(outfits.faces)
        self._lower, self._upper = allocate((2, members, 3), torch.float32, device)
        self.partners = allocate((members, partners), torch.int32, device)
        self.count = allocate((members,), torch.int32, device)
        self._box(vertices, vertices, torch.ones(len(outfits.rank), dtype=torch.bool, device=device))
        self._arrays = as_warp(self._lower, wp.vec3), as_warp(self._upper, wp.vec3), as_warp(outfits.outfit, wp.int32)
        with torch_stream(device):
            lower, upper, groups = self._arrays
            self._tree = wp.Bvh(lower, upper, groups=groups)

    def _box(self, start: torch.Tensor, end: torch.Tensor, moving: torch.Tensor) -> None:
        with torch_stream(start.device) as device:
            wp.launch(
                boxes_kernel,
                dim=len(self.outfits.faces),
                inputs=[
                    as_argument(self.outfits.faces, wp.vec3i),
                    as_argument(self.outfits.garment, wp.int32),
                    self.margin,
                    as_argument(start, wp.vec3),
                    as_argument(end, wp.vec3),
                    as_argument(moving, wp.bool),
                ],
                outputs=[as_argument(self._lower, wp.vec3), as_argument(self._upper, wp.vec3)],
                device=device,
            )

    def find(self, start: torch.Tensor, end: torch.Tensor, moving: torch.Tensor) -> None:
        """Fills `partners` and `count` for a frame; the host does not wait.

        Args:
            start: Positions at the start [m], float32 [V,3].
            end: Positions at the end [m], float32 [V,3].
            moving: Garments that are simulated, bool [B]; others form no pairs.
        """
        device = start.device
        expect("start", start, (None, 3))
        expect("end", end, (len(start), 3), device=device)
        expect("moving", moving, (len(self.outfits.rank),), torch.bool, device)
        self._box(start, end, moving)
        with torch_stream(device) as warp_device:
            self._tree.refit()
            wp.launch(
                pairs_kernel,
                dim=len(self.outfits.faces),
                inputs=[
                    self._tree.id,
                    as_argument(self.outfits.faces, wp.vec3i),
                    as_argument(self.outfits.garment, wp.int32),
                    as_argument(self.outfits.outfit, wp.int32),
                    self.outfits.itself,
                    as_argument(self._lower, wp.vec3),
                    as_argument(self._upper, wp.vec3),
                ],
                outputs=[as_argument(self.partners, wp.int32), as_argument(self.count, wp.int32)],
                device=warp_device,
            )
