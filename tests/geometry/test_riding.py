"""If these failed, buttons would drift off the cloth, or pieces of cloth would be carried like buttons."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.meshes import irregular_grid
from warpgarment.geometry.riding import Carried, loose_pieces

SHEET = irregular_grid(30, 20)  # 0.6 x 0.4 m, edges of 2 cm
COUNT = len(SHEET.vertices)


def disc(middle, radius=0.007, height=0.003):
    """A button in the plane of the sheet."""
    turn = np.arange(8) * np.pi / 4
    rim = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], 1)
    vertices = np.concatenate([[[0, 0, 0]], rim]) + [*middle, height]
    k = np.arange(8)
    return vertices, np.stack([0 * k, 1 + k, 1 + (k + 1) % 8], 1)


def band(length, width=0.01, height=0.002, parts=40):
    """A zip along X, in the middle of the sheet."""
    x = SHEET.vertices[:, 0].mean() + np.linspace(-length / 2, length / 2, parts + 1)
    y = SHEET.vertices[:, 1].mean()
    vertices = np.concatenate([np.stack([x, 0 * x + y + s * width / 2, 0 * x + height], 1) for s in (-1, 1)])
    k = np.arange(parts)
    return vertices, np.concatenate(
        [np.stack([k, k + 1, k + parts + 1], 1), np.stack([k + 1, k + parts + 2, k + parts + 1], 1)]
    )


def with_sheet(*pieces):
    vertices, faces, base = [SHEET.vertices], [SHEET.faces], COUNT
    for v, f in pieces:
        vertices.append(v)
        faces.append(f + base)
        base += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


MIDDLE = SHEET.vertices[:, :2].mean(0)


def test_buttons_are_rigid_zips_bend_and_cloth_is_left_alone():
    """A button would be simulated, a zip be carried as a plank, or a second panel as a button."""
    vertices, faces = with_sheet(disc(MIDDLE), disc(MIDDLE + 0.1), band(0.4))
    loose = loose_pieces(vertices, faces)
    assert (loose.pieces, loose.far) == (3, 0)
    np.testing.assert_array_equal(loose.unit, np.r_[np.full(COUNT, -1), np.repeat([0, 1], 9), 2 + np.arange(82)])
    far = disc(MIDDLE, height=0.05)
    assert loose_pieces(*with_sheet(far))[1:] == (0, 1)
    panel = SHEET.vertices + [0.65, 0, 0.001], SHEET.faces
    assert loose_pieces(*with_sheet(panel))[1:] == (0, 0)
    assert loose_pieces(SHEET.vertices, SHEET.faces)[1:] == (0, 0)
    held = loose_pieces(vertices, faces, held=np.array([COUNT + 3]))
    assert held.pieces == 2
    assert (held.unit[COUNT : COUNT + 9] == -1).all()


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_pieces_are_small_beside_the_garment(scale):
    """A doll's dress, or one in centimetres, would have other buttons."""
    vertices, faces = with_sheet(disc(MIDDLE), band(0.4), disc(MIDDLE, height=0.05))
    np.testing.assert_array_equal(loose_pieces(scale * vertices, faces).unit, loose_pieces(vertices, faces).unit)


def test_what_is_rigid_in_the_cloth_is_exact():
    """Carried pieces would lag or turn in another way than cloth that moves without bending. 1e-9 m: float64."""
    pieces = disc(MIDDLE), disc(MIDDLE + 0.1, height=-0.002), band(0.4)
    points = np.concatenate([v for v, _ in pieces])
    unit = np.r_[np.repeat([0, 1], 9), 2 + np.arange(82)]
    carried = Carried(points, unit, SHEET.vertices, SHEET.faces)
    np.testing.assert_allclose(carried.at(SHEET.vertices), points, atol=1e-9)
    turn = Rotation.from_rotvec([0.4, -2.0, 1.1])
    expected = turn.apply(points) + [3.0, -1.0, 0.5]
    np.testing.assert_allclose(carried.at(turn.apply(SHEET.vertices) + [3.0, -1.0, 0.5]), expected, atol=1e-9)


def test_on_bent_cloth_a_button_lies_flat_and_a_zip_follows():
    """A button would be stretched or stand off the cloth, or a zip cut through it.

    The sheet becomes a cylinder of 10 cm radius r. A point at height h above it belongs at r + h; the cloth's own faces
    lie up to L^2 / 8r below it, where L is their longest edge, and the rim of a flat button of 7 mm 0.25 mm above it.
    """
    radius, middle = 0.1, SHEET.vertices[:, 0].mean()
    corners = SHEET.vertices[SHEET.faces].astype(float)
    sag = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max() ** 2 / (8 * radius)

    def bent(p):
        angle, r = (p[:, 0] - middle) / radius, radius + p[:, 2]
        return np.stack([r * np.sin(angle), p[:, 1], r * np.cos(angle)], 1)

    flat = SHEET.vertices * [1, 1, 0]
    button, zipped = disc(MIDDLE + [0.1, 0.0])[0], band(0.4)[0]
    carried = Carried(np.concatenate([button, zipped]), np.r_[np.zeros(9, int), 1 + np.arange(82)], flat, SHEET.faces)
    moved = carried.at(bent(flat))
    distances = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (moved[:9], button)]
    np.testing.assert_allclose(*distances, atol=1e-12)  # rigid
    height = np.hypot(moved[:, 0], moved[:, 2]) - radius
    assert np.abs(height[:9] - 0.003).max() < sag + 3e-4
    assert np.abs(height[9:] - 0.002).max() < sag
    expected = bent(np.concatenate([button, zipped]))
    assert np.linalg.norm(moved - expected, axis=1).max() < 2e-3


def test_one_trembling_vertex_hardly_turns_a_button():
    """Noise of a single triangle would be passed on: it would turn by atan(2 mm / 2 cm), 0.1 rad."""
    button = disc(MIDDLE)[0]
    carried = Carried(button, np.zeros(9, int), SHEET.vertices, SHEET.faces)
    nearest = np.argsort(np.linalg.norm(SHEET.vertices[:, :2] - MIDDLE, axis=1))[0]
    moved = SHEET.vertices.copy()
    moved[nearest, 2] += 0.002
    normal = np.cross(*(carried.at(moved)[[1, 3]] - carried.at(moved)[0]))
    assert np.arccos(abs(normal[2]) / np.linalg.norm(normal)) < 0.04


def test_cloth_that_has_failed_gives_nan():
    """A rollout that stops would end in an error of linear algebra."""
    carried = Carried(disc(MIDDLE)[0], np.zeros(9, int), SHEET.vertices, SHEET.faces)
    assert np.isnan(carried.at(np.full_like(SHEET.vertices, np.nan))).all()


def test_a_frame_taken_as_the_first_comes_back():
    """A button would jump from where the user draped it to where it was at rest. 1e-12 m: float64."""
    carried = Carried(disc(MIDDLE)[0], np.zeros(9, int), SHEET.vertices, SHEET.faces)
    draped, cloth = disc(MIDDLE + 0.003, height=0.005)[0], SHEET.vertices + [0, 0, 1.0]
    carried.bind(draped + [0, 0, 1.0], cloth)
    np.testing.assert_allclose(carried.at(cloth), draped + [0, 0, 1.0], atol=1e-12)
