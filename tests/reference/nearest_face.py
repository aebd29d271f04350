"""The face named nearest, in float64: the nearest of all open faces, open edges and vertices of a mesh, one by one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Nearest(NamedTuple):
    """The face named nearest to each of N points."""

    face: np.ndarray
    """Smallest index of the faces around the nearest simplex, [N]."""
    corners: np.ndarray
    """Number of corners of the nearest simplex, [N]: 1 for a vertex, 2 for an edge, 3 for a face."""
    rival: np.ndarray
    """Additional distance [m], [N], of the nearest simplex that shares no vertex with that simplex and its faces."""


def nearest_face(points, vertices, faces) -> Nearest:
    """The nearest face of points [N, 3] on a mesh with vertices [V, 3] and faces [F, 3]; ignores faces without area."""
    points, vertices = np.asarray(points, float), np.asarray(vertices, float)
    a, b, c = vertices[faces.T]
    sound = np.flatnonzero(np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12 * np.ptp(vertices, axis=0).max() ** 2)
    around: dict[tuple[int, ...], list[int]] = {}
    for f in sound:
        i, j, k = sorted(faces[f].tolist())
        for simplex in ((i,), (j,), (k,), (i, j), (j, k), (i, k), (i, j, k)):
            around.setdefault(simplex, []).append(int(f))
    simplices = list(around)
    distance = np.stack([_distance(points, vertices[list(simplex)]) for simplex in simplices], axis=1)
    best = distance.argmin(axis=1)
    near = distance[np.arange(len(points)), best]
    rival = np.full(len(points), np.inf)
    corner_sets = [set(simplex) for simplex in simplices]
    for n, s in enumerate(best):
        neighbours = {v for f in around[simplices[s]] for v in faces[f].tolist()}
        for other in np.argsort(distance[n])[:200]:
            if not corner_sets[other] & neighbours:
                rival[n] = distance[n, other] - near[n]
                break
    face = np.array([min(around[simplices[s]]) for s in best])
    return Nearest(face, np.array([len(simplices[s]) for s in best]), rival)


def _distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance of points to an open simplex [m], infinite if the foot of the perpendicular is not inside it."""
    spread = (corners[1:] - corners[0]).T
    inner = np.linalg.solve(spread.T @ spread, spread.T @ (points - corners[0]).T).T
    weights = np.column_stack([1.0 - inner.sum(axis=1), inner])
    foot = np.linalg.norm(points - weights @ corners, axis=1)
    return np.where((weights > 0.0).all(axis=1), foot, np.inf)
