"""Thinner and thinner bodies inside a body, from which it grows into a garment.

Positions flow along the heat equation of the body's own surface, x' = Δ x, in implicit steps (M + dt L) x⁺ = M x. A
limb of radius r shrinks as exp(-t / r²): arms become lines first, then legs, then the trunk, and all of it stays where
it was. Played backwards, a line in the middle of each sleeve grows to an arm.

| symbol | code | what |
| --- | --- | --- |
| x | `points` | positions of the body [m], [U,3] |
| L, M | `_laplacian`, `_mass` | cotangent Laplacian, a third of the area of the faces at each vertex [m²] |
| t | `times` | time of each of the thin bodies [m²] |
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from warpgarment.kernels.mesh.laplacian import cotangent_laplacian

FIRST, LAST, RATIO = 2e-5, 6e-3, 1.15
"""First and last time of the flow [m²] for a body 1.75 m tall, and the largest ratio of a time to the one before."""
TALL = 1.75


def thin_bodies(points: np.ndarray, faces: np.ndarray, height: float) -> np.ndarray:
    """A body and ever thinner ones, float64 [K,U,3] in metres, the body itself first.

    Args:
        points: Positions of the body [m], [U,3].
        faces: Vertex indices, [G,3].
        height: Height of the body [m].
    """
    x = np.asarray(points, np.float64)
    corner = x[faces]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    good = faces[area > 1e-12 * area.max()]
    mass = np.bincount(faces.ravel(), np.repeat(area / 3, 3), minlength=len(x))
    mass = np.maximum(mass, 1e-9 * mass.max())
    laplacian = cotangent_laplacian(x, good)
    unit = (height / TALL) ** 2
    times = [0.0]
    while times[-1] < LAST * unit:
        times.append(max(times[-1] * RATIO, times[-1] + FIRST * unit))
    found = [x]
    for step in np.diff(times):
        x = splu((diags(mass) + step * laplacian).tocsc()).solve(mass[:, None] * x)
        found.append(x)
    return np.stack(found)
