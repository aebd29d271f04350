"""What garments are coloured by: distance to the body, stretch against rest, distance to a second result."""

from __future__ import annotations

from typing import Any

import numpy as np


def stretch(rest: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Largest stretch of each face against rest [%], float64 [F]: 100 (σ - 1), with σ the largest singular value.

    With D = [e1, e2] the edges of a face, F = D D_rest^+ maps its plane at rest to its plane now, and σ² is the largest
    eigenvalue of the 2 x 2 matrix R^-T (DᵀD) R^-1, where RᵀR = D_restᵀ D_rest. Faces without area at rest have NaN.

    Args:
        rest: Positions at rest [m], shape [V,3].
        vertices: Positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
    """
    aa, ab, bb = _products(rest, faces)
    AA, AB, BB = _products(vertices, faces)
    with np.errstate(divide="ignore", invalid="ignore"):
        # R = [[p, q], [0, s]]: the rest triangle in its own plane, with its first edge along x
        p = np.sqrt(aa)
        q = ab / p
        s = np.sqrt(np.maximum(bb - q * q, 0.0))
        c11, c12 = AA / aa, (AB - AA * q / p) / (p * s)
        c22 = (BB - 2 * AB * q / p + AA * (q / p) ** 2) / (s * s)
        half = 0.5 * (c11 + c22)
        largest = half + np.sqrt(np.maximum(0.25 * (c11 - c22) ** 2 + c12 * c12, 0.0))
        found = 100.0 * (np.sqrt(np.maximum(largest, 0.0)) - 1.0)
    return np.where(np.isfinite(found) & (s > 1e-9 * p), found, np.nan)


def _products(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """e1·e1, e1·e2 and e2·e2 of each face, float64 [F]."""
    corner = vertices.astype(np.float64)[faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return (first * first).sum(1), (first * second).sum(1), (second * second).sum(1)


def apart(vertices: np.ndarray, others: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mean distance of the corners of each face to the same vertices of another result [cm], float64 [F].

    Args:
        vertices: Positions [m], shape [V,3].
        others: Those of the other result [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
    """
    distance = np.linalg.norm(vertices.astype(np.float64) - others, axis=1)
    return 100.0 * distance[faces].mean(axis=1)


class BodyDistance:
    """Signed distance of garments to a moving body, whose search tree is made once and moved from frame to frame.

    Args:
        frames: Positions of the body [m], shape [T,U,3].
        faces: Vertex indices, shape [G,3], counter-clockwise seen from outside.
    """

    def __init__(self, frames: np.ndarray, faces: np.ndarray) -> None:
        self._frames, self._faces = frames, faces
        self._frame: int | None = None
        self._meshes: Any = None

    def at(self, frame: int, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Distance of the nearest, or deepest, corner of each face [mm], float64 [F]; negative inside the body.

        Args:
            frame: Frame of the body.
            vertices: Positions of the garment [m], shape [V,3].
            faces: Vertex indices, shape [F,3].
        """
        import torch

        from warpgarment.kernels.sdf import BodyMeshes

        if self._frame != frame:
            moved = torch.from_numpy(np.array(self._frames[frame], np.float32))
            if self._meshes is None:
                self._meshes = BodyMeshes(moved, torch.from_numpy(np.array(self._faces, np.int32)))
            else:
                self._meshes.update(moved)
            self._frame = frame
        points = torch.from_numpy(np.array(vertices, np.float32))
        distance = self._meshes.query(points).distance.numpy().astype(np.float64)
        return 1e3 * distance[faces].min(axis=1)
