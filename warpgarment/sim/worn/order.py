"""Warns of outfits whose garments are given in another order than they lie over each other at the start.

A vertex p of the garment that is given as the outer one, and the nearest point q of the one that is given as the inner:

    beneath:  (p - q) · n < 0  and  d(p) < d(q)        above:  (p - q) · n > 0  and  d(p) > d(q)

with d the signed distance to the body and n the normal at q, turned away from the body; so it does not matter how the
faces are wound. Points farther than `NEAR` from the inner garment, nearer than `TOUCHING`, or past its border, where
p - q is not along n, do not count.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import combinations

import torch

from warpgarment.kernels.sdf import BodyMeshes
from warpgarment.sim.scene import Scene

NEAR, TOUCHING = 0.04, 5e-4
"""Distances between garments [m] within which one is over or beneath the other."""
ALONG = 0.7  # least cosine between p - q and the normal
FEWEST, FEWEST_SHARE = 8, 0.02  # vertices that have to be near, as a number and as a share of the garment's
WRONG = 0.5
"""Share of the vertices, beneath, from which the order is wrong."""


def warn_of_wrong_order(
    scene: Scene, vertices: torch.Tensor, body: torch.Tensor, layers: Sequence[Sequence[int]]
) -> None:
    """Warns by name of garments that lie beneath what they are said to be worn over.

    Args:
        scene: The garments that are simulated, and their bodies.
        vertices: Garments in the first frame [m], packed, shape [V,3].
        body: Bodies in the first frame [m], packed, shape [U,3].
        layers: Garments of each outfit, innermost first.

    Warns:
        RuntimeWarning: More than half of where two garments lie over each other.
    """
    pairs = [pair for outfit in layers for pair in combinations(outfit, 2)]
    if not pairs:
        return
    garments, packed = scene.garments, scene.packed
    offsets, device = packed.vertex_offsets, vertices.device
    counts = [offsets[outer + 1] - offsets[outer] for _, outer in pairs]
    points = torch.cat([vertices[offsets[outer] : offsets[outer + 1]] for _, outer in pairs])
    inner = torch.tensor([k for k, _ in pairs], dtype=torch.int32, device=device)
    inner = inner.repeat_interleave(torch.tensor(counts, device=device))
    sheets = BodyMeshes(vertices, packed.faces, offsets, packed.face_offsets)
    near = sheets.query(points, inner)
    found = near.face >= 0
    face = packed.faces[near.face.clamp(min=0).long()].long()
    corners = vertices[face]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)

    closest = torch.where(found[:, None], near.closest, points)
    on = scene.packed_bodies.body_of_garment[inner.long()]
    at = scene.bodies.at(body)
    below, height = at.query(closest, on), at.query(points, on).distance
    away = (closest - below.closest) * torch.sign(below.distance)[:, None]
    normal = normal * torch.sign((normal * away).sum(dim=1, keepdim=True))
    apart = points - closest
    side, length = (apart * normal).sum(dim=1), apart.norm(dim=1)
    counted = found & (length <= NEAR) & (length >= TOUCHING) & (side.abs() >= ALONG * length)
    beneath = (counted & (side < 0) & (height < below.distance)).split(counts)
    above = (counted & (side > 0) & (height > below.distance)).split(counts)
    for number, (lower, upper) in enumerate(pairs):
        under, over = int(beneath[number].sum()), int(above[number].sum())
        enough = under + over >= max(FEWEST, FEWEST_SHARE * counts[number])
        if enough and under > WRONG * (under + over):
            names = [garments[k].name or f"garment {k}" for k in (lower, upper)]
            warnings.warn(
                f"{names[1]} is given over {names[0]}, but lies beneath it at the start: {under:,} of the "
                f"{under + over:,} vertices where they are over each other ({under / (under + over):.0%}). Garments "
                f"stay in the order in which they start; give them innermost first, {names[1]} before {names[0]}",
                RuntimeWarning,
                stacklevel=5,
            )
