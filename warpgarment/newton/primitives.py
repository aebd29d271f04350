"""Closed triangle meshes of Newton's primitive shapes, in the shape's own frame, wound counter-clockwise from outside.

Newton's scale of a shape: a sphere has its radius; a capsule, a cylinder and a cone radius and half height, along Z; an
ellipsoid and a box three half axes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

AROUND = 20  # vertices of a ring
EDGE = 0.06  # largest edge of a flat side [m]

Mesh = tuple[np.ndarray, np.ndarray]  # vertices [m], [U,3], and faces [G,3]


def sphere(scale: np.ndarray) -> Mesh:
    """An icosphere."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=float(scale[0]))
    return np.array(ball.vertices), np.array(ball.faces)


def ellipsoid(scale: np.ndarray) -> Mesh:
    """A sphere, stretched."""
    vertices, faces = sphere(np.ones(3))
    return vertices * scale, faces


def capsule(scale: np.ndarray) -> Mesh:
    """Two half spheres, and rings between them at most as far apart as a ring's vertices."""
    radius, half = float(scale[0]), float(scale[1])
    between = max(1, int(np.ceil(2 * half * AROUND / (2 * np.pi * radius))))
    latitudes = np.linspace(np.pi / 2, 0.0, AROUND // 4 + 1)[1:]
    upper = [(radius * np.cos(angle), half + radius * np.sin(angle)) for angle in latitudes]
    middle = [(radius, z) for z in np.linspace(half, -half, between + 1)[1:-1]]
    lower = [(r, -z) for r, z in reversed(upper)]
    return _turned([(0.0, half + radius), *upper, *middle, *lower, (0.0, -half - radius)])


def cylinder(scale: np.ndarray) -> Mesh:
    """A cylinder with rings on its lids and sides."""
    radius, half = float(scale[0]), float(scale[1])
    lid = [(r, half) for r in _steps(0.0, radius)]
    side = [(radius, z) for z in _steps(half, -half)[1:-1]]
    return _turned([*lid, *side, *((r, -half) for r in _steps(radius, 0.0))])


def cone(scale: np.ndarray) -> Mesh:
    """A cone with its tip up."""
    radius, half = float(scale[0]), float(scale[1])
    count = len(_steps(0.0, float(np.hypot(radius, 2 * half))))
    side = [(radius * s, half - 2 * half * s) for s in np.linspace(0.0, 1.0, count)]
    return _turned([*side, *((r, -half) for r in _steps(radius, 0.0)[1:])])


def box(scale: np.ndarray) -> Mesh:
    """A box whose sides are divided."""
    made = trimesh.creation.box(extents=2 * np.asarray(scale, dtype=float))
    vertices, faces = trimesh.remesh.subdivide_to_size(made.vertices, made.faces, max_edge=EDGE, max_iter=20)
    whole = trimesh.Trimesh(vertices, faces)  # joins the vertices of edges
    return np.array(whole.vertices), np.array(whole.faces)


PRIMITIVES: dict[str, Callable[[np.ndarray], Mesh]] = {  # by the name in newton.GeoType
    "SPHERE": sphere,
    "CAPSULE": capsule,
    "ELLIPSOID": ellipsoid,
    "CYLINDER": cylinder,
    "BOX": box,
    "CONE": cone,
}


def _steps(start: float, end: float) -> np.ndarray:
    return np.linspace(start, end, max(2, int(np.ceil(abs(end - start) / EDGE)) + 1))


def _turned(profile: list[tuple[float, float]]) -> Mesh:
    """The surface of a profile of radius and height that turns about Z; its first and last points are on the axis."""
    angles = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(AROUND)], axis=1)
    rings = [ring * [r, r, 0.0] + [0.0, 0.0, z] for r, z in profile[1:-1]]
    vertices = np.concatenate([[[0.0, 0.0, profile[0][1]]], *rings, [[0.0, 0.0, profile[-1][1]]]])
    here, there = np.arange(AROUND), np.roll(np.arange(AROUND), -1)
    faces = [np.stack([np.zeros(AROUND, int), 1 + here, 1 + there], axis=1)]
    for k in range(len(rings) - 1):
        top, bottom = 1 + k * AROUND, 1 + (k + 1) * AROUND
        faces += [np.stack([top + here, bottom + here, bottom + there], axis=1)]
        faces += [np.stack([top + here, bottom + there, top + there], axis=1)]
    last = 1 + (len(rings) - 1) * AROUND
    faces.append(np.stack([last + here, np.full(AROUND, len(vertices) - 1), last + there], axis=1))
    return vertices, np.concatenate(faces)
