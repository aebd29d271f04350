"""If these failed, a garment would not lie in its shot frame by frame, or stick in the body between frames."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.scenes import Failing, body, network, nowhere_deeper, outfit, simulator, skirt, still, walk
from warpgarment.errors import MeshError, UsageError
from warpgarment.nn.config import NetworkConfig
from warpgarment.objects.body import BodyMotion

TINY = {"embedding": 16, "layers": 1, "feed_forward": 16, "heads": 2, "manifold_heads": 1, "history": 3, "dropout": 0.0}


def shot(motion, fps=24.0, start=1001 / 24):
    return BodyMotion(motion.vertices, motion.faces, fps, start=start)


@pytest.mark.parametrize("fps", [23.976, 24.0, 25.0, 29.97, 59.94, 60.0, 120.0])
def test_every_frame_of_the_shot_has_its_garment(fps):
    """A garment would be a frame short, or begin at 0."""
    sim, motion = simulator(network()), shot(walk(13), fps, start=1001 / fps)
    result = sim.rollout(skirt(), motion, out_fps="body")
    assert (result.frames, result.fps, result.start) == (13, fps, motion.start)
    np.testing.assert_allclose(result.clock.times, motion.clock.times, atol=1e-9)
    assert [s.frame for s in result.status] == list(range(13))
    plain = sim.rollout(skirt(), motion)
    assert (plain.fps, plain.start) == (30.0, motion.start)
    assert plain.clock.end == pytest.approx(motion.clock.end)
    assert np.array_equal(result.vertices[[0, -1]], plain.vertices[[0, -1]])
    assert result.status[-1].max_penetration == plain.status[-1].max_penetration
    assert sim.rollout(skirt(), motion, out_fps="body", frames=4).frames == 4
    assert sim.rollout(skirt(), motion, out_fps="body", frames=99).frames == 13


def test_at_the_networks_rate_nothing_changes():
    """Results of before could not be made again. Exact."""
    sim, motion = simulator(network()), walk(6)
    first = sim.rollout(skirt(), motion)
    for again in (sim.rollout(skirt(), motion, out_fps="body"), sim.rollout(skirt(), shot(motion, 30.0), out_fps=30)):
        assert np.array_equal(again.vertices, first.vertices)
        assert again.status == first.status


def test_frames_lie_between_those_of_the_network():
    """A frame of the shot would show the garment of another moment. By np.interp, where the body is too far to touch
    it, to float32 rounding, 1e-6 m."""
    sim = simulator(network(), collision_passes=0)
    motion = shot(walk(13))
    plain, result = sim.rollout(skirt(), motion), sim.rollout(skirt(), motion, out_fps="body")
    when = np.minimum(np.arange(plain.frames) / 30, 12 / 24)
    flat = plain.vertices.reshape(plain.frames, -1).astype(float)
    expected = np.stack([np.interp(np.arange(13) / 24, when, column) for column in flat.T], 1)
    np.testing.assert_allclose(result.vertices.reshape(13, -1), expected, atol=1e-6)


def test_no_frame_of_the_shot_is_deep_in_the_body():
    """A body that swings 12 cm to and fro would show through between the network's frames, and the status say it does
    not. Depths by libigl: the interpolated cloth 5 mm and more, the result 1 mm at most, and as its status says, to
    0.5 mm (which looks between vertices too, so it may only say more)."""
    swing = shot(body(13, lambda t: (0.12 * np.sin(1.9 * t), 0, 0)))
    sim = simulator(still())
    result = sim.rollout(skirt(), swing, out_fps="body")
    plain = sim.rollout(skirt(), swing).resampled(24.0)
    deep = [nowhere_deeper(plain.vertices[t], swing, t) for t in range(13)]
    depth = [nowhere_deeper(result.vertices[t], swing, t) for t in range(13)]
    assert max(deep) > 5e-3
    assert max(depth) < 1e-3
    for said, found in zip(result.status, depth, strict=True):
        assert said.max_penetration > found - 5e-4
        assert said.max_penetration < 2e-3
    loose = simulator(still(), collision_passes=0).rollout(skirt(), swing, out_fps="body")
    for t, said in enumerate(loose.status):
        assert said.max_penetration > nowhere_deeper(loose.vertices[t], swing, t) - 5e-4


def test_a_batch_of_shots():
    """Shots of other rates and lengths in one batch would get each other's frames. 1e-4 m, as batches differ."""
    sim = simulator(network())
    garments, bodies = [outfit(), skirt(), skirt()], [shot(walk(9)), shot(walk(5), 60.0, 3.0), walk(6)]
    together = sim.rollout(garments, bodies, out_fps="body")
    assert [(m.frames, m.fps, m.start) for m in together] == [(9, 24.0, 1001 / 24), (5, 60.0, 3.0), (6, 30.0, 0.0)]
    for garment, motion, result in zip(garments, bodies, together, strict=True):
        alone = sim.rollout(garment, motion, out_fps="body")
        assert np.abs(alone.vertices - result.vertices).max() < 1e-4
        assert len(alone.status) == len(result.status)
    assert [m.frames for m in sim.rollout(garments, bodies, out_fps=12.0)] == [5, 2, 3]


def test_a_rollout_that_fails_ends_where_it_fails():
    """Frames after the failure would look as if they were simulated, or the failure be smoothed away."""
    failing = Failing(NetworkConfig.small(**TINY))
    with pytest.warns(RuntimeWarning, match="skirt stopped: Frame 3"):
        result = simulator(failing).rollout(skirt(), shot(walk(12), 60.0), out_fps="body")
    assert np.isfinite(result.vertices[:-1]).all()
    assert np.isnan(result.vertices[-1]).all()
    assert [s.finite for s in result.status] == [True] * (result.frames - 1) + [False]
    assert result.frames == 6  # the network's frame 2 is the shot's frame 4; the next one is on the way to frame 3


@pytest.mark.parametrize("rate", [0, -1, np.nan, np.inf, "shot", [24]])
def test_rates_that_are_none(rate):
    """A misspelt rate would be found after the simulation, or not at all."""
    with pytest.raises(UsageError, match="out_fps must be a positive number"):
        simulator(network()).rollout(skirt(), walk(3), out_fps=rate)


def test_a_rate_that_fills_memory_is_found_at_once(monkeypatch):
    """An hour of simulation would end without a result."""
    sim = simulator(network())
    monkeypatch.setattr(sim, "_advance", lambda *_: pytest.fail("simulated"))
    with pytest.raises(MeshError, match="Is the rate right"):
        sim.rollout(skirt(), walk(3), out_fps=1e9)
