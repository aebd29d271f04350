r"""Pushes garments that come too close in a frame back to the sides on which they were at its start.

For every pair of faces (pairs.py), a unit vector n separates the two at the start of the frame. If the end of the frame
leaves a gap of at least h along it, nothing has to be done. Otherwise n is the direction between the nearest points at
the start, Σ u_i a_i and Σ v_j b_j, and these points are kept apart at the end:

    c = h - n·(Σ_i u_i a_i - Σ_j v_j b_j) > 0:
    Δa_i = s_A u_i λ n,    Δb_j = -s_B v_j λ n,    λ = c / (s_A Σ u_i² + s_B Σ v_j²)

Layers that cross at the start are pushed by their order instead, the outer one along the normals of both faces.

Every vertex moves by the mean of what its pairs ask, weighted by u or v, in several rounds. Sums are integers in units
of 2^-22 m, so that they do not depend on their order. The inner one of two layers gives way less, as the body is
behind it.

| symbol | code | what |
| --- | --- | --- |
| n | `normal` | of each pair, from the partner to the face; zero where the two cross at the start |
| u, v | `weights_p`, `weights_q` | barycentric coordinates; zero where the pair asks for nothing |
| h | `thickness` | distance to keep [m] |
| s | `share_of` | how readily a side moves |
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, as_warp, torch_stream
from warpgarment.kernels.operator import allocate

from .pairs import FacePairs
from .triangles import TOUCHING, corners, gap_along, nearest_points

wp.set_module_options(compiling.options())

UNIT = wp.constant(2.0**22)
"""Units of the sums in a metre."""
INNER = wp.constant(0.3)
"""s of the inner one of two layers; that of the outer one is 1."""
LIFT = wp.constant(0.003)
"""Most that one round of pushes moves layers apart that cross [m]."""
SAFE_AGAIN = wp.constant(5.0e-4)
"""Gap to which they are moved [m]."""
INSIDE = wp.constant(0.9)
"""Share of the margin of the boxes (pairs.py) that pushes may use."""


@wp.struct
class Pairs:
    """The pairs of a frame as an argument of kernels: face m with the faces `partners[m, :count[m]]`."""

    faces: wp.array[wp.vec3i]  # packed vertex indices
    garment: wp.array[wp.int32]  # of each face
    outfit: wp.array[wp.int32]  # of each face
    rank: wp.array[wp.int32]  # of each garment
    partners: wp.array2d[wp.int32]
    count: wp.array[wp.int32]  # may be more than there is room for


@wp.func
def kept_pairs(pairs: Pairs, m: int) -> int:
    """Number of partners of a face for which there was room."""
    return wp.min(pairs.count[m], pairs.partners.shape[1])


@wp.func
def share_of(pairs: Pairs, m: int, o: int) -> float:
    """s of face m in its pair with face o."""
    return wp.where(pairs.rank[pairs.garment[m]] < pairs.rank[pairs.garment[o]], INNER, 1.0)


@wp.func
def clear_axis(p: wp.mat33, q: wp.mat33, p_end: wp.mat33, q_end: wp.mat33, axis: wp.vec3, thickness: float):
    """The axis, signed so that it separates two triangles at the start and by `thickness` at the end; or zero."""
    length = wp.length(axis)
    found = wp.vec3()
    if length > 0.0:
        n = axis / length
        if gap_along(p, q, n) > TOUCHING and gap_along(p_end, q_end, n) > thickness:
            found = n
        elif gap_along(p, q, -n) > TOUCHING and gap_along(p_end, q_end, -n) > thickness:
            found = -n
    return found


@wp.kernel(enable_backward=False)
def directions_kernel(
    # Model:
    pairs: Pairs,
    thickness: wp.float32,
    # In:
    start: wp.array[wp.vec3],
    end: wp.array[wp.vec3],
    # Out:
    normal: wp.array2d[wp.vec3],
    weights_p: wp.array2d[wp.vec3],
    weights_q: wp.array2d[wp.vec3],
):
    m = wp.tid()
    face = pairs.faces[m]
    first = start[face[0]]
    last = end[face[0]]
    p = corners(start, face, first)
    p_end = corners(end, face, last)
    across = wp.cross(p[1], p[2])
    for k in range(kept_pairs(pairs, m)):
        other = pairs.faces[pairs.partners[m, k]]
        q = corners(start, other, first)
        q_end = corners(end, other, last)
        u = wp.vec3()
        v = wp.vec3()
        n = clear_axis(p, q, p_end, q_end, across, thickness)
        if wp.dot(n, n) == 0.0:
            n = clear_axis(p, q, p_end, q_end, wp.cross(q[1] - q[0], q[2] - q[0]), thickness)
        if wp.dot(n, n) == 0.0:
            n = clear_axis(p, q, p_end, q_end, p[0] + p[1] + p[2] - q[0] - q[1] - q[2], thickness)
        if wp.dot(n, n) == 0.0:
            near = nearest_points(p, q)
            if near.squared > wp.float64(TOUCHING * TOUCHING):
                n = wp.vec3(near.way / wp.sqrt(near.squared))
                if gap_along(p, q, n) > TOUCHING:
                    u = wp.vec3(near.weights_p)
                    v = wp.vec3(near.weights_q)
                else:
                    n = wp.vec3()
        normal[m, k] = n
        weights_p[m, k] = u
        weights_q[m, k] = v


@wp.func
def add_push(sums: wp.array2d[wp.int32], i: int, weight: float, push: wp.vec3):
    for k in range(3):
        wp.atomic_add(sums, i, k, wp.int32(wp.round(UNIT * weight * push[k])))
    wp.atomic_add(sums, i, 3, wp.int32(wp.round(UNIT * weight)))


@wp.func
def outwards(p: wp.mat33, q: wp.mat33, above: int) -> wp.vec3:
    """Unit vector from an inner to an outer layer, by the normals of both faces; `above` tells which one is which."""
    n = wp.normalize(wp.cross(p[1] - p[0], p[2] - p[0])) + wp.normalize(wp.cross(q[1] - q[0], q[2] - q[0]))
    return wp.normalize(wp.where(above > 0, n, -n))


@wp.kernel(enable_backward=False)
def push_kernel(
    # Model:
    pairs: Pairs,
    thickness: wp.float32,
    # In:
    normal: wp.array2d[wp.vec3],
    weights_p: wp.array2d[wp.vec3],
    weights_q: wp.array2d[wp.vec3],
    points: wp.array[wp.vec3],
    # Out:
    sums: wp.array2d[wp.int32],  # accumulated
):
    m = wp.tid()
    face = pairs.faces[m]
    first = points[face[0]]
    p = corners(points, face, first)
    for k in range(kept_pairs(pairs, m)):
        o = pairs.partners[m, k]
        other = pairs.faces[o]
        u = weights_p[m, k]
        v = weights_q[m, k]
        n = normal[m, k]
        above = pairs.rank[pairs.garment[m]] - pairs.rank[pairs.garment[o]]
        crossing = above != 0 and wp.dot(n, n) == 0.0
        if crossing or wp.dot(u, u) > 0.0:
            q = corners(points, other, first)
            missing = wp.float32(0.0)
            if crossing:
                n = outwards(p, q, above)
                u = wp.vec3(1.0 / 3.0)
                v = u
                missing = wp.min(TOUCHING + SAFE_AGAIN - gap_along(p, q, n), LIFT)
            else:
                missing = thickness - wp.dot(n, wp.transpose(p) * u - wp.transpose(q) * v)
            if missing > 0.0:
                here = share_of(pairs, m, o)
                there = share_of(pairs, o, m)
                amount = missing / (here * wp.dot(u, u) + there * wp.dot(v, v))
                for i in range(3):
                    if u[i] > 0.0:
                        add_push(sums, face[i], u[i], here * u[i] * amount * n)
                    if v[i] > 0.0:
                        add_push(sums, other[i], v[i], -there * v[i] * amount * n)


@wp.kernel(enable_backward=False)
def move_kernel(
    # Model:
    margin: wp.float32,
    # In:
    start: wp.array[wp.vec3],
    end: wp.array[wp.vec3],
    # Out:
    points: wp.array[wp.vec3],  # changed in place
    sums: wp.array2d[wp.int32],  # cleared
):
    i = wp.tid()
    weight = wp.float32(sums[i, 3])
    if weight > 0.0:
        push = wp.vec3(wp.float32(sums[i, 0]), wp.float32(sums[i, 1]), wp.float32(sums[i, 2])) / weight
        room = wp.vec3(INSIDE * margin)
        moved = points[i] + push
        points[i] = wp.min(wp.max(moved, wp.min(start[i], end[i]) - room), wp.max(start[i], end[i]) + room)
        for k in range(4):
            sums[i, k] = 0


class Contacts:
    """Directions of the pairs of a frame, and pushes along them.

    Args:
        pairs: The pairs.
        vertex_count: Number of vertices V of the batch.
        thickness: Distance to keep [m].
        rounds: Number of rounds of pushes.

    Attributes:
        model: The pairs as an argument of kernels.
        normal, weights_p, weights_q: float32 [M,K,3], see above.
        sums: Pushes of each vertex, times their weights, and the weights, int32 [V,4] in units of `UNIT`; zero outside
            of a round.
    """

    def __init__(self, pairs: FacePairs, vertex_count: int, *, thickness: float, rounds: int) -> None:
        self.pairs, self.thickness, self.rounds = pairs, thickness, rounds
        device = pairs.partners.device
        self.normal, self.weights_p, self.weights_q = allocate((3, *pairs.partners.shape, 3), torch.float32, device)
        self.sums = torch.zeros((vertex_count, 4), dtype=torch.int32, device=device)
        outfits = pairs.outfits
        self.model = Pairs()
        for name, tensor, kind in (
            ("faces", outfits.faces, wp.vec3i),
            ("garment", outfits.garment, wp.int32),
            ("outfit", outfits.outfit, wp.int32),
            ("rank", outfits.rank, wp.int32),
            ("partners", pairs.partners, wp.int32),
            ("count", pairs.count, wp.int32),
        ):
            setattr(self.model, name, as_warp(tensor, kind))

    def find(self, start: torch.Tensor, end: torch.Tensor) -> None:
        """Finds the directions of the pairs of a frame.

        Args:
            start: Positions at the start of the frame [m], float32 [V,3], for which pairs were found.
            end: Positions at its end [m], float32 [V,3].
        """
        with torch_stream(start.device) as device:
            wp.launch(
                directions_kernel,
                dim=len(self.pairs.outfits.faces),
                inputs=[self.model, self.thickness, as_argument(start, wp.vec3), as_argument(end, wp.vec3)],
                outputs=[as_argument(tensor, wp.vec3) for tensor in (self.normal, self.weights_p, self.weights_q)],
                device=device,
            )

    def pushed(self, start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
        """The end with pushes along the directions of `find` [m], float32 [V,3]; the arguments are the same."""
        device, members = start.device, len(self.pairs.outfits.faces)
        points = end.clone()
        at_start, at_end, moved = (as_argument(tensor, wp.vec3) for tensor in (start, end, points))
        found = [as_argument(tensor, wp.vec3) for tensor in (self.normal, self.weights_p, self.weights_q)]
        sums = as_argument(self.sums, wp.int32)
        with torch_stream(device) as warp_device:
            for _ in range(self.rounds):
                wp.launch(
                    push_kernel,
                    dim=members,
                    inputs=[self.model, self.thickness, *found, moved],
                    outputs=[sums],
                    device=warp_device,
                )
                wp.launch(
                    move_kernel,
                    dim=len(points),
                    inputs=[self.pairs.margin, at_start, at_end],
                    outputs=[moved, sums],
                    device=warp_device,
                )
        return points
