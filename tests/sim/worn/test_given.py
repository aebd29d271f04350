"""Outfits as arguments: simulated as their garments in layers, with results in the shape they were given in."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import body, network, simulator, skirt, tube, walk

from warpgarment.errors import UsageError
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.outfit import Outfit
from warpgarment.sim.worn.given import numbered, unfolded


def layered(gap: float = 0.012) -> list[Garment]:
    """Two skirts over each other, `gap` [m] apart."""
    shapes = [tube(16, 7, bottom=-0.3, top=0.3 - 0.01 * k, radius=(0.3 + gap * k, 0.19 + gap * k)) for k in (0, 1)]
    return [Garment(*shape, name=name) for shape, name in zip(shapes, ("under", "over"), strict=True)]


def test_an_outfit_is_its_garments_in_layers():
    """Garments of an outfit would not see each other. The same bits as of a list with `layers=True`; a list of outfits
    gives those of a list of all garments, outfit after outfit, and of one outfit alone its own frames to 0.1 mm."""
    one, other, motion = layered(), layered(0.02), walk(4)
    listed = simulator(network()).rollout(one, motion, layers=True)
    worn = simulator(network()).rollout(Outfit(one), motion)
    for a, b in zip(worn, listed, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        assert a.status[-1].layer_crossings == 0
    turned = body(4, turn=lambda t: (0.0, -0.05 * t, 0.0))
    bodies = [motion, motion, turned, turned]
    together = simulator(network()).rollout([*one, *other], bodies, layers=[[0, 1], [2, 3]])
    nested = simulator(network()).rollout([Outfit(one), Outfit(other)], [motion, turned])
    assert [[m.name for m in outfit] for outfit in nested] == [["under", "over"]] * 2
    for a, b in zip([m for outfit in nested for m in outfit], together, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
    for a, b in zip(nested[0], worn, strict=True):
        assert np.abs(a.vertices - b.vertices).max() < 1e-4


def test_first_vertices_of_outfits():
    """Positions would go to other garments: frame 0 is what was given, a list for each outfit."""
    outfits = [Outfit(layered()), Outfit([skirt()])]
    first = [[g.vertices + np.float32([0, 0.01 * (k + 1), 0]) for k, g in enumerate(outfit)] for outfit in outfits]
    found = simulator(network()).rollout(outfits, walk(2), first_vertices=first)
    for motions, arrays in zip(found, first, strict=True):
        for motion, array in zip(motions, arrays, strict=True):
            np.testing.assert_array_equal(motion.vertices[0], array)
    with pytest.raises(UsageError, match=r"outfits of \[2, 1\] garments, and first_vertices or history of \[1, 1\]"):
        simulator(network()).rollout(outfits, walk(2), first_vertices=[first[0][:1], first[1]])


def test_a_stream_of_an_outfit():
    """`start` would not take an outfit, or do without its layers."""
    motion, sim = walk(3), simulator(network())
    state = sim.start(Outfit(layered()), motion.vertices[0], motion.faces)
    state = sim.step(state, motion.vertices[1])
    assert [status.layer_crossings for status in state.status] == [0, 0]
    with pytest.raises(UsageError, match="start takes one outfit"):
        sim.start([Outfit(layered())], motion.vertices[0], motion.faces)


def test_outfits_do_not_share_a_body():
    """A network that takes all garments on a body for one outfit would mix two of them; a garment alone keeps its."""
    motion = walk(2)
    told = unfolded([Outfit(layered()), Outfit([skirt()])], motion, None, None)
    _, on = numbered(told.body)
    assert on == [0, 0, 1]
    assert told.layers == [[0, 1], [2]]
    assert numbered([motion, walk(2), motion])[1] == [0, 1, 0]


def test_materials_of_outfits():
    """A material would be that of another garment, or of none."""
    cotton, denim = Material.cotton(), Material.denim()
    assert unfolded(Outfit(layered()), None, None, None).materials is None
    assert unfolded(Outfit(layered(), [None, denim]), None, None, None).materials == [None, denim]
    outfits = [Outfit(layered()), Outfit([skirt()], cotton)]
    assert unfolded(outfits, walk(2), None, None).materials == [None, None, cotton]
    assert unfolded([Outfit(layered()), Outfit([skirt()])], walk(2), None, denim).materials == denim
    with pytest.raises(ValueError, match="materials given, but this ManifoldAwareTransformer reads none"):
        simulator(network()).rollout(Outfit(layered(), denim), walk(2))


@pytest.mark.parametrize(
    ("garment", "options", "message"),
    [
        (Outfit(layered()), {"layers": [[0, 1]]}, "layers beside an outfit"),
        (Outfit(layered(), Material()), {"materials": Material()}, "materials beside an outfit that has its own"),
        ([Outfit(layered()), skirt()], {}, "a list of outfits and garments; make an outfit of each"),
        ([Outfit(layered()), Outfit([skirt()])], {"materials": [None] * 3}, "give them to each"),
    ],
)
def test_arguments_that_say_it_twice_are_refused(garment, options, message):
    """One of two answers would be taken without a word."""
    with pytest.raises(UsageError, match=message):
        simulator(network()).rollout(garment, walk(2), **options)


def test_numbers_of_bodies():
    """The second outfit would be on the first one's body."""
    with pytest.raises(UsageError, match="2 outfits and 3 bodies"):
        simulator(network()).rollout([Outfit([skirt()]), Outfit([skirt()])], [walk(2)] * 3)


def test_layers_of_an_outfit_can_be_turned_off():
    """An outfit could not be compared with itself without contact."""
    motions = simulator(network()).rollout(Outfit(layered()), walk(2), layers=False)
    assert [m.status[-1].layer_crossings for m in motions] == [None, None]
