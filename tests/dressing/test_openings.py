"""What a garment's openings are, in any unit, axis and place; and garments that have none for a body."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import meshes, scenes

import warpgarment as wg
from benchmarks.dressing.patterns import boxy_trousers, boxy_tshirt
from warpgarment.dressing.openings import openings_of, roles_of

TURNS = [[0, 0, 0], [np.pi / 2, 0, 0], [0.3, 1.2, -0.4]]


@pytest.mark.parametrize("turn", TURNS, ids=["upright", "on its back", "anyhow"])
def test_openings_are_told_apart_in_any_place(turn) -> None:
    """A sleeve would be taken for the neck once a garment lies on its back. Directions to 1e-5, lengths by hand."""
    rotation = Rotation.from_rotvec(turn)
    for garment, kind, top in ((boxy_tshirt(), "shirt", "neck"), (boxy_trousers(), "trousers", "waist")):
        points = 39.37 * rotation.apply(garment.vertices.astype(float)) + [30.0, -800.0, 5.0]
        roles = roles_of(points, garment.faces)
        assert roles.kind == kind
        np.testing.assert_allclose(roles.up, rotation.apply([0, 1, 0]), atol=1e-5)
        assert roles.across is not None
        assert abs(roles.across @ rotation.apply([1, 0, 0])) > 1 - 1e-9
        lengths = {name: one.length / 39.37 for name, one in roles.named.items()}
        wanted = (
            {"neck": 0.96, "cuff 1": 0.8, "cuff 2": 0.8, "hem": 1.28}
            if kind == "shirt"
            else {"waist": 1.12, "leg 1": 0.72, "leg 2": 0.72}
        )
        assert top in lengths
        assert lengths == pytest.approx(wanted, rel=1e-5)


def test_a_wide_hem_is_at_the_bottom() -> None:
    """A skirt would be put on upside down. The radii of the cone say which end is which."""
    vertices, faces = meshes.skirt()
    roles = roles_of(vertices, faces)
    assert roles.kind == "tube"
    assert roles.bottom is not None
    assert vertices[roles.top.vertices, 1].mean() > vertices[roles.bottom.vertices, 1].mean()


def test_holes_are_no_openings() -> None:
    """A buttonhole would be dressed as a sleeve. One face is cut out of a skirt of 1,824."""
    vertices, faces = scenes.tube(48, 20, bottom=-0.3, top=0.3)
    assert len(openings_of(vertices, np.delete(faces, 900, axis=0))) == 2


@pytest.mark.parametrize(("removed", "number"), [(0, "no opening"), (1, "one opening")])
def test_what_has_no_way_through_is_refused(removed: int, number: str) -> None:
    """A hat, or a closed mesh, would be blown up by the body inside."""
    ball = meshes.icosphere(1, radius=0.3)
    with pytest.raises(wg.DressingError, match=number):
        roles_of(ball.vertices, ball.faces[removed:])
