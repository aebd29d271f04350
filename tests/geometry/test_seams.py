"""If these failed, seams of pattern panels would open, or layers and openings would be welded."""

from __future__ import annotations

import time

import igl
import numpy as np
import pytest

from tests.support.meshes import irregular_grid
from warpgarment.geometry import seams
from warpgarment.geometry.clean import clean_mesh
from warpgarment.geometry.seams import SHARE, coinciding_borders


def panels(gap=0.0, tear=0.0):
    """An irregular sheet cut along a jagged line into two panels; the second is moved by `gap` [m] along Z.

    Vertices, faces, and the vertex of the uncut sheet for each [V].
    """
    sheet = irregular_grid()
    left = sheet.vertices[sheet.faces].mean(1)[:, 0] < sheet.vertices[:, 0].mean()
    vertices, faces, whole, base = [], [], [], 0
    for side, shift in ((left, 0.0), (~left, gap)):
        used, local = np.unique(sheet.faces[side], return_inverse=True)
        vertices.append(sheet.vertices[used] + [0, 0, shift])
        faces.append(local.reshape(-1, 3) + base)
        whole.append(used)
        base += len(used)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(whole)


@pytest.mark.parametrize("gap", [0.0, 1e-4])
def test_both_sides_of_a_seam_become_one(gap):
    """A seam would open, or other vertices would be joined. Exact: the sheet that was cut is what comes out."""
    vertices, faces, whole = panels(gap)
    seams = coinciding_borders(vertices, faces)
    twice = np.bincount(whole)[whole] > 1
    assert seams.sides == np.count_nonzero(twice) > 10
    assert (seams.apart, seams.between) == (0, 0)
    assert all(len(set(whole[seams.group == g])) == 1 for g in np.unique(seams.group))
    assert len(np.unique(seams.group)) == len(np.unique(whole))
    sewn = np.unique(seams.group[faces], return_inverse=True)[1].reshape(-1, 3)
    assert igl.euler_characteristic(sewn) == 1  # a disc


def test_what_is_farther_than_the_tolerance_stays_apart():
    """A slit with two sides would be welded shut."""
    vertices, faces, _ = panels()
    tolerance = coinciding_borders(vertices, faces).tolerance
    sheet = irregular_grid()
    corners = sheet.vertices[sheet.faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    edges = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).mean(1)
    assert tolerance == pytest.approx(SHARE * (area @ edges) / area.sum(), rel=1e-6)
    apart = panels(1.1 * tolerance)
    assert coinciding_borders(*apart[:2]).sides == 0


def test_layers_that_touch_stay_two():
    """The interior of a lining that lies on its cloth would be welded to it."""
    sheet = irregular_grid()
    count = len(sheet.vertices)
    smaller = sheet.vertices[sheet.faces].mean(1)
    middle = np.abs(smaller - smaller.mean(0))[:, :2] @ [1, 1] < 0.12  # a patch on the middle of the sheet
    used, local = np.unique(sheet.faces[middle], return_inverse=True)
    vertices = np.concatenate([sheet.vertices, sheet.vertices[used]])
    seams = coinciding_borders(vertices, np.concatenate([sheet.faces, local.reshape(-1, 3) + count]))
    assert seams.sides == 0
    doubled = np.concatenate([sheet.vertices, sheet.vertices]), np.concatenate([sheet.faces, sheet.faces + count])
    seams = coinciding_borders(*doubled)  # two whole sheets: their borders may be joined, nothing inside them
    inside = ~np.isin(np.arange(count), igl.boundary_loop(sheet.faces.astype(np.int64)))
    np.testing.assert_array_equal(seams.group[:count][inside], np.arange(count)[inside])
    np.testing.assert_array_equal(seams.group[count:][inside], np.arange(count, 2 * count)[inside])


def test_a_third_panel_is_left_apart_and_counted():
    """An edge would have three faces, and the garment be refused; or the third panel would go without a word."""
    vertices, faces, _ = panels()
    third = irregular_grid()
    left = third.vertices[third.faces].mean(1)[:, 0] < third.vertices[:, 0].mean()
    used, local = np.unique(third.faces[left], return_inverse=True)
    seam = coinciding_borders(vertices, faces)
    folded = third.vertices[used].astype(float)
    x = vertices[np.bincount(seam.group, minlength=len(vertices))[seam.group] > 1][:, 0].mean()
    far = np.abs(folded[:, 0] - x) > 0.05  # the same seam, and the rest of the panel 10 cm behind
    folded[far, 2] -= 0.1
    extra = local.reshape(-1, 3) + len(vertices)
    seams = coinciding_borders(np.concatenate([vertices, folded]), np.concatenate([faces, extra]))
    joined = seams.group[np.concatenate([faces, extra])]
    edges = np.sort(joined[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    assert seams.sides >= seam.sides - 2
    assert seams.apart > 10
    assert "left apart" in seams.unjoined()


def test_a_seam_with_other_vertices_on_one_side_is_counted():
    """A seam whose sides have 3 and 5 vertices would be half joined, unsaid."""
    y = np.linspace(0, 1, 3), np.linspace(0, 1, 5)
    left = np.concatenate([[[-1, v, 0] for v in y[0]], [[0, v, 0] for v in y[0]]])
    right = np.concatenate([[[0, v, 0] for v in y[1]], [[1, v, 0] for v in y[1]]])

    def strip(count, base):
        k = np.arange(count - 1)
        return (
            np.concatenate([np.stack([k, k + count, k + 1], 1), np.stack([k + 1, k + count, k + count + 1], 1)]) + base
        )

    seams = coinciding_borders(np.concatenate([left, right]), np.concatenate([strip(3, 0), strip(5, 6)]))
    assert (seams.sides, seams.places, seams.between) == (6, 3, 2)
    assert "Give both sides the same vertices" in seams.unjoined()


def test_short_edges_of_one_border_are_not_joined_with_each_other():
    """The rim of a button, finer than the tolerance of the cloth around it, would shrink to a point."""
    sheet = irregular_grid()
    turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    rim = np.stack([0.007 * np.cos(turn), 0.007 * np.sin(turn), 0 * turn + 0.01], 1)
    ring = np.concatenate([rim, 0.9 * rim + [0, 0, 0.001]])  # 0.2 mm along the rim, a tolerance of 2 mm
    k, n = np.arange(200), (np.arange(200) + 1) % 200
    band = np.concatenate([np.stack([k, n, k + 200], 1), np.stack([n, n + 200, k + 200], 1)])
    vertices = np.concatenate([sheet.vertices, ring])
    seams = coinciding_borders(vertices, np.concatenate([sheet.faces, band + len(sheet.vertices)]))
    assert seams.tolerance > 1e-3
    assert (seams.sides, seams.apart, seams.between) == (0, 0, 0)


def test_a_heap_of_triangles_takes_no_time():
    """A small file with all its triangles in one place would take minutes and gigabytes.

    3,000 triangles in 5 s of processor time.
    """
    vertices = np.random.default_rng(0).normal(0, 1, (9_000, 3))
    began = time.process_time()
    for scattered in (vertices, np.round(vertices, 0)):  # all across each other; some hundred at each place
        coinciding_borders(scattered, np.arange(9_000).reshape(-1, 3))
    assert time.process_time() - began < 5.0


def test_a_mesh_with_two_sides_is_cleaned_to_one():
    """Cloth exported with a back of its own, every triangle apart, would be sewn to a flat bag."""
    sheet = irregular_grid()
    corners = np.concatenate([sheet.faces, sheet.faces[:, ::-1]])
    cleaned = clean_mesh(sheet.vertices[corners].reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    assert (len(cleaned.vertices), len(cleaned.faces)) == (len(sheet.vertices), len(sheet.faces))
    assert cleaned.dropped == len(sheet.faces)
    assert f"{len(sheet.faces)} of {2 * len(sheet.faces)} faces are dropped" in cleaned.message("it")


def test_few_and_many_vertices_are_joined_alike(monkeypatch):
    """A garment with a few vertices more on its borders would be joined in another way: pairs of few are all looked at,
    and a tree is asked for those of many."""
    vertices, faces = irregular_grid(8, 5)
    rng = np.random.default_rng(0)
    apart = vertices[faces].reshape(-1, 3) + rng.normal(size=(3 * len(faces), 3)) * 0.01 * np.ptp(vertices) / 8
    both = []
    for few in (0, 10_000):
        monkeypatch.setattr(seams, "FEW", few)
        both.append(coinciding_borders(apart, np.arange(len(apart)).reshape(-1, 3)))
    one, other = both
    np.testing.assert_array_equal(one.group, other.group)
    assert one[1:] == other[1:]
    assert 0 < len(np.unique(one.group)) < len(apart)
