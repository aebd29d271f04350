"""Float64 twin of kernels/collision/body_contacts.py: every vertex against every face of its body, one by one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tests.reference.collision import entry
from tests.reference.signed_distance import winding_number


def body_contacts(
    vertices: np.ndarray,
    bodies: Sequence[tuple[np.ndarray, np.ndarray]],
    body_of_vertex: np.ndarray,
    epsilon: np.ndarray,
    origin: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contacts of vertices [V,3] with bodies, each given by vertices and faces.

    Returns:
        Normals [V,3], zero where there is no contact; what is missing along them [V]; signed distances [V], infinite on
        body -1.
    """
    vertices = vertices.astype(np.float64)
    normal, gap, distance = np.zeros(vertices.shape), np.zeros(len(vertices)), np.full(len(vertices), np.inf)
    for i, (p, b) in enumerate(zip(vertices, body_of_vertex, strict=True)):
        if b < 0:
            continue
        corners = bodies[b][0].astype(np.float64)[bodies[b][1]]
        points = _on_triangles(p, corners)
        closest = points[np.linalg.norm(points - p, axis=1).argmin()]
        inside = winding_number(p[None], *bodies[b])[0] > 0.5
        distance[i] = (-1 if inside else 1) * np.linalg.norm(p - closest)
        if distance[i] >= epsilon[i]:
            continue
        normal[i] = (p - closest) / distance[i]
        gap[i] = epsilon[i] - distance[i]
        if inside and origin is not None:
            met, outward = (a[0] for a in entry(origin[i][None], p[None], *bodies[b]))
            if outward @ normal[i] < 0:  # not where it meets no face: NaN
                normal[i], gap[i] = outward, epsilon[i] - outward @ (p - met)
    return normal, gap, distance


def _on_triangles(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The nearest point of each triangle [F,3,3]: of its plane, if that is within, or else of its three edges."""
    starts, ends = corners, np.roll(corners, -1, axis=1)
    edges = ends - starts
    normal = np.cross(edges[:, 0], edges[:, 1])[:, None]
    along = ((p - starts) * edges).sum(2) / (edges * edges).sum(2)
    on_edges = starts + np.clip(along, 0.0, 1.0)[..., None] * edges
    nearest = np.linalg.norm(on_edges - p, axis=2).argmin(1)
    height = ((p - starts[:, :1]) * normal).sum(2, keepdims=True) / (normal * normal).sum(2, keepdims=True)
    foot = p - height * normal
    within = ((np.cross(edges, foot - starts) * normal).sum(2) >= 0).all(1)
    return np.where(within[:, None], foot[:, 0], on_edges[np.arange(len(corners)), nearest])
