r"""Rotations of space, and the rotations of hidden vectors that stand for them.

**Frames.** R turns a direction d to a fixed one, up for body normals and for wind, down for gravity, the shortest way:

    R = I + [v]_x + [v]_x^2 / (1 + c),      v = d x e,  c = d . e

It jumps where d is opposite to e, and nowhere else. Without a direction (no wind), R is the identity.

**Hidden vectors** of a head of width w are turned by

    R_h = Q (R (+) R (+) ... (+) R (+) 1) Q^T        "orthogonal": Q a product of w reflections, so R_h is a rotation,
                                                     and R -> R_h keeps products
    R_h = W R W^T,  W  w x 3                         "published": rank 3, a rotation only if W^T W = I

so that a function f(x) = R_h^T g(R_h x) turns with its input: f(G_h x) = G_h f(x) where R becomes R G^T. With the
published form that holds only on a space of three dimensions, and all else is lost.
"""

from __future__ import annotations

import torch
from torch import nn

OPPOSITE = 1e-4  # of 1 + c, below which a half turn about x is taken
SHORTEST = 1e-12  # of a squared length; a shorter vector has no direction


def unit(vectors: torch.Tensor) -> torch.Tensor:
    """Unit vectors [...,3]; zero stays zero."""
    squared = vectors.square().sum(-1, keepdim=True)
    return vectors * torch.where(squared > SHORTEST, squared, 1.0).rsqrt() * (squared > SHORTEST)


def frames(directions: torch.Tensor, height: float = 1.0) -> torch.Tensor:
    """Rotations R [...,3,3] that turn directions [...,3] to (0, height, 0) with height 1 or -1; identity for zero."""
    d = unit(directions)
    x, y, z = d.unbind(-1)
    zero, c = torch.zeros_like(x), y * height
    # [v]_x with v = d x e = (-z, 0, x) * height
    rows = [zero, -x, zero, x, zero, z, zero, -z, zero]
    cross = height * torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=d.dtype, device=d.device)
    near = (1.0 + c) > OPPOSITE
    turned = eye + cross + cross @ cross / torch.where(near, 1.0 + c, 1.0)[..., None, None]
    half = -eye
    half[0, 0] = 1.0  # a kernel, no copy from the host
    turned = torch.where(near[..., None, None], turned, half)
    return torch.where((d == 0.0).all(-1)[..., None, None], eye, turned)


def quaternions(directions: torch.Tensor) -> torch.Tensor:
    """The same rotations to up as unit quaternions (w, x, y, z) with w >= 0, [...,3] -> [...,4]."""
    d = unit(directions)
    x, y, z = d.unbind(-1)
    near = (1.0 + y) > OPPOSITE
    w = torch.where(near, 1.0 + y, 0.0)
    zero = torch.zeros_like(x)
    found = torch.stack([w, torch.where(near, -z, 1.0), zero, torch.where(near, x, 0.0)], dim=-1)
    found = found / found.square().sum(-1, keepdim=True).sqrt()
    rest = torch.zeros(4, dtype=d.dtype, device=d.device)
    rest[0] = 1.0
    return torch.where((d == 0.0).all(-1, keepdim=True), rest, found)


def turned(inner: torch.Tensor, rotation: torch.Tensor, triples: int, *, inverse: bool = False) -> torch.Tensor:
    """R applied to some triples of numbers in each row, which lie as in `Bases.matrix`: all x, all y, all z, the rest.

    Args:
        inner: Rows [N,K].
        rotation: Rotations R, shape [N,3,3].
        triples: Number of triples; further numbers of a row stay.
        inverse: Whether to turn back.
    """
    part = inner[:, : 3 * triples].unflatten(1, (3, triples))
    rotation = rotation.mT if inverse else rotation
    x, y, z = part.unbind(1)
    r = rotation[..., None]  # much faster than products of matrices of 3 x 3
    rows = [x * r[:, j, 0] + y * r[:, j, 1] + z * r[:, j, 2] for j in range(3)]
    return torch.cat([*rows, inner[:, 3 * triples :]], dim=1)


class Bases(nn.Module):
    """The bases Q, or W, of some heads.

    Args:
        count: Number of heads.
        width: Width of a head.
        kind: "orthogonal" or "published", see the top of this file.
    """

    def __init__(self, count: int, width: int, kind: str) -> None:
        super().__init__()
        self.orthogonal = kind == "orthogonal"
        inner = width if self.orthogonal else 3
        self.triples = inner // 3  # of a head
        shape = (count, width, width) if self.orthogonal else (count, width, 3)
        self.weight = nn.Parameter(torch.randn(shape) / width**0.5)

    def forward(self) -> torch.Tensor:
        """The bases, shape [count,width,width] or [count,width,3]."""
        if not self.orthogonal:
            return self.weight
        axes = nn.functional.normalize(self.weight, dim=-1)
        eye = torch.eye(axes.shape[-1], dtype=axes.dtype, device=axes.device)
        basis = eye.expand(axes.shape)
        for axis in axes.unbind(1):  # Q (I - 2 u u^T)
            basis = basis - 2.0 * (basis @ axis[..., None]) @ axis[:, None, :]
        return basis

    def matrix(self, bases: torch.Tensor) -> torch.Tensor:
        """The bases of some heads as one matrix [H*w,K], by which rows of all heads are multiplied.

        Its columns are sorted as `turned` expects it, by x, y and z of all triples of all heads, and then the rest.

        Args:
            bases: Some rows of the result of `forward`, shape [H,w,k].
        """
        heads, width = bases.shape[:2]
        eye = torch.eye(heads, dtype=bases.dtype, device=bases.device)
        blocks = bases[:, :, None, :] * eye[:, None, :, None]  # [H,w,H,k]
        whole = 3 * self.triples
        turning = blocks[..., :whole].unflatten(-1, (self.triples, 3)).permute(0, 1, 4, 2, 3)
        parts = [turning.reshape(heads * width, -1), blocks[..., whole:].reshape(heads * width, -1)]
        return torch.cat(parts, dim=1)

    def penalty(self) -> torch.Tensor:
        """Mean square of W W^T - I, a scalar, which the publication adds to its loss and no W can make zero."""
        basis = self()
        eye = torch.eye(basis.shape[1], dtype=basis.dtype, device=basis.device)
        return (basis @ basis.mT - eye).square().mean()
