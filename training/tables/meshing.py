"""A garment with another number of faces, and its positions from those of the original garment.

The garment is remeshed at rest. Each new vertex keeps its barycentric coordinates on the old triangle below it, which
carries it in all frames in which the old mesh is known: the first frames of a recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from warpgarment.geometry.cutting import remeshed
from warpgarment.objects.garment import Garment


class NotRemeshable(ValueError):
    """A garment that cannot be compared over resolutions; the message has the reason."""


@dataclass(frozen=True)
class Remeshed:
    """A remeshed garment, and the places of its vertices on the original one.

    Attributes:
        garment: Garment with about the wanted number of faces.
        corners: Vertices of the old triangle that holds each new vertex, int [V,3].
        weights: Barycentric coordinates of the new vertex on it, [V,3].
    """

    garment: Garment
    corners: np.ndarray
    weights: np.ndarray

    def carried(self, vertices: np.ndarray) -> np.ndarray:
        """Positions of the new mesh from those of the old one, both [m], [T,V,3] or [V,3]; float32."""
        corners = np.asarray(vertices, np.float64)[..., self.corners, :]
        return np.einsum("vk,...vkc->...vc", self.weights, corners).astype(np.float32)


def remesh(garment: Garment, faces: int) -> Remeshed:
    """Remeshes a garment isotropically; vertices with most of their weight on old pins become pins.

    Args:
        garment: Garment of one connected sheet.
        faces: Wanted number of faces.

    Raises:
        NotRemeshable: The garment has several pieces, or cuts whose sides lie on each other at rest.
        MissingExtra: gpytoolbox is not installed.
    """
    if garment.components[2] > 1:
        raise NotRemeshable(f"{garment.components[2]} pieces; one connected garment is needed")
    rest = garment.vertices.astype(np.float64)
    if len(np.unique(rest, axis=0)) < len(rest):
        raise NotRemeshable("vertices lie on each other at rest (seam cuts), so that neither side can be told")
    old = garment.faces.astype(np.int64)
    vertices, triangles, _ = remeshed(rest, old, faces)
    _, nearest, closest = igl.point_mesh_squared_distance(vertices, rest, old)
    corners = old[nearest]
    weights = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(rest[corners[:, k]]) for k in range(3)))
    weights = np.clip(np.reshape(weights, (-1, 3)), 0.0, 1.0)
    weights /= weights.sum(axis=1, keepdims=True)
    pinned = np.isin(corners, garment.pins)
    pins = np.flatnonzero((weights * pinned).sum(axis=1) > 0.5)
    new = Garment(vertices.astype(np.float32), triangles.astype(np.int32), pins=pins, name=garment.name)
    return Remeshed(new, corners, weights)


def surface_distance(a: np.ndarray, faces_a: np.ndarray, b: np.ndarray, faces_b: np.ndarray) -> float:
    """Symmetric mean distance between two surfaces [m].

    The mean of the two directed means, each over the vertices of one surface, weighted by their share of its area, of
    the distance to the nearest point of the other surface (libigl).

    Args:
        a, b: Vertices [m], shapes [V,3] and [W,3].
        faces_a, faces_b: Vertex indices, shapes [F,3] and [G,3].

    Returns:
        The distance [m]; NaN if a position is not finite.
    """
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return float("nan")
    return 0.5 * (_directed(a, faces_a, b, faces_b) + _directed(b, faces_b, a, faces_a))


def _directed(a: np.ndarray, faces_a: np.ndarray, b: np.ndarray, faces_b: np.ndarray) -> float:
    a, b = np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b, np.float64)
    faces_a, faces_b = np.asarray(faces_a, np.int64), np.asarray(faces_b, np.int64)
    squared, _, _ = igl.point_mesh_squared_distance(a, b, faces_b)
    area = np.asarray(igl.doublearea(a, faces_a))
    share = np.bincount(faces_a.ravel(), np.repeat(area, 3), minlength=len(a))
    return float((np.sqrt(squared) * share).sum() / share.sum())
