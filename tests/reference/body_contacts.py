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
        normal[i], anchor = (p - closest) / distance[i], closest
        face = int(np.linalg.norm(points - p, axis=1).argmin())
        if inside and origin is not None:
            met, outward = (a[0] for a in entry(origin[i][None], p[None], *bodies[b]))
            if outward @ normal[i] < 0:  # not where it meets no face: NaN
                normal[i], anchor = outward, p - outward @ (p - met) * outward
                normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                on_plane = np.abs(((met - corners[:, 0]) * normals).sum(1)) / np.linalg.norm(normals, axis=1)
                face = int((on_plane + np.linalg.norm(_on_triangles(met, corners) - met, axis=1)).argmin())
        if inside and length_of_way(anchor + 1e-4 * normal[i], normal[i], corners) is not None:
            way, length = way_out(p, normal[i], corners[face][1] - corners[face][0], corners)
            if length < 0.05:
                normal[i], anchor = way, p + length * way
        room, signs = _crossings(anchor + 1e-4 * normal[i], normal[i], corners)
        keep = epsilon[i]
        if len(room) and signs[0] < 0 and room[0] < 2 * keep:
            keep = min(keep, 0.5 * (room[0] + 1e-4))
        gap[i] = keep - normal[i] @ (p - anchor)
        if gap[i] <= 0:
            normal[i], gap[i] = 0.0, 0.0
    return normal, gap, distance


def length_of_way(point: np.ndarray, way: np.ndarray, corners: np.ndarray) -> float | None:
    """How far a ray goes until it has left a closed body for the first time [m]; None where it starts outside."""
    far, signs = _crossings(point, way, corners)
    if signs.sum() < 1:
        return None
    return float(far[np.flatnonzero(np.cumsum(signs) == signs.sum())[0]])


def way_out(point: np.ndarray, normal: np.ndarray, edge: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, float]:
    """The shortest of ten ways out and its length [m], infinite where there is none."""
    one = np.cross(normal, edge)
    one /= np.linalg.norm(one)
    other = np.cross(normal, one)
    ways = [normal, -normal, *(s * x + k * normal for k in (0, 1) for x in (one, other) for s in (1, -1))]
    ways = [way / np.linalg.norm(way) for way in ways]
    lengths = [length_of_way(point, way, corners) for way in ways]
    least = np.argmin([np.inf if length is None else length for length in lengths])
    return ways[least], np.inf if lengths[least] is None else lengths[least]


def _crossings(point: np.ndarray, way: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray meets triangles [m], in order, and +1 for those that it leaves by the front, -1 for the others.

    Tested by the signed volumes that the ray spans with the edges of each triangle.
    """
    a, b, c = (corners[:, k] - point for k in range(3))
    normals = np.cross(b - a, c - a)
    volumes = np.stack([np.cross(x, y) @ way for x, y in ((a, b), (b, c), (c, a))])
    along = normals @ way
    with np.errstate(all="ignore"):
        far = (a * normals).sum(1) / along
    met = ((volumes > 0).all(0) | (volumes < 0).all(0)) & (far > 0)
    order = np.argsort(far[met])
    return far[met][order], np.sign(along[met][order]).astype(int)


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
