"""Correctors are called after contact with what the frame holds, timed and counted; without any, nothing changes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.scenes import TINY, body, network, simulator, skirt, still, walk

from warpgarment.errors import NotEnoughMemory
from warpgarment.nn.config import NetworkConfig
from warpgarment.objects.sizes import Sizes
from warpgarment.sim import memory


class Lifts:
    """Lifts every garment by 1 cm a frame, or gives NaN from some call on; keeps what it was called with."""

    def __init__(self, name: str = "lifting", breaks: int = 99, needs: int = 1000) -> None:
        self.name, self.breaks, self.needs = name, breaks, needs
        self.calls: list[tuple[torch.Tensor, ...]] = []

    def __call__(self, before, after, next_body, finite):
        self.calls.append((before, after, next_body, finite))
        if len(self.calls) >= self.breaks:
            return torch.full_like(after, torch.nan)
        return after + torch.tensor([0.0, 0.01, 0.0])

    def memory(self, sizes: Sizes) -> dict[str, int]:
        return {"springs": self.needs * sizes.vertices}


def test_a_corrector_from_outside_is_called_and_timed():
    """Correctors would be left out, called before contact or with other positions, or their result be dropped.

    Exact: each frame is what the second of two makes of what the first gave.
    """
    sim, motion, garment, up = simulator(network()), walk(4), skirt(), torch.tensor([0.0, 0.01, 0.0])
    one, two = Lifts(), Lifts("lifting again")
    sim.correctors += [one, two]
    result = sim.rollout(garment, motion)
    assert {"lifting", "lifting again"} < set(sim.timings)
    assert len(one.calls) == len(two.calls) == 3
    for frame, ((before, after, next_body, finite), second) in enumerate(zip(one.calls, two.calls, strict=True)):
        assert np.array_equal(before, result.vertices[frame])
        assert np.array_equal(second[0], before)
        assert torch.equal(second[1], after + up)
        assert np.array_equal(result.vertices[frame + 1], second[1] + up)
        assert np.array_equal(next_body, motion.vertices[frame + 1])
        assert finite.tolist() == [True]


def test_the_verdict_is_about_the_corrected_positions():
    """A corrector that moves cloth into the body would be reported as free, one that gives NaN as finite."""
    deep = simulator(still())

    class Presses(Lifts):
        def __call__(self, before, after, next_body, finite):
            return after - torch.tensor([0.1, 0.0, 0.0])

    deep.correctors.append(Presses())
    status = deep.rollout(skirt(), body(2)).status[1]
    assert status.max_penetration > 0.003

    failing = simulator(still())
    failing.correctors.append(Lifts(breaks=2))
    with pytest.warns(RuntimeWarning, match="skirt stopped: Frame 2"):
        result = failing.rollout(skirt(), walk(5))
    assert [status.finite for status in result.status] == [True, True, False]
    assert result.status[2].max_penetration < 0.001


def test_without_correctors_nothing_changes():
    """The stage would cost time or change bits where nobody uses it. Exact, and no kernel: the same objects."""
    sim = simulator(network())
    state = sim.step(sim.start(skirt(), walk(2).vertices[0], walk(2).faces), walk(2).vertices[1])
    before, after, finite, depth = torch.zeros(1), torch.ones(1), torch.ones(1), torch.zeros(1)
    found = state.scene.correct(before, after, before, finite, depth)
    assert found[0] is after
    assert found[1] is finite
    assert found[2] is depth
    assert set(sim.timings) == {"features", "network", "singular values", "poisson", "collision"}


def test_its_memory_is_forecast():
    """A batch with a corrector would be accepted and not fit."""
    motion, garment, config = walk(2), skirt(), NetworkConfig.small(**TINY)
    plain = memory.predict([garment] * 3, [motion], config)
    more = memory.predict([garment] * 3, [motion], config, correctors=[Lifts()])
    extra = 1000 * 3 * len(garment.vertices)
    assert more.total == plain.total + extra
    assert more.parts["lifting, springs"] == extra
    assert Sizes.of([garment], [motion]) == (1, 112, 192, motion.vertices.shape[1], len(motion.faces))
    sim = simulator(still())
    sim.correctors.append(Lifts(needs=10**12))
    with pytest.raises(NotEnoughMemory, match=r"lifting, springs 112\.0 TB"):
        sim.rollout(garment, motion)
