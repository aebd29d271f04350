"""Garments that a body wears already, carried along while it is thin and grows in the next one.

Each vertex stays at its place relative to the body around it, turned as that turns on the way to the garment's pose,
and drawn to it as the body becomes thin:

    x(k) = b(k) + s(k) R (x - b),    s(k) = 1 - (1 - `LEAST`) k / (K - 1)

so that they grow with the body in the garment that comes over them.

| symbol | code | what |
| --- | --- | --- |
| b, b(k) | `_middle` | mean of the vertices of the body around a vertex: now, and of the k-th of K thin bodies [m] |
| R | in `_turned` | rotation that carries those vertices to the garment's pose best (Kabsch 1976) |
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

AROUND = 12
"""Vertices of the body that carry a vertex."""
LEAST = 0.1
"""Share of the distances to the thinnest body that is left."""


class Beneath:
    """Garments that the body wears already.

    Args:
        points: Their positions on the body [m], packed, [V,3].
        faces: Vertex indices, [F,3].
        body: Positions of the body [m], [U,3].
    """

    def __init__(self, points: np.ndarray, faces: np.ndarray, body: np.ndarray) -> None:
        self.points, self.faces = points, faces
        self._around = cKDTree(body).query(points, k=AROUND)[1]
        self._body = body[self._around]
        self._middle = self._body.mean(axis=1)

    def _turned(self, body: np.ndarray) -> np.ndarray:
        """Offsets from the body, turned with it [m], [V,3]; `body` are its positions [m], [U,3]."""
        there = body[self._around]
        both = np.einsum("vki,vkj->vij", there - there.mean(axis=1, keepdims=True), self._body - self._middle[:, None])
        u, _, v = np.linalg.svd(both)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ v))[:, None]
        return np.einsum("vij,vj->vi", u @ v, self.points - self._middle)

    def thin(self, posed: np.ndarray, thin: np.ndarray, share: float) -> np.ndarray:
        """Positions on a thin body [m], [V,3].

        Args:
            posed: The body in the garment's pose [m], [U,3].
            thin: The same, thinned [m], [U,3].
            share: How thin, from 0 to 1.
        """
        return thin[self._around].mean(axis=1) + (1.0 - (1.0 - LEAST) * share) * self._turned(posed)

    def at(self, posed: np.ndarray) -> np.ndarray:
        """Positions on a body in another pose [m], [V,3]; `posed` are its positions [m], [U,3]."""
        return posed[self._around].mean(axis=1) + self._turned(posed)
