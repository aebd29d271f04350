"""Outfits in the wrong order are told by name, and others are not."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from support.scenes import network, simulator, skirt, tube, walk

from warpgarment.objects.garment import Garment
from warpgarment.objects.outfit import Outfit


def layered(gap: float, wind: bool = False) -> list[Garment]:
    """Two skirts over each other, `gap` [m] apart; the first wound the other way round if `wind`."""
    made = []
    for k, name in enumerate(("under", "over")):
        vertices, faces = tube(16, 7, bottom=-0.3, top=0.3 - 0.01 * k, radius=(0.3 + gap * k, 0.19 + gap * k))
        made.append(Garment(vertices, faces[:, ::-1] if wind else faces, name=name))
    return made


def told(garments, **options) -> list[str]:
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        simulator(network()).rollout(garments, walk(2), **options)
    return [str(w.message) for w in heard if "beneath" in str(w.message)]


@pytest.mark.parametrize("wind", [False, True])
def test_garments_in_the_wrong_order_are_told_by_name(wind):
    """The outer garment would be squeezed under the inner one, and the network be blamed; or garments in order would be
    complained about. All vertices of the narrow skirt lie beneath the wide one, however their faces are wound."""
    under, over = layered(0.012, wind)
    assert told(Outfit([under, over])) == []
    (message,) = told(Outfit([over, under]))
    assert message.startswith("under is given over over, but lies beneath it at the start: ")
    assert "(100%)" in message
    assert "innermost first, under before over" in message
    (message,) = told([skirt(), over, under], layers=[[0], [1, 2]])
    assert message.startswith("under is given over over")


def test_a_stream_is_told_too():
    """Live bodies would get no warning."""
    under, over = layered(0.012)
    motion = walk(2)
    with pytest.warns(RuntimeWarning, match="under is given over over"):
        simulator(network()).start([over, under], motion.vertices[0], motion.faces, layers=True)


def test_garments_that_hardly_meet_have_no_order():
    """A top and trousers, one under the other, would be complained about: they are beside each other. Neither would
    independent garments, nor those too far from each other."""
    upper, lower = (Garment(*tube(16, 5, bottom=a, top=b), name=n) for a, b, n in ((0.05, 0.3, "u"), (-0.3, 0.0, "l")))
    assert told(Outfit([upper, lower])) == told(Outfit([lower, upper])) == []
    under, over = layered(0.012)
    assert told([over, under]) == []
    assert told(Outfit([over, under]), layers=False) == []
    assert told(Outfit(layered(0.06)[::-1])) == []


def test_only_most_of_a_garment_counts():
    """A garment whose hem dips under the next one would be taken for the wrong order: here a quarter of its vertices
    lie beneath. With most of them it is told, with their share to 2 %."""
    under, over = layered(0.012)
    for share, expected in ((0.25, 0), (0.75, 1)):
        vertices = over.vertices.copy()
        rows = vertices[:, 1] <= np.quantile(vertices[:, 1], share)
        radius = np.linalg.norm(vertices[rows][:, [0, 2]], axis=1, keepdims=True)
        vertices[np.ix_(rows, [0, 2])] *= (radius - 0.024) / radius
        found = told(Outfit([under, Garment(vertices, over.faces, name="dipping")]))
        assert len(found) == expected
    percent = float(found[0].split("(")[1].split("%")[0])
    assert abs(percent - 100 * rows.mean()) < 2
