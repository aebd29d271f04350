"""Surfaces with known distances along them."""

from __future__ import annotations

import numpy as np
import trimesh
from pygeodesic.geodesic import PyGeodesicAlgorithmExact
from scipy.spatial import Delaunay


def sheet(columns, rows, wrap=False):
    """Column and row of each vertex of a triangulated rectangle, and its faces; with `wrap` it is closed to a tube."""
    across = columns if wrap else columns + 1
    u, v = np.meshgrid(np.arange(across), np.arange(rows + 1), indexing="ij")
    i, j = (n.ravel() for n in np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"))
    a, b = i * (rows + 1) + j, (i + 1) % across * (rows + 1) + j
    return u.ravel(), v.ravel(), np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])


def flat(columns=10, rows=10, width=1.0, height=1.0):
    u, v, faces = sheet(columns, rows)
    return np.stack([u * width / columns, v * height / rows, 0 * u], axis=1), faces


def skirt(columns, rows, angle, ripple=0.0):
    """A flared skirt; less than a full turn leaves a slit."""
    u, v, faces = sheet(columns, rows, wrap=angle is None)
    turn, s = u / columns * (angle or 2 * np.pi), v / rows
    radius = 0.15 + 0.25 * s + ripple * s * np.sin(8 * turn)
    return np.stack([radius * np.cos(turn), -0.6 * s, radius * np.sin(turn)], axis=1), faces


def cone(around, height):
    angle = np.arange(around) * 2 * np.pi / around
    rim = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    i = np.arange(around)
    return np.concatenate([[[0, height, 0]], rim]), np.stack([0 * i, (i + 1) % around + 1, i + 1], axis=1)


def irregular(count, seed, bumps=0.0, grading=1):
    """A hilly sheet over random points: very different edge lengths, slivers at its border."""
    random = np.random.default_rng(seed)
    points = random.random((count, 2)) ** grading
    faces = Delaunay(points).simplices
    z = 0.15 * np.sin(5 * points[:, 0]) * np.cos(4 * points[:, 1]) + random.normal(0, bumps, count)
    corners = points[faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    faces[area < 0] = faces[area < 0][:, ::-1]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    used, faces = np.unique(faces[np.abs(area) / longest > 3e-5], return_inverse=True)
    return np.column_stack([points, z])[used], faces.reshape(-1, 3)


def sphere():
    mesh = trimesh.creation.icosphere(2)
    return np.array(mesh.vertices), np.array(mesh.faces)


def exact_distances(vertices, faces, sources):
    """Exact polyhedral distances [m] between centroids, float64 [S, F]: each face is split in three at its centroid."""
    vertices = vertices.astype(np.float32).astype(np.float64)
    count, middle = len(faces), len(vertices) + np.arange(len(faces))
    points = np.concatenate([vertices, vertices[faces].mean(axis=1)])
    split = np.concatenate([np.stack([faces[:, k], faces[:, (k + 1) % 3], middle], axis=1) for k in range(3)])
    solver = PyGeodesicAlgorithmExact(points, split.astype(np.int32))
    return np.stack([solver.geodesicDistances(np.array([len(vertices) + s]), middle)[0] for s in sources]).reshape(
        -1, count
    )


MESHES = {
    "flat grid": flat,
    "long faces": lambda: flat(24, 3),
    "slivers": lambda: flat(2, 30),
    "strip": lambda: flat(80, 1, 2.0, 0.02),
    "fan": lambda: cone(100, 0.2),
    "cone": lambda: cone(40, 1.0),
    "slit skirt": lambda: skirt(16, 6, 1.9 * np.pi),
    "rippled skirt": lambda: skirt(24, 4, None, 0.05),
    "irregular": lambda: irregular(110, 0),
    "graded": lambda: irregular(110, 1, grading=3),
    "bumpy": lambda: irregular(110, 2, bumps=0.03),
    "sphere": sphere,
}


def tube(radius, length, around, rings):
    """An open tube with `around` faces' edges a ring."""
    u, v, faces = sheet(around, rings, wrap=True)
    turn = u / around * 2 * np.pi
    return np.stack([radius * np.sin(turn), v / rings * length, radius * np.cos(turn)], axis=1), faces


SLENDER = {  # what straps and cords are made of, and sheets of slender faces
    "drawstring": lambda: tube(0.01, 1.9, 21, 7),
    "finer drawstring": lambda: tube(0.01, 1.9, 40, 15),
    "cord with rings": lambda: tube(0.005, 1.0, 6, 60),
    "cord of slender faces": lambda: tube(0.002, 1.5, 5, 30),
    "strap": lambda: flat(120, 2, 0.6, 0.02),
    "sheet, sides 1:20": lambda: flat(60, 3, 0.6, 0.6),
    "sheet, sides 1:50": lambda: flat(100, 2, 0.6, 0.6),
    "trouser leg": lambda: tube(0.08, 1.0, 100, 4),
    "irregular": lambda: tuple(x * ([0.05, 1, 1] if k == 0 else 1) for k, x in enumerate(irregular(350, 4))),
}
