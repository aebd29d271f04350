"""Float64 NumPy twin of kernels/wind.py."""

from __future__ import annotations

import numpy as np


def air_forces(vertices, velocities, faces, air, world=None, drag=1.2, lift=0.6, density=1.225):
    """Forces of the air [N], [V, 3], from the angle between face and wind, with directions from cross products."""
    points, speeds, air = (np.asarray(a, np.float64) for a in (vertices, velocities, air))
    world = np.zeros(len(points), int) if world is None else world
    force = np.zeros_like(points)
    for corners in faces:
        a, b, c = points[corners]
        normal = np.cross(b - a, c - a)
        area = np.linalg.norm(normal) / 2
        wind = air[world[corners[0]]] - speeds[corners].mean(0)
        speed = np.linalg.norm(wind)
        if speed == 0 or area == 0:
            continue
        along, normal = wind / speed, normal / (2 * area)
        angle = np.arccos(np.clip(abs(normal @ along), 0, 1))
        across = np.cross(np.cross(along, normal), along)  # of length sin(angle), on the normal's side of the wind
        across *= np.sign(normal @ along)
        total = 0.5 * density * area * speed**2 * np.cos(angle) * (drag * along + lift * across)
        np.add.at(force, corners, total / 3)
    return force
