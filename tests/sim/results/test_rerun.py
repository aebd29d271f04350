"""If these failed, what a page shows live would be another simulation than `rollout` makes."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import network, simulator, skirt, walk

import warpgarment as wg
from warpgarment.errors import UsageError
from warpgarment.kernels.features.channels import OUTDOOR

FRAMES = 6


def _outdoor():
    """A network that reads material and wind, and answers to both."""
    return simulator(network(outdoor=OUTDOOR.names))


@pytest.mark.parametrize("given", [{}, {"wind": wg.Wind([0, 0, 1], [0, 4, 8])}, {"materials": wg.Material.denim()}])
def test_frames_are_those_of_a_rollout(given: dict):
    """Other frames: bit by bit those of `rollout` with the same arguments, at first and when run again."""
    made, garment, body = _outdoor(), skirt(), walk(FRAMES, 24.0)
    wanted = made.rollout(garment, body, **given)
    live = wg.Rerun(made, garment, body, **given)
    assert live.body.frames == wanted.frames
    for _ in range(2):
        frames = [positions for (positions,) in live.run(live.materials, live.wind)]
        np.testing.assert_array_equal(frames, wanted.vertices)


def test_settings_change_the_run():
    """Sliders and menus would do nothing."""
    made, garment, body = _outdoor(), skirt(), walk(FRAMES)
    live = wg.Rerun(made, garment, body, frames=4)
    assert live.body.frames == 4
    runs = [
        np.stack([positions for (positions,) in live.run(materials, wind)])
        for materials, wind in ((None, None), (None, wg.Wind([0, 0, 1], 8.0)), ([wg.Material.denim()], None))
    ]
    assert len(runs[0]) == 4
    for other in runs[1:]:
        assert np.abs(other[-1] - runs[0][-1]).max() > 1e-5


def test_outfits_and_first_positions():
    """An outfit would be simulated without its layers or materials, or from other first positions."""
    made, body = _outdoor(), walk(3)
    inner, outer = skirt(), wg.Garment(skirt().vertices * np.float32([1.15, 1, 1.15]), skirt().faces, name="outer")
    outfit = wg.Outfit([inner, outer], materials=[wg.Material.denim(), None])
    first = [garment.vertices * np.float32([1.02, 1.0, 1.02]) for garment in outfit]
    wanted = made.rollout(outfit, body, first_vertices=first)
    live = wg.Rerun(made, outfit, body, first_vertices=first)
    assert list(live.materials) == [wg.Material.denim(), None]
    for k, frame in enumerate(live.run(live.materials, None)):
        for positions, motion in zip(frame, wanted, strict=True):
            np.testing.assert_array_equal(positions, motion.vertices[k])


def test_what_cannot_be_is_refused():
    """Somebody would move sliders that do nothing, or wait for no frames."""
    plain = simulator(network())
    assert not wg.Rerun(plain, skirt(), walk(3)).reads
    with pytest.raises(ValueError, match="wind given"):
        wg.Rerun(plain, skirt(), walk(3), wind=wg.Wind([0, 0, 1], 1.0))
    with pytest.raises(ValueError, match="1 garments and 2 materials"):
        wg.Rerun(_outdoor(), skirt(), walk(3), materials=[None, None])
    with pytest.raises(UsageError, match="frames must be at least 1"):
        wg.Rerun(plain, skirt(), walk(3), frames=0)
