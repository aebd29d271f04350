r"""Where garments would be if each vertex moved with the body around it: smooth linear blend skinning of any garment.

Points of a body, about `SPACING` apart, each take the vertices of the body nearest to it. They move rigidly: c_j is
their mean and R_j the rotation nearest to their covariance with the bound pose (Kabsch). A vertex X of a garment is
bound to the nearest of these points, with weights that fall smoothly to zero at the last of them:

    s(t) = Σ_j w_j (c_j(t) + R_j(t) (X - c_j(0))),    R(t) = the rotation nearest to Σ_j w_j R_j(t),
    w_j ~ (1 - d_j² / d_K²)²,    d_j = |X - c_j(0)|

In the bound pose s = X and R = I. Unlike the nearest face, the mean of several parts of the body varies slowly over the
cloth, so a skirt between two legs stays whole.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from warpgarment.kernels.deformation.replaced import rotation

SPACING = 0.08
"""Distance of the points of a body [m]."""
AROUND = 24  # body vertices that move with a point
BOUND = 12  # points to which a vertex of a garment is bound, the last without weight


@dataclass(frozen=True)
class Skin:
    """Garments of V vertices bound to bodies of U vertices by N points; made by `bind`.

    Attributes:
        around: Body vertices of each point, int64 [N,AROUND].
        shape: Where these are in the bound pose, relative to their mean [m], [N,AROUND,3].
        points: Points of each vertex, int64 [V,BOUND].
        offset: From each of these points to the vertex in the bound pose [m], [V,BOUND,3].
        weight: Their weights, which sum to one, [V,BOUND].
    """

    around: torch.Tensor
    shape: torch.Tensor
    points: torch.Tensor
    offset: torch.Tensor
    weight: torch.Tensor

    @torch.no_grad()
    def pose(self, body: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """How the points of the bodies have moved since the bound pose.

        Args:
            body: Bodies [m], in one pose or several, shape [...,U,3].

        Returns:
            Rotations R_j, [...,N,3,3], and means c_j [m], [...,N,3].
        """
        here = body[..., self.around, :]
        middle = here.mean(dim=-2)
        covariance = (here - middle[..., None, :]).mT @ self.shape.to(body.dtype)
        turn = rotation((covariance.float() * SCALE).reshape(-1, 3, 3)).to(body.dtype)
        return turn.view(covariance.shape), middle

    @torch.no_grad()
    def __call__(self, body: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Where poses of the bodies take the garments.

        Args:
            body: Bodies [m], in one pose or several, shape [...,U,3].

        Returns:
            Rotations R, [...,V,3,3], and positions s [m], [...,V,3]; without gradients.
        """
        turn, middle = self.pose(body)
        weight, offset = self.weight.to(body.dtype), self.offset.to(body.dtype)
        turns = turn[..., self.points, :, :]
        places = middle[..., self.points, :] + (turns @ offset[..., None])[..., 0]
        blended = (weight[..., None, None] * turns).sum(dim=-3)
        frame = rotation(blended.float().reshape(-1, 3, 3)).to(body.dtype).view(blended.shape)
        return frame, (weight[..., None] * places).sum(dim=-2)


SCALE = 1e3  # brings covariances, near 1e-3 m^2, to the size of deformation gradients


def bind(
    vertices: np.ndarray,
    body_of_vertex: np.ndarray,
    body: np.ndarray,
    body_offsets: Sequence[int],
    device: torch.device | str,
) -> Skin:
    """Binds garments to bodies in one pose.

    Args:
        vertices: Garments [m], shape [V,3].
        body_of_vertex: Body of each vertex, shape [V].
        body: Bodies in the same pose [m], shape [U,3].
        body_offsets: First vertex of each body, and U at the end.
        device: Device of the result.
    """
    from scipy.spatial import cKDTree  # where it is used: a rollout starts a tenth of a second earlier

    vertices, body = np.asarray(vertices, np.float64), np.asarray(body, np.float64)
    points, offset = np.zeros((len(vertices), BOUND), np.int64), np.zeros((len(vertices), BOUND, 3))
    weight, around, count = np.zeros((len(vertices), BOUND)), [], 0
    for number, (first, last) in enumerate(itertools.pairwise(body_offsets)):
        mine = np.flatnonzero(np.asarray(body_of_vertex) == number)
        part = body[first:last]
        _, near = cKDTree(part).query(part[_spread(part)], k=np.arange(1, AROUND + 1))
        near = np.where(near < len(part), near, near[:, :1])  # a body of fewer vertices
        centres = part[near].mean(axis=1)
        distance, chosen = cKDTree(centres).query(vertices[mine], k=np.arange(1, BOUND + 1))
        there = chosen < len(centres)
        chosen = np.where(there, chosen, 0)
        last_one = np.where(there, distance, 0.0).max(axis=1, keepdims=True) * (1.0 + 1e-6) + 1e-9
        share = np.where(there, 1.0 - np.minimum(distance / last_one, 1.0) ** 2, 0.0) ** 2
        share[:, 0] = np.maximum(share[:, 0], 1e-12)  # all points equally far
        points[mine], weight[mine] = chosen + count, share / share.sum(axis=1, keepdims=True)
        offset[mine] = vertices[mine, None] - centres[chosen]
        around.append(near + first)
        count += len(near)
    of_points = np.concatenate(around) if around else np.zeros((0, AROUND), np.int64)
    shape = body[of_points] - body[of_points].mean(axis=1, keepdims=True)

    def send(array: np.ndarray, kind: type) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, kind)).to(device)

    return Skin(
        send(of_points, np.int64),
        send(shape, np.float32),
        send(points, np.int64),
        send(offset, np.float32),
        send(weight, np.float32),
    )


def _spread(points: np.ndarray) -> np.ndarray:
    """Numbers of points such that every point is within `SPACING` of one, each farthest from those before it."""
    chosen = [0]  # not by a place, which would be another one where the body faces another way
    distance = np.linalg.norm(points - points[0], axis=1)
    while distance.max() > SPACING:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)
