"""Seam cuts: slits and open seams along mesh edges."""

from __future__ import annotations

import igl
import numpy as np
import pytest
from support.bodies import rest_body

from warpgarment.geometry.cutting import boundary_loops
from warpgarment.objects.garment import Garment
from warpgarment.training.garments.make import make_garment
from warpgarment.training.garments.pattern import CATEGORIES, Pattern
from warpgarment.training.garments.seams import Seam, Seams, cut_seams, parted, sampled_seams

ROWS, COLUMNS, RADIUS, HEIGHT = 20, 40, 0.3, 1.0


@pytest.fixture(scope="module")
def tube() -> Garment:
    """An upright cylinder, open at both ends, pinned at the lower one."""
    angle = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    ring = np.stack([RADIUS * np.sin(angle), 0 * angle, RADIUS * np.cos(angle)], 1)
    vertices = np.concatenate([ring + [0.0, HEIGHT * row / ROWS, 0.0] for row in range(ROWS + 1)])
    a = np.arange(ROWS * COLUMNS)
    b = a - a % COLUMNS + (a + 1) % COLUMNS
    faces = np.concatenate([np.stack([a, b, b + COLUMNS], 1), np.stack([a, b + COLUMNS, a + COLUMNS], 1)])
    return Garment(vertices, faces, pins=np.arange(COLUMNS), name="tube")


@pytest.fixture(scope="module")
def dress() -> Garment:
    return make_garment(rest_body(), Pattern("dress", sleeve=0.1, faces=600))[0]


def copies(garment: Garment) -> np.ndarray:
    """Pairs of vertices at the same place, shape [N, 2]."""
    order = np.lexsort(garment.vertices.T)
    same = (garment.vertices[order[:-1]] == garment.vertices[order[1:]]).all(1)
    return np.stack([order[:-1][same], order[1:][same]], axis=1)


def euler(garment: Garment) -> int:
    return igl.euler_characteristic(garment.faces.astype(np.int64))


def test_a_slit_runs_from_the_hem_along_its_line(tube):
    """If this fails, slits lie elsewhere, close at the hem, or tear a piece off. The mesh has edges on this line."""
    column = 7
    cut = cut_seams(tube, Seams((Seam(2 * np.pi * column / COLUMNS, 0.0, 0.4),)))
    doubled = tube.vertices[column + COLUMNS * np.arange(8)]  # 8 edges: 0.4 of 20 rows; the upper end stays single
    np.testing.assert_array_equal(np.sort(cut.vertices[copies(cut)[:, 0], 1]), doubled[:, 1])
    np.testing.assert_allclose(cut.vertices[copies(cut)[:, 0]][:, [0, 2]], doubled[:, [0, 2]])
    assert euler(cut) == euler(tube) == 0
    assert len(boundary_loops(cut.faces)) == 2
    assert len(boundary_loops(cut.faces)[0]) == COLUMNS + 2 * 8
    assert cut.components[2] == 1


@pytest.mark.parametrize("seam", [Seam(1.0, 0.3, 0.6), Seam(4.0, 0.5, 0.5, 1.2), Seam(5.5, 0.3, 0.7, -0.8)])
def test_an_open_seam_is_a_hole_inside(tube, seam):
    """If this fails, seams in the middle are no holes: upright, level and slanted."""
    cut = cut_seams(tube, Seams((seam,)))
    assert euler(cut) == -1
    assert sorted(len(loop) for loop in boundary_loops(cut.faces))[1:] == [COLUMNS, COLUMNS]
    edges = 0.5 * min(len(loop) for loop in boundary_loops(cut.faces))
    assert len(copies(cut)) == edges - 1  # both ends stay single
    on = cut.vertices[copies(cut)[:, 0]]
    along = np.mod(np.arctan2(on[:, 0], on[:, 2]) - min(seam.angle, seam.angle + seam.turn), 2 * np.pi)
    assert along.max() < abs(seam.turn) + 2 * np.pi / COLUMNS or along.min() > 2 * np.pi * (1 - 1 / COLUMNS)
    assert on[:, 1].min() > HEIGHT * (seam.low - 1 / ROWS)
    assert on[:, 1].max() < HEIGHT * (seam.high + 1 / ROWS)


def test_the_rest_shape_and_the_pins_stay(tube, dress):
    """If this fails, cutting stretches cloth, or lets go of what is pinned. Faces keep their corners, bit by bit."""
    for garment in (tube, dress):
        cut = cut_seams(garment, Seams((Seam(0.5, 0.0, 0.4), Seam(3.0, 0.2, 0.5))))
        np.testing.assert_array_equal(cut.vertices[cut.faces], garment.vertices[garment.faces])
        assert len(cut.vertices) == len(garment.vertices) + len(copies(cut))
    cut = cut_seams(tube, Seams((Seam(0.5, 0.0, 0.4),)))
    np.testing.assert_array_equal(cut.pins, np.flatnonzero(cut.vertices[:, 1] == 0))
    assert len(cut.pins) == COLUMNS + 1


@pytest.mark.parametrize("category", CATEGORIES)
def test_sampled_cuts_apply_to_any_mesh(category, dress):
    """If this fails, some random cuts tear garments apart or cannot be made. Slits keep the Euler characteristic."""
    rng = np.random.default_rng(11)
    for _ in range(6):
        seams = sampled_seams(rng, category)
        cut = cut_seams(dress, seams)
        holes = sum(seam.low > 0 for seam in seams.cuts)
        assert len(seams.cuts) >= 1
        assert euler(cut) == euler(dress) - holes
        assert len(boundary_loops(cut.faces)) == len(boundary_loops(dress.faces)) + holes
        assert cut.components[2] == 1


def test_cuts_are_a_function_of_the_seed(dress):
    """If this fails, a cut garment cannot be made again."""
    a, b = (sampled_seams(np.random.default_rng(5), "dress", 3) for _ in range(2))
    assert a == b
    assert len(a.cuts) == 3
    first, second = cut_seams(dress, a), cut_seams(dress, b)
    np.testing.assert_array_equal(first.faces, second.faces)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    others = {sampled_seams(np.random.default_rng(seed), "dress") for seed in range(12)}
    assert len(others) == 12  # ten to train on and two to test


def test_the_sides_of_a_cut_start_apart(tube):
    """If this fails, self-contact holds a slit together from the start. Both sides move by half of the distance."""
    cut = cut_seams(tube, Seams((Seam(0.5, 0.0, 0.4), Seam(3.0, 0.5, 0.5, 1.0))))
    start = parted(cut, cut.vertices, 0.008)
    assert start.dtype == np.float32
    moved = np.linalg.norm(start - cut.vertices, axis=1)
    free = np.setdiff1d(copies(cut).ravel(), cut.pins)
    np.testing.assert_allclose(moved[free], 0.004, rtol=1e-3)
    assert not moved[np.setdiff1d(np.arange(len(moved)), free)].any()
    pairs = copies(cut)[~np.isin(copies(cut), cut.pins).any(1)]
    assert np.linalg.norm(start[pairs[:, 0]] - start[pairs[:, 1]], axis=1).min() > 0.004


def test_a_cut_beside_the_garment_is_refused(tube):
    """If this fails, a data set says that garments are cut which are not."""
    half = tube.faces[(tube.vertices[tube.faces][:, :, 0] > 0).all(1)]
    used, faces = np.unique(half, return_inverse=True)
    left = Garment(tube.vertices[used], faces.reshape(-1, 3), name="left half")
    with pytest.raises(ValueError, match="cut 1 of 2 finds no path of two edges on garment 'left half'"):
        cut_seams(left, Seams((Seam(0.5 * np.pi, 0.0, 0.3), Seam(1.5 * np.pi, 0.0, 0.3))))
