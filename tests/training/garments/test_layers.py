"""Figures of layers on sheets whose answer is known."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import trimesh

from warpgarment.metrics import layer_collision
from warpgarment.objects.garment import Garment
from warpgarment.training.garments.layers import LayerFigures, Sheet
from warpgarment.training.generate.quality import Limits, QualityGate


def _sheet(height: float, cells: int = 10, size: float = 0.4) -> Garment:
    """A square parallel to the XZ plane whose outside is up."""
    grid, faces = igl.triangulated_grid(cells + 1, cells + 1)[:2]
    grid = np.asarray(grid, float) * size
    vertices = np.stack([grid[:, 0], np.full(len(grid), height), grid[:, 1]], 1)
    corners = vertices[np.asarray(faces)[0]]
    up = np.cross(corners[1] - corners[0], corners[2] - corners[0])[1] > 0
    return Garment(vertices, np.asarray(faces) if up else np.asarray(faces)[:, ::-1])


def _overlaps(a: np.ndarray, fa: np.ndarray, b: np.ndarray, fb: np.ndarray) -> np.ndarray:
    """Crossing pairs of faces by libigl's own test of two triangles, in millimetres, one pair after another."""
    a, b = a.astype(float) * 1e3, b.astype(float) * 1e3
    found = np.zeros((len(fa), len(fb)), bool)
    for i, f in enumerate(fa):
        near = (a[f].min(0) <= b[fb].max(1)).all(1) & (a[f].max(0) >= b[fb].min(1)).all(1)
        for j in np.flatnonzero(near):
            found[i, j] = igl.tri_tri_overlap_test_3d(*(p[None] for p in (*a[f], *b[fb[j]])))
    return found


def test_parallel_sheets_have_nothing_inside():
    """If this fails, layers that never touch are called crossed."""
    inner, outer = _sheet(0.0), _sheet(0.005)
    figures = LayerFigures([inner, outer]).measure([inner.vertices, outer.vertices])
    assert figures == {"layer_inside": 0.0, "layer_inside_1": 0.0, "layer_crossings": 0.0, "layer_depth": 0.0}


def test_a_corner_pushed_through_counts_with_its_depth():
    """If this fails, cloth that went through another goes unseen, or the border of a sheet counts as its inside."""
    inner, outer = _sheet(0.0), _sheet(0.005)
    pushed = outer.vertices.copy()
    low = (pushed[:, 0] < 0.13) & (pushed[:, 2] < 0.13)
    pushed[low, 1] = -0.008
    past_border = low & ((pushed[:, 0] == 0) | (pushed[:, 2] == 0))  # their closest point is on the inner's border
    figures = LayerFigures([inner, outer]).measure([inner.vertices, pushed])
    expected = (low.sum() - past_border.sum()) / len(pushed)
    assert low.sum() == 16
    assert past_border.sum() == 7
    assert figures["layer_inside"] == pytest.approx(expected, abs=1e-12)
    assert figures["layer_depth"] == pytest.approx(0.008, abs=1e-7)  # float32 positions
    twin = layer_collision(pushed, inner.vertices, inner.faces)
    assert figures["layer_inside"] == pytest.approx(twin, abs=1e-12)


def test_what_is_beyond_the_reach_does_not_count():
    """If this fails, one part of an outfit is measured against another far from it."""
    inner, outer = _sheet(0.0), _sheet(-0.04)
    assert LayerFigures([inner, outer]).measure([inner.vertices, outer.vertices])["layer_inside"] == 0.0
    close = LayerFigures([inner, outer], reach=0.05).measure([inner.vertices, outer.vertices])
    assert close["layer_inside"] == pytest.approx(81 / 121)  # 11 by 11 vertices, 40 of them on the border
    assert close["layer_crossings"] == close["layer_depth"] == 0.0


def test_a_peak_of_the_inner_sheet_through_one_face_of_the_outer():
    """If this fails, an inner vertex that pokes through a face goes unseen. By hand: the peak's six faces cross it."""
    inner, outer = _sheet(0.0, cells=12), _sheet(0.004, cells=1)
    peak = inner.vertices.copy()
    tip = int(np.argmin(((peak[:, [0, 2]] - [0.2667, 0.1]) ** 2).sum(1)))  # inside one of the outer sheet's two faces
    peak[tip, 1] = 0.016
    figures = LayerFigures([inner, outer]).measure([peak, outer.vertices])
    assert figures["layer_inside"] == 0.0
    assert figures["layer_crossings"] == 6
    assert figures["layer_depth"] == pytest.approx(0.012, abs=1e-7)


def test_crossings_are_those_of_an_independent_test():
    """If this fails, a crossing is missed or made up. Twin: libigl's triangle test over all pairs; exact."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    faces = np.asarray(ball.faces)
    a = np.asarray(ball.vertices, np.float32)
    b = (a + np.random.default_rng(0).normal(size=a.shape) * 0.003 + [0.02, 0.005, 0.01]).astype(np.float32)
    twin = _overlaps(a, faces, b, faces)
    np.testing.assert_array_equal(Sheet(faces).crossings(a, Sheet(faces), b), twin.sum(1))
    assert twin.sum() > 50

    rough = (a + np.random.default_rng(1).normal(size=a.shape) * 0.02).astype(np.float32)
    own = _overlaps(rough, faces, rough, faces)
    shared = (faces[:, None, :, None] == faces[None, :, None, :]).any((2, 3))
    assert Sheet(faces).self_crossings(rough).sum() == (own & ~shared).sum() / 2
    assert Sheet(faces).self_crossings(a).sum() == 0


def test_the_gap_between_two_sheets():
    """If this fails, sheets are called further apart than they are. By hand: two edges crossing at a distance."""
    flat = np.array([[0, 0, 0], [1, 0, 0], [0.5, -1, 0]], np.float32)
    above = np.array([[0.5, 0.01, -0.5], [0.5, 0.01, 0.5], [0.5, 1, 0]], np.float32)
    sheet = Sheet(np.array([[0, 1, 2]]))
    assert sheet.gap_to(flat, sheet, above) == pytest.approx(0.01, abs=1e-7)
    inner, outer = _sheet(0.0), _sheet(0.005)
    gap = Sheet(inner.faces).gap_to(inner.vertices, Sheet(outer.faces), outer.vertices)
    assert gap == pytest.approx(0.005, abs=1e-7)


def test_figures_of_three_layers_and_of_one():
    """If this fails, a garment is compared with those outside it, or a single one with nothing."""
    sheets = [_sheet(h) for h in (0.0, 0.01, 0.005)]  # the third lies behind the second
    figures = LayerFigures(sheets).measure([s.vertices for s in sheets])
    assert figures["layer_inside_1"] == 0.0
    assert figures["layer_inside_2"] == pytest.approx(81 / 121)
    assert figures["layer_inside"] == pytest.approx(81 / 242)
    assert LayerFigures(sheets[:1]).measure([sheets[0].vertices]) == {}
    with pytest.raises(ValueError, match="3 garments have been announced, 2 are given"):
        LayerFigures(sheets).measure([s.vertices for s in sheets[:2]])
    broken = sheets[0].vertices * np.nan
    assert np.isnan(LayerFigures(sheets[:2]).measure([broken, sheets[1].vertices])["layer_inside"])


def test_crossings_of_a_sequence_are_told():
    """If this fails, a set's manifests hide how often the garments of its outfits go through each other."""
    inner, outer = _sheet(0.0), _sheet(0.005)
    pushed = outer.vertices.copy()
    pushed[(pushed[:, 0] < 0.13) & (pushed[:, 2] < 0.13), 1] = -0.008
    pushed += [0.0037, 0.0, 0.0023]  # where edges lie on edges, whether they cross is a matter of rounding
    pairs = int(_overlaps(inner.vertices, inner.faces, pushed, outer.faces).sum())
    ball = trimesh.creation.icosphere(radius=0.1)
    far = np.asarray(ball.vertices) - 5.0
    gate = QualityGate((inner, outer), np.asarray(ball.faces), Limits(layer_inside=1.0), every=1)
    for frame, moved in enumerate((outer.vertices, pushed, outer.vertices, outer.vertices)):
        assert gate.check(frame, np.concatenate([inner.vertices, moved]), far) is None
    figures = gate.figures(4)
    assert pairs > 10
    assert figures["layer_crossings"] == pairs
    assert figures["layer_crossings_mean"] == pairs / 4
    assert figures["layer_crossed"] == 0.25
    assert "layer_crossed" not in QualityGate((inner,), np.asarray(ball.faces)).figures(0)
