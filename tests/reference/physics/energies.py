"""Float64 NumPy twins of kernels/physics: energies from lengths and angles, one face and one edge at a time."""

from __future__ import annotations

import numpy as np


def membrane_energy(vertices, faces, rest, stiffness, axes=None) -> float:
    """Half of area times strain times stress, with the strain from how the metric of each face has changed."""
    total = 0.0
    for number, (i, j, k) in enumerate(faces):
        a, b = rest[j] - rest[i], rest[k] - rest[i]
        normal = np.cross(a, b)
        area = np.linalg.norm(normal) / 2
        first = a if axes is None else axes[number] - normal * (normal @ axes[number]) / (normal @ normal)
        first = first / np.linalg.norm(first)
        second = np.cross(normal / (2 * area), first)
        # directions of the material in coordinates (a, b)
        coordinates = np.linalg.lstsq(np.stack([a, b], 1), np.stack([first, second], 1), rcond=None)[0]
        now = np.stack([vertices[j] - vertices[i], vertices[k] - vertices[i]], 1)
        strain = (coordinates.T @ (now.T @ now) @ coordinates - np.eye(2)) / 2
        e = np.array([strain[0, 0], strain[1, 1], 2 * strain[0, 1]])
        total += area / 2 * e @ np.asarray(stiffness) @ e
    return total


def edges_of_two(faces) -> dict[tuple[int, int], list[int]]:
    """Opposite corners of each edge that two faces share, the first that of the face that runs from low to high."""
    found: dict[tuple[int, int], dict[int, int]] = {}
    for face in faces:
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            i, j = int(face[a]), int(face[b])
            found.setdefault((min(i, j), max(i, j)), {})[int(i > j)] = int(face[c])
    return {edge: [corner[0], corner[1]] for edge, corner in found.items() if len(corner) == 2}


def fold(vertices, edge, corners) -> float:
    """Signed angle between the normals of the two faces at an edge, positive where it is convex."""
    i, j = edge
    n = np.cross(vertices[j] - vertices[i], vertices[corners[0]] - vertices[i])
    m = np.cross(vertices[corners[1]] - vertices[i], vertices[j] - vertices[i])
    n, m = n / np.linalg.norm(n), m / np.linalg.norm(m)
    convex = n @ (vertices[corners[1]] - vertices[i]) < 0
    return float(np.arccos(np.clip(n @ m, -1, 1)) * (1 if convex else -1))


def bending_energy(vertices, faces, rest, bend) -> float:
    """Half of stiffness times rest length times the square of the change of angle, over the edges of two faces."""
    total = 0.0
    for (i, j), corners in edges_of_two(faces).items():
        turned = fold(vertices, (i, j), corners) - fold(rest, (i, j), corners)
        turned = (turned + np.pi) % (2 * np.pi) - np.pi
        total += bend / 2 * np.linalg.norm(rest[j] - rest[i]) * turned**2
    return total


def masses(faces, rest, density) -> np.ndarray:
    """Mass of each vertex."""
    mass = np.zeros(len(rest))
    for face in faces:
        a, b, c = rest[face]
        mass[face] += density * np.linalg.norm(np.cross(b - a, c - a)) / 6
    return mass


def inertia_energy(vertices, target, mass, inertia) -> float:
    """½ c Σ m |x - y|²."""
    return 0.5 * inertia * float((mass[:, None] * (vertices - target) ** 2).sum())


def contact_energy(vertices, normal, offset, distance, stiffness) -> float:
    """Springs of the vertices that are closer to their planes than a distance."""
    total = 0.0
    for x, n, o, d, k in zip(vertices, normal, offset, distance, stiffness, strict=True):
        if n @ n > 0:
            total += k / 2 * max(0.0, d - (n @ x - o)) ** 2
    return total


def friction_energy(vertices, normal, anchor, friction, slip) -> float:
    """Work against friction, the force of which rises smoothly over the first `slip` of the way: by quadrature."""
    total = 0.0
    for x, n, a, f in zip(vertices, normal, anchor, friction, strict=True):
        if n @ n > 0 and f > 0:
            t = x - a
            s = np.linalg.norm(t - n * (n @ t))
            points = np.linspace(0, min(s, slip), 2001)
            force = 2 * points / slip - (points / slip) ** 2
            total += f * (np.trapezoid(force, points) + max(0.0, s - slip))
    return total


def pair_energy(vertices, first, second, u, v, normal, distance, stiffness, before, friction, slip) -> float:
    """A spring between a point of one face and a point of another, and friction with the spring's force before."""
    way, start = (u @ points[first] - v @ points[second] for points in (vertices, before))
    force = friction * stiffness * max(0.0, distance - normal @ start)
    rubbed = friction_energy(way[None], normal[None], start[None], [force], slip)
    return 0.5 * stiffness * max(0.0, distance - normal @ way) ** 2 + rubbed
