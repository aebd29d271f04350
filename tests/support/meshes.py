"""A small library of test meshes: garments and bodies as float32 vertices and int32 faces, seen from outside
counter-clockwise.

Every garment comes as a pair (rest vertices, moved vertices): the same cloth after a smooth deformation, so that
deformation gradients differ from the identity and from face to face. Everything is deterministic.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SCALES = (0.01, 1.0, 100.0)


class Mesh(NamedTuple):
    """Vertices [m], float32 [V, 3], and faces, int32 [F, 3]."""

    vertices: np.ndarray
    faces: np.ndarray

    def scaled(self, factor: float) -> Mesh:
        """The mesh scaled by a factor about the origin."""
        return Mesh((self.vertices.astype(np.float64) * factor).astype(np.float32), self.faces)


def _mesh(vertices, faces) -> Mesh:
    return Mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))


def joined(*meshes: Mesh) -> Mesh:
    """Packs meshes end to end in one mesh; face indices become those of the packed vertex array."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return _mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]),
    )


def offsets(*meshes: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertex and face offsets, int32 [B + 1], of meshes laid end to end."""
    vertex = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes]).astype(np.int32)
    face = np.cumsum([0] + [len(mesh.faces) for mesh in meshes]).astype(np.int32)
    return vertex, face


def tetrahedron() -> Mesh:
    """Four faces, closed: the smallest mesh with an inside."""
    vertices = [[0.5, 0.5, 0.5], [0.5, -0.5, -0.5], [-0.5, 0.5, -0.5], [-0.5, -0.5, 0.5]]
    return _mesh(vertices, [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


def icosphere(subdivisions: int = 2, radius: float = 0.5, centre=(0.0, 0.0, 0.0)) -> Mesh:
    """A closed sphere of 20 * 4**subdivisions faces; radius and centre in metres."""
    golden = (1.0 + 5.0**0.5) / 2.0
    points = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0), (0, -1, golden), (0, 1, golden)]
    points += [(0, -1, -golden), (0, 1, -golden), (golden, 0, -1), (golden, 0, 1), (-golden, 0, -1), (-golden, 0, 1)]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6)]
    faces += [(7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10)]
    faces += [(8, 6, 7), (9, 8, 1)]
    points = [np.array(p) / np.linalg.norm(p) for p in points]
    for _ in range(subdivisions):
        middle: dict[tuple[int, int], int] = {}
        finer = []
        for triangle in faces:
            between = []
            for a, b in zip(triangle, triangle[1:] + triangle[:1], strict=True):
                key = (min(a, b), max(a, b))
                if key not in middle:
                    middle[key] = len(points)
                    points.append((points[a] + points[b]) / np.linalg.norm(points[a] + points[b]))
                between.append(middle[key])
            (a, b, c), (ab, bc, ca) = triangle, between
            finer += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = finer
    return _mesh(np.array(points) * radius + np.array(centre), faces)


def skirt(
    around: int = 24, down: int = 8, waist: float = 0.2, hem: float = 0.38, top: float = 1.0, bottom: float = 0.5
):
    """An open cone about the y axis with two boundary loops and 2 * around * down faces, normals outwards; lengths in
    metres."""
    angles = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    vertices, faces = [], []
    for k in range(down + 1):
        radius, height = waist + (hem - waist) * k / down, top + (bottom - top) * k / down
        vertices += [(radius * np.cos(t), height, -radius * np.sin(t)) for t in angles]
    for k in range(down):
        for i in range(around):
            a, b = k * around + i, k * around + (i + 1) % around
            c, d = a + around, b + around
            faces += [(a, c, b), (b, c, d)] if (i + k) % 2 == 0 else [(a, d, b), (a, c, d)]
    return _mesh(vertices, faces)


def irregular_grid(columns: int = 14, rows: int = 10, width: float = 0.6, height: float = 0.4, seed: int = 0) -> Mesh:
    """A sheet of cloth whose inner vertices were moved by up to a third of the spacing, so that triangles have all
    shapes."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, width, columns + 1), np.linspace(0, height, rows + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    inner = ((x > 0) & (x < width) & (y > 0) & (y < height)).ravel()
    spacing = np.array([width / columns, height / rows, width / columns])
    vertices[inner] += rng.uniform(-0.33, 0.33, (int(inner.sum()), 3)) * spacing
    faces = []
    for j in range(rows):
        for i in range(columns):
            a = j * (columns + 1) + i
            b, c, d = a + 1, a + columns + 1, a + columns + 2
            faces += [(a, b, d), (a, d, c)] if rng.random() < 0.5 else [(a, b, c), (b, d, c)]
    return _mesh(vertices, faces)


def two_components() -> Mesh:
    """A skirt and a separate sheet, which together are one outfit of two pieces."""
    sheet = irregular_grid(6, 5, seed=1)
    return joined(skirt(12, 4), Mesh(sheet.vertices + np.float32([0.0, 1.2, 0.3]), sheet.faces))


def capsule(start, end, radius: float, around: int = 12, rings: int = 4) -> Mesh:
    """A closed capsule between two points [m]."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, 2 * rings + 1)[1:-1]
    latitudes = np.insert(latitudes, rings, 0.0)  # the equator twice: one ring at each end of the tube
    vertices = [start - radius * axis]
    for k, latitude in enumerate(latitudes):
        centre = start if k < rings else end
        for t in np.linspace(0.0, 2.0 * np.pi, around, endpoint=False):
            ring = np.cos(latitude) * (np.cos(t) * side + np.sin(t) * other)
            vertices.append(centre + radius * (ring + np.sin(latitude) * axis))
    vertices.append(end + radius * axis)
    last, count = len(vertices) - 1, len(latitudes)
    faces = []
    for i in range(around):
        j = (i + 1) % around
        faces.append((0, 1 + j, 1 + i))
        faces.append((last, 1 + (count - 1) * around + i, 1 + (count - 1) * around + j))
        for k in range(count - 1):
            a, b = 1 + k * around + i, 1 + k * around + j
            faces += [(a, b, b + around), (a, b + around, a + around)]
    return _mesh(vertices, faces)


def sheet_and_limb() -> tuple[Mesh, Mesh]:
    """A level sheet of cloth facing up, and a closed limb 8 cm thick that lies 1 cm below it."""
    grid = irregular_grid(20, 14)
    sheet = _mesh((grid.vertices - np.float32([0.3, 0.2, 0.0]))[:, [0, 2, 1]], grid.faces[:, ::-1])
    return sheet, capsule([-0.6, -0.05, 0.0], [0.6, -0.05, 0.0], 0.04, around=24, rings=6)


def posed_body(phase: float = 0.0) -> Mesh:
    """A figure of overlapping capsules and spheres, 1.7 m tall, mid-stride; `phase` moves its limbs.

    Its parts penetrate each other, as the limbs of posed bodies do: signs by normals or by parity are wrong on it.
    """
    swing = 0.35 * np.sin(phase)
    hip = np.array([0.1, 0.92, 0.0])
    foot = np.array([0.12, 0.08, 0.6 * swing])
    mirrored = np.array([-1.0, 1.0, -1.0])
    hand = np.array([0.5, 1.2, 0.3 * swing])
    shoulder = np.array([0.17, 1.4, 0.0])
    return joined(
        capsule((0, 0.95, 0), (0, 1.4, 0.05 * swing), 0.15),
        capsule(hip, foot, 0.08),
        capsule(hip * mirrored, foot * mirrored, 0.08),
        capsule(shoulder, hand, 0.05),
        capsule(shoulder * mirrored, hand * mirrored, 0.05),
        icosphere(2, 0.16, (0.05, 1.0, 0.02)),
        icosphere(2, 0.11, (0.0, 1.6, 0.05 * swing)),
    )


def overlapping_spheres() -> Mesh:
    """Two spheres that share a lens of volume: winding number 2 in the lens."""
    return joined(icosphere(3, 0.5), icosphere(3, 0.4, (0.45, 0.1, 0.0)))


def moved(mesh: Mesh, seed: int = 0, strength: float = 0.3) -> Mesh:
    """The mesh after a smooth bend, twist, stretch and rotation relative to its size, so that this commutes with
    scaling."""
    rng = np.random.default_rng(seed)
    vertices = mesh.vertices.astype(np.float64)
    low, high = vertices.min(0), vertices.max(0)
    size = np.linalg.norm(high - low)
    unit = (vertices - 0.5 * (low + high)) / size
    linear = np.eye(3) + strength * rng.uniform(-0.5, 0.5, (3, 3))
    waves = rng.uniform(2.0, 6.0, (3, 3))
    unit = unit @ linear.T + strength * 0.1 * np.sin(unit @ waves.T + rng.uniform(0, 6, 3))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    return _mesh(unit @ rotation.T * size + 0.5 * (low + high) + 0.1 * size, mesh.faces)


def garments() -> dict[str, Mesh]:
    """Five rest meshes by name, which differ in their difficulties for a kernel."""
    return {
        "tetrahedron": tetrahedron(),
        "icosphere": icosphere(1),
        "skirt": skirt(),
        "irregular_grid": irregular_grid(),
        "two_components": two_components(),
    }


def bodies() -> dict[str, Mesh]:
    """Five bodies by name: closed, overlapping, posed, open and in pieces."""
    return {
        "tetrahedron": tetrahedron(),
        "overlapping_spheres": overlapping_spheres(),
        "posed_body": posed_body(1.0),
        "open_skirt": skirt(),
        "two_spheres": joined(icosphere(2, 0.3, (-0.5, 0, 0)), icosphere(2, 0.3, (0.5, 0, 0))),
    }
