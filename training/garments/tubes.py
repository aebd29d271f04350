"""Skirts and hems: tubes that hang from a garment's lowest boundary and surround all of the body below it."""

from __future__ import annotations

import itertools

import numpy as np

from warpgarment.geometry.cutting import boundary_loops

_RING = 0.02  # height of a ring of faces [m]
_SLICE = 0.03  # a ring is clear of the body within this height above and below it [m]


def with_tube(
    vertices: np.ndarray, faces: np.ndarray, body_points: np.ndarray, *, length: float, flare: float, ease: float
) -> tuple[np.ndarray, np.ndarray]:
    """Extrudes the lowest boundary loop downwards.

    Each ring is at least as wide as the one above plus its part of `flare`, and in every direction at least as wide as
    the body there plus `ease`.

    Args:
        vertices: Positions [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        body_points: Points of the body that the tube surrounds, without the arms [m], shape [P, 3].
        length: Height of the tube [m].
        flare: Growth of the radius over the whole length [m].
        ease: Least distance from the body [m].

    Returns:
        Vertices [m] and faces of the sheet with the tube.
    """
    loop = min(boundary_loops(faces), key=lambda l: vertices[l, 1].mean())
    base = vertices[loop]
    centre = base.mean(0)
    radial = (base - centre)[:, [0, 2]]
    radius = np.linalg.norm(radial, axis=1)
    direction = radial / radius[:, None]
    rings = max(2, round(length / _RING))
    points, rows = [vertices], [loop]
    for ring in range(1, rings + 1):
        t = ring / rings
        near = np.abs(body_points[:, 1] - (centre[1] - length * t)) < _SLICE
        # the support function of the body's slice: a curve around its convex hull
        around = ((body_points[near][:, [0, 2]] - centre[[0, 2]]) @ direction.T).max(0, initial=0.0) + ease
        radius = np.maximum(radius + flare / rings, around)
        ringed = np.empty_like(base)
        ringed[:, [0, 2]] = centre[[0, 2]] + direction * radius[:, None]
        ringed[:, 1] = base[:, 1] - length * t
        rows.append(len(vertices) + (ring - 1) * len(loop) + np.arange(len(loop)))
        points.append(ringed)
    following = np.roll(np.arange(len(loop)), -1)
    strips = []
    for a, b in itertools.pairwise(rows):
        strips.append(np.stack([a[following], a, b], 1))
        strips.append(np.stack([a[following], b, b[following]], 1))
    tube = np.concatenate(strips)
    directed = {(int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3)}
    if (int(loop[1]), int(loop[0])) in directed:  # two faces agree if they run along their edge in opposite directions
        tube = tube[:, ::-1]
    return np.concatenate(points), np.concatenate([faces, tube])
