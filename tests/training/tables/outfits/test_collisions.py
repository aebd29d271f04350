"""H- and L-Collision as published and by surfaces, beside hand-made cases and brute force in float64."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from support.layers import shaken, tubes
from trimesh.triangles import closest_point

from warpgarment.metrics import layer_collision
from warpgarment.training.tables.outfits.collisions import Surface, behind_planes, beneath, inside


def square(height: float, cells: int = 4, size: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """A square that faces up, [V,3] and [F,3]."""
    line = np.linspace(-size / 2, size / 2, cells + 1)
    x, z = np.meshgrid(line, line)
    vertices = np.stack([x.ravel(), np.full(x.size, height), z.ravel()], axis=1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(cells), np.arange(cells)))
    a = j * (cells + 1) + i
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    return vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])


def wedge(sharp: float) -> tuple[np.ndarray, np.ndarray]:
    """A roof whose ridge runs along z, with half an opening angle of `sharp` [rad]; facing outwards and up."""
    s, c = 0.2 * np.sin(sharp), 0.2 * np.cos(sharp)
    vertices = np.array([[x, y, z] for z in (-0.2, 0.2) for x, y in ((-s, -c), (0.0, 0.0), (s, -c))])
    return vertices, np.array([[0, 3, 1], [1, 3, 4], [1, 4, 2], [2, 4, 5]])


def behind_by_loops(points, vertices, faces) -> list[bool]:
    found = []
    for p in np.asarray(points, float):
        k = int(np.argmin([np.linalg.norm(p - v) for v in vertices]))
        normal = np.zeros(3)
        for face in faces:
            if k in face:
                a, b, c = vertices[face]
                normal += np.cross(b - a, c - a)  # twice the area
        found.append(float(normal @ (p - vertices[k])) < 0.0)
    return found


def solid_angle(point, vertices, faces) -> float:
    """The winding number of a surface about a point (Van Oosterom and Strackee 1983)."""
    total = 0.0
    for face in faces:
        a, b, c = (vertices[k] - point for k in face)
        x, y, z = (np.linalg.norm(v) for v in (a, b, c))
        total += 2 * np.arctan2(np.linalg.det([a, b, c]), x * y * z + a @ b * z + b @ c * x + c @ a * y)
    return total / (4 * np.pi)


def test_a_plane_above_and_below():
    """The sides would be exchanged, or the limit ignored: a point above collides nowhere, one 1 cm below both ways,
    one 4 cm below only as published."""
    vertices, faces = square(0.0)
    surface = Surface.of(faces, len(vertices))
    points = np.array([[0.03, 0.01, 0.02], [0.03, -0.01, 0.02], [0.03, -0.04, 0.02]])
    assert behind_planes(points, vertices, faces).tolist() == [False, True, True]
    assert beneath(points, vertices, surface).tolist() == [False, True, False]
    assert behind_planes(points, vertices, faces[:, ::-1]).tolist() == [True, False, False]


def test_beyond_the_border_only_the_published_way_counts():
    """A long coat over a short shirt would collide by surfaces: beside the square and below its plane."""
    vertices, faces = square(0.0)
    points = np.array([[0.22, -0.005, 0.0], [0.21, -0.005, 0.21], [0.19, -0.005, 0.0]])
    assert behind_planes(points, vertices, faces).all()
    assert beneath(points, vertices, Surface.of(faces, len(vertices))).tolist() == [False, False, True]


@pytest.mark.parametrize("sharp", [0.1, 0.5, 1.4])
def test_above_a_sharp_ridge_is_above(sharp):
    """A face's own normal would put points above a ridge behind one of its faces: they are above with both normals."""
    vertices, faces = wedge(sharp)
    surface = Surface.of(faces, len(vertices))
    for x in (-0.002, 0.0, 0.002):
        assert not beneath(np.array([[x, 0.01, 0.03]]), vertices, surface)[0]
    inner = np.array([[0.0, -0.01 / np.sin(sharp), 0.0]]) if sharp > 0.2 else np.array([[0.0, -0.05, 0.0]])
    assert beneath(inner, vertices, surface)[0]


@pytest.mark.parametrize("seed", range(3))
def test_published_sides_are_those_of_loops(seed):
    """H- or L-Collision would be another figure than the publication's: nearest vertex and area-weighted normal by
    loops, on a shaken tube; the same for every point, and both answers occur."""
    inner, outer = tubes(2, gap=0.004)
    vertices, points = (shaken(g.vertices, 4e-3, seed + k).astype(float) for k, g in enumerate((inner, outer)))
    expected = behind_by_loops(points, vertices, inner.faces)
    assert behind_planes(points, vertices, inner.faces).tolist() == expected
    assert 0 < sum(expected) < len(points)


@pytest.mark.parametrize("seed", range(3))
def test_surface_sides_are_those_of_brute_force_and_the_library(seed):
    """The surface-based share would be wrong: nearest of all faces by trimesh, sides by libigl's pseudonormals through
    `layer_collision`; the same share, without a limit and, by distance, with one."""
    inner, outer = tubes(2, gap=0.003, around=14, along=8)
    vertices, points = (shaken(g.vertices, 5e-3, seed + k).astype(float) for k, g in enumerate((inner, outer)))
    faces = np.asarray(inner.faces)
    surface = Surface.of(faces, len(vertices))
    found = beneath(points, vertices, surface, deepest=9.0)
    assert found.mean() == pytest.approx(layer_collision(points, vertices, faces), abs=1e-12)
    assert 0 < found.sum() < len(points)
    corners = vertices[faces]
    distance = np.array([np.linalg.norm(closest_point(corners, np.repeat(p[None], len(faces), 0)) - p, axis=1).min()
                         for p in points])  # fmt: skip
    limit = float(np.median(distance[found]))
    near = found & (distance <= limit)
    assert beneath(points, vertices, surface, deepest=limit + 1e-12).tolist() == near.tolist()


def test_inside_is_the_winding_number():
    """Vertices in the body would not be seen: by the solid angles of all faces, of a capsule with a hole whose
    neighbourhood is left out; the same for every point."""
    capsule = trimesh.creation.capsule(height=1.0, radius=0.15, count=[12, 12])
    vertices, faces = np.asarray(capsule.vertices), np.asarray(capsule.faces)[3:]
    points = np.random.default_rng(0).uniform([-0.25, -0.25, -0.25], [0.25, 0.25, 1.25], (300, 3))
    number = np.array([solid_angle(p, vertices, faces) for p in points])
    clear = abs(number - 0.5) > 0.1
    assert clear.sum() > 280
    assert (inside(points, vertices, faces) == (number > 0.5))[clear].all()
    assert 20 < inside(points, vertices, faces).sum() < 280
