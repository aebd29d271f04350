"""Which of two garments lies over the other.

A vertex p of the garment that is meant to be the outer one, and the nearest point q of the inner one:

    beneath:  (p - q) · n < 0  and  d(p) < d(q)        above:  (p - q) · n > 0  and  d(p) > d(q)

with d the signed distance to the body and n the normal at q, turned away from the body; so it does not matter how the
faces are wound. Points farther than `NEAR` from the inner garment, nearer than `TOUCHING`, or past its border, where
p - q is not along n, do not count.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from warpgarment.kernels.sdf import BodyMeshes

NEAR, TOUCHING = 0.04, 5e-4
"""Distances between garments [m] within which one is over or beneath the other."""
ALONG = 0.7  # least cosine between p - q and the normal
FEWEST, FEWEST_SHARE = 8, 0.02  # vertices that have to be near, as a number and as a share of the garment's
WRONG = 0.5
"""Share of the vertices, beneath, from which the order is wrong."""


class Sides(NamedTuple):
    """Where points of outer garments are."""

    beneath: torch.Tensor
    """Whether a point is beneath the inner garment, bool [N]."""
    above: torch.Tensor
    """Whether it is above, bool [N]."""


def sides_of(
    points: torch.Tensor, inner: torch.Tensor, sheets: BodyMeshes, bodies: BodyMeshes, body: torch.Tensor
) -> Sides:
    """Tells on which side of an inner garment points are.

    Args:
        points: Vertices of outer garments [m], float32 [N,3].
        inner: Number of the inner garment of each point among `sheets`, int32 [N].
        sheets: The garments, as meshes.
        bodies: The bodies.
        body: Number of the body of each point, int32 [N].
    """
    near = sheets.query(points, inner)
    found = near.face >= 0
    corners = sheets.vertices[sheets.faces[near.face.clamp(min=0).long()].long()]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)
    closest = torch.where(found[:, None], near.closest, points)
    below, height = bodies.query(closest, body), bodies.query(points, body).distance
    away = (closest - below.closest) * torch.sign(below.distance)[:, None]
    normal = normal * torch.sign((normal * away).sum(dim=1, keepdim=True))
    apart = points - closest
    side, length = (apart * normal).sum(dim=1), apart.norm(dim=1)
    counted = found & (length <= NEAR) & (length >= TOUCHING) & (side.abs() >= ALONG * length)
    return Sides(
        counted & (side < 0) & (height < below.distance),
        counted & (side > 0) & (height > below.distance),
    )


def is_wrong(beneath: int, above: int, count: int) -> bool:
    """Whether a garment of `count` vertices lies beneath what it should be over, from the numbers of `sides_of`."""
    return beneath + above >= max(FEWEST, FEWEST_SHARE * count) and beneath > WRONG * (beneath + above)
