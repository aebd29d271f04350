"""Pins by names, by colour, and at the waist."""

from __future__ import annotations

import numpy as np
import pytest
from support import scenes
from support.dressed import write_panels

import warpgarment as wg
from warpgarment.dressing.openings import roles_of
from warpgarment.dressing.pins import find_pins
from warpgarment.io.surface.record import Labels, Material, Surface


def _skirt(group: str = "", material: str = "cloth", pins=None) -> wg.Garment:
    """A skirt of 16 x 6 squares whose uppermost row of faces is a group and a red material."""
    plain = scenes.skirt()
    upper = np.zeros(len(plain.faces), np.int32)
    upper[:32] = 1
    surface = Surface(
        np.full(len(plain.faces), 3),
        plain.faces.reshape(-1),
        materials=(Material("body"), Material(material, color=(1.0, 0.0, 0.0))),
        material=upper,
        groups=Labels(("rest", group), upper) if group else None,  # type: ignore[arg-type]
    )
    return wg.Garment(plain.vertices, plain.faces, surface=surface, pins=pins)


TWO_RINGS, ONE_RING = np.arange(32), np.arange(16)  # the tube's rings begin at its top


@pytest.mark.parametrize(
    ("garment", "wanted", "found"),
    [
        (_skirt(), None, []),
        (_skirt("Waist_Band.001"), None, TWO_RINGS),
        (_skirt(material="elastic"), None, TWO_RINGS),
        (_skirt("Waistband"), "none", []),
        (_skirt("upper part"), "UPPER", TWO_RINGS),
        (_skirt(), "#ff0000", TWO_RINGS),
        (_skirt(), "waist", ONE_RING),
        (_skirt(pins=[5, 3]), None, [3, 5]),
        (_skirt("opinion"), None, []),
    ],
    ids=["no name", "group", "material", "none", "part of a name", "colour", "waist", "its own", "a word in a word"],
)
def test_pins_are_found(garment, wanted, found) -> None:
    """A waistband would slide, or a whole garment be pinned. Indices of the rings of the tube, by hand."""
    pins, where = find_pins(garment, roles_of(garment.vertices, garment.faces), wanted)
    np.testing.assert_array_equal(pins, found)
    assert (where == "none") == (len(found) == 0)


@pytest.mark.parametrize("wanted", ["collar", "#00ff00"])
def test_pins_that_are_not_there_are_refused(wanted) -> None:
    """A slip of the pen would leave a garment without pins."""
    garment = _skirt("band")
    with pytest.raises(wg.DressingError, match="it has band, rest, body, cloth"):
        find_pins(garment, roles_of(garment.vertices, garment.faces), wanted)


def test_seams_stay_joined_and_pinned_where_a_garment_is_moved(tmp_path) -> None:
    """The seams of a garment would open, or its pins be lost, once it is moved. Positions to 1e-5 m, by hand; a mirror
    is refused."""
    garment = wg.Garment.load(write_panels(tmp_path / "panels.obj"), clean=True)
    moved = garment.transformed(2.0 * np.eye(3), [1.0, 0.0, 0.0], pins=[0])
    simulated = moved.simulated
    assert len(simulated.garment.vertices) < len(moved.vertices)
    wanted = 2.0 * garment.vertices + np.float32([1.0, 0.0, 0.0])
    np.testing.assert_allclose(moved.vertices, wanted, atol=1e-5)
    np.testing.assert_allclose(simulated.restored(simulated.garment.vertices), wanted, atol=1e-5)
    assert len(simulated.garment.pins) == 1
    np.testing.assert_allclose(simulated.garment.vertices[simulated.garment.pins[0]], wanted[0], atol=1e-5)
    with pytest.raises(wg.MeshError, match="mirrors"):
        garment.transformed(np.diag([1.0, 1.0, -1.0]))
