"""Pairs of triangles that cross, beside a twin by separating axes, libigl and ipctk."""

from __future__ import annotations

import igl
import ipctk
import numpy as np
import pytest
from support.layers import shaken, tubes

from warpgarment.training.tables.outfits.crossings import crossing_pairs, near_pairs

FLAT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
UPRIGHT = np.array([[0.2, 0.2, -1.0], [0.2, 0.2, 1.0], [0.3, 0.2, 2.0]])  # goes through FLAT at (0.2, 0.2)


def count(*triangles: np.ndarray, same=None) -> int:
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    return len(crossing_pairs(np.concatenate(triangles), faces, same))


def separated(p: np.ndarray, q: np.ndarray) -> bool:
    """Whether one of the eleven axes of two triangles, and the normals of their edges in their planes, parts them."""
    edges = [[t[k] - t[k - 1] for k in range(3)] for t in (p, q)]
    normals = [np.cross(e[0], e[1]) for e in edges]
    axes = normals + [np.cross(a, b) for a in edges[0] for b in edges[1]]
    axes += [np.cross(n, e) for n, own in zip(normals, edges, strict=True) for e in own]
    return any((p @ a).min() > (q @ a).max() or (p @ a).max() < (q @ a).min() for a in axes)


def cloud(seed: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Three tubes within each other, shaken until they cross."""
    garments = tubes(3, gap=0.01)
    start = np.cumsum([0, *(len(g.vertices) for g in garments)])
    faces = np.concatenate([g.faces + s for g, s in zip(garments, start, strict=False)]).astype(np.int64)
    return shaken(np.concatenate([g.vertices for g in garments]), size, seed).astype(float), faces


def test_two_triangles_by_hand():
    """Crossings would be missed, or seen where there are none: through the middle, a micrometre beside an edge on
    either side, in one plane, parallel, and with a common vertex. Exactly one or none."""
    assert count(FLAT, UPRIGHT) == 1
    assert count(UPRIGHT, FLAT) == 1
    for beside, expected in ((-1e-6, 0), (1e-6, 1)):
        assert count(FLAT, UPRIGHT - [0.7 / 3 - beside, 0.0, 0.0]) == expected  # up to x = beside in the plane
    assert count(FLAT, UPRIGHT - [0.0, 0.0, 3.0]) == 0
    assert count(FLAT, FLAT + [0.1, 0.1, 0.0]) == 0  # one plane
    assert count(FLAT, FLAT + [0.1, 0.1, 1e-9]) == 0
    corner = np.array([[0.0, 0, 0], [0.5, 0.2, 1], [0.5, 0.2, -1]])
    assert count(FLAT, corner) == 1
    assert count(FLAT, corner, same=np.array([0, 1, 2, 0, 3, 4])) == 0


@pytest.mark.parametrize(("seed", "size"), [(0, 2e-3), (1, 6e-3), (2, 2e-2)])
def test_crossings_are_those_of_separating_axes_and_libigl(seed, size):
    """Other pairs would be counted than cross. All pairs of faces without a common vertex, by two other methods;
    exactly the same pairs."""
    vertices, faces = cloud(seed, size)
    found = {tuple(pair) for pair in crossing_pairs(vertices, faces).tolist()}
    other, by_igl = set(), set()
    for a in range(len(faces)):
        for b in range(a + 1, len(faces)):
            if not set(faces[a]) & set(faces[b]):
                p, q = vertices[faces[a]], vertices[faces[b]]
                if not separated(p, q):
                    other.add((a, b))
                if igl.tri_tri_intersection_test_3d(*(np.ascontiguousarray(x[None]) for x in (*p, *q)))[0]:
                    by_igl.add((a, b))
    assert found == other == by_igl
    assert len(found) > (20 if size > 3e-3 else -1)


def test_no_crossing_is_none_for_ipctk_too():
    """A table would call frames free that are not. Whether there is any crossing, by ipctk, while tubes are shaken
    more and more; exact, and both answers occur."""
    answers = []
    for seed in range(30):
        vertices, faces = cloud(seed, 4e-4 * seed)
        mesh = ipctk.CollisionMesh(vertices, ipctk.edges(faces.astype(np.int32)), faces.astype(np.int32))
        answers.append(len(crossing_pairs(vertices, faces)) > 0)
        assert ipctk.has_intersections(mesh, vertices) == answers[-1]
    assert 3 < sum(answers) < 27


def test_near_pairs_are_those_of_brute_force(monkeypatch):
    """A crossing outside the pairs would not be seen. All boxes against all, also in several portions; exactly."""
    vertices, faces = cloud(3, 1e-2)
    low, high = vertices[faces].min(axis=1), vertices[faces].max(axis=1)
    meet = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    expected = {(a, b) for a, b in np.argwhere(meet).tolist() if a < b}
    for most in (1 << 22, 7):
        monkeypatch.setattr("warpgarment.training.tables.outfits.crossings.PAIRS", most)
        found = [tuple(pair) for pair in near_pairs(vertices, faces).tolist()]
        assert len(found) == len(set(found))
        assert set(found) == expected
