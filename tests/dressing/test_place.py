"""Units, axes, turns and places that are guessed, and said."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warpgarment as wg
from warpgarment.dressing.guesses import Told
from warpgarment.dressing.limbs import limbs_of
from warpgarment.dressing.openings import roles_of
from warpgarment.dressing.place import placed


@pytest.fixture(scope="module")
def scene():
    """The bundled body, its limbs, and the bundled T-shirt."""
    assets = wg.demo.assets()
    at, faces = assets.collider.vertices[0].astype(float), assets.collider.faces
    return at, faces, limbs_of(at, faces), assets.garments["tshirt"].garment


def _placed(scene, points: np.ndarray, told: Told | None = None, **more):
    at, faces, limbs, garment = scene
    return placed(points, roles_of(points, garment.faces), at, faces, limbs, told or Told(), **more)


ZUP = Rotation.from_euler("x", 90, degrees=True)  # Y up to Z up


@pytest.mark.parametrize(
    ("unit", "rotation", "up", "said"),
    [
        ("cm", Rotation.identity(), "y", ["cm is assumed"]),
        ("mm", ZUP, "z", ["mm is assumed", "Z points up"]),
        ("in", Rotation.identity(), "y", ["in is assumed"]),
        ("m", ZUP * Rotation.from_euler("y", 40, degrees=True), "z", ["Z points up"]),
        ("m", Rotation.from_euler("y", -30, degrees=True), "y", []),
    ],
)
def test_a_garment_comes_to_the_same_place_from_anywhere(scene, unit, rotation, up, said) -> None:
    """A garment in inches, or with Z up, would arrive as a giant, or lying down. Places to 2 mm of the garment as it
    was; every guess is told, and nothing else is."""
    metres = wg.Garment(*meshless(scene)).vertices.astype(float)
    numbers = rotation.apply(metres) / {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}[unit] + [40.0, -3.0, 7.0]
    found, own = _placed(scene, numbers), _placed(scene, metres)
    np.testing.assert_allclose(found.at(numbers), own.at(metres), atol=2e-3)
    assert (found.unit, found.up) == (unit, up)
    assert len(found.notes) == len(said)
    assert all(any(words in note for note in found.notes) for words in said)


def meshless(scene) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the T-shirt."""
    return scene[3].vertices, scene[3].faces


def test_what_the_user_says_is_not_guessed(scene) -> None:
    """An option would be overruled. Exact: the scale, and a turn by 180 degrees about the vertical."""
    points = scene[3].vertices.astype(float)
    given = _placed(scene, points, unit="m", turn=180.0, scale=1.1)
    assert given.scale == pytest.approx(1.1)
    np.testing.assert_allclose(given.rotation, np.diag([-1.0, 1.0, -1.0]), atol=1e-12)
    assert given.unit_from == "given"
    left = _placed(scene, points, move=False)
    np.testing.assert_array_equal(left.shift, 0.0)
    # a file that was turned from Z to Y is turned back where the user says Y
    back = _placed(scene, points, Told(up="z", up_from="from the file"), up="y")
    np.testing.assert_allclose(back.rotation @ [0, 1, 0], [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(("size", "words"), [(0.5, "too small"), (3.5, "too large")])
def test_a_garment_of_another_size_is_refused_with_the_scale_that_helps(scene, size, words) -> None:
    """A child's shirt would be torn, or a giant's be called dressed. The scale in the message is taken, and helps."""
    points = size * scene[3].vertices.astype(float)
    with pytest.raises(wg.DressingError, match=words) as error:
        _placed(scene, points, unit="m")
    scale = float(str(error.value).split("scale=")[1].split()[0])
    assert _placed(scene, points, unit="m", scale=scale).resized == pytest.approx(1 / size, rel=0.3)
    assert _placed(scene, points, unit="m", scale="fit").resized == pytest.approx(scale, rel=1e-2)
