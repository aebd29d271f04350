"""A frame that only the device decides: no looking at numbers on the way, launches that do not grow, replays.

What a GPU does differently is done here on the CPU too: all passes of the collisions, reading frames in blocks, and
replays, which the CPU does by running the frame on the recording's memory. Where there is a GPU, the last test runs on
it as well, with a CUDA graph.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.scenes import Failing, body, network, outfit, simulator, skirt, still, tube, walk

from benchmarks.frames import FrameCounts, Operators
from warpgarment.objects.garment import Garment
from warpgarment.sim import graph
from warpgarment.sim import simulator as simulator_module
from warpgarment.sim.results.recording import Recording
from warpgarment.sim.simulator import Simulator

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def same(one, other) -> bool:
    """Whether two rollouts agree in every bit and every status."""
    return np.array_equal(one.vertices, other.vertices, equal_nan=True) and one.status == other.status


def counted_frame(garments) -> FrameCounts:
    """Operators and launches of the second frame of a simulation that leaves every decision to the device."""
    motion = walk(3)
    sim = simulator(network())
    state = sim.step(sim.start(garments, motion.vertices[0], motion.faces), motion.vertices[1])
    return FrameCounts(state.scene, state.now, torch.from_numpy(motion.vertices[2]))


def resized(number: int) -> list[Garment]:
    """Skirts of one topology and different sizes."""
    return [Garment(*tube(16, 7, bottom=-0.3, top=0.3 + 0.01 * k)) for k in range(number)]


def test_launches_do_not_grow_with_the_batch(monkeypatch):
    """A batch would be a loop over garments. Counted, not timed: exactly as many launches and operators for 8 garments
    of one size as for 2 and for 1. As on a GPU, without the three small layers that a CPU applies to one velocity token
    after another.
    """
    monkeypatch.setattr("warpgarment.nn.attention.ALIKE_ON", frozenset())
    one, two, eight = (counted_frame(resized(number)) for number in (1, 2, 8))
    assert one.launches == two.launches == eight.launches
    assert eight.operators == two.operators == one.operators
    assert one.launches["place_leaves"] == 1  # a GPU refits a tree of Warp for each body in its place
    assert sum(one.launches.values()) > 10


@pytest.mark.parametrize("garments", [[skirt()], [outfit(), skirt(), skirt(pins=[0, 1])]])
def test_no_number_is_looked_at_within_a_frame(garments):
    """The host would wait for a GPU in the middle of a frame, and a graph of it could not be recorded.

    Operators that read a value or need a count on the host (`item`, `nonzero`, indexing by a mask) do not occur.
    """
    assert counted_frame(garments).reads == []


def test_reads_are_noticed():
    """The test above would pass whatever a frame does."""
    values = torch.arange(6.0)
    for call in (lambda: values.sum().item(), lambda: values[values > 2], lambda: values.nonzero()):
        with Operators() as operators:
            call()
        assert operators.read


@pytest.mark.parametrize("shift", [0.0, 0.05, 0.1])
def test_passes_decided_on_the_device(shift, monkeypatch):
    """A GPU would refine collisions more, or less, than a CPU does. Exact; of two garments one is pressed."""
    motion = body(4, lambda t: (shift * min(t, 1), 0, 0))
    wide = Garment(*tube(16, 7, bottom=-0.3, top=0.3, radius=(0.5, 0.4)))
    early = simulator(still()).rollout([skirt(), wide], motion)
    scenes = []

    class Decided(simulator_module.Scene):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            self.contact.early_exit = False
            scenes.append(self)

    monkeypatch.setattr(simulator_module, "Scene", Decided)
    late = simulator(still()).rollout([skirt(), wide], motion)
    assert len(scenes) == 1
    assert all(same(*pair) for pair in zip(early, late, strict=True))
    alone = simulator(still()).rollout(skirt(), motion)  # in a batch the others' passes do not count
    assert [s.collision_iterations for s in alone.status] == [s.collision_iterations for s in early[0].status]


def test_reading_in_blocks(monkeypatch):
    """Frames would be lost between two looks of the host, kept beyond a motion's end or after a failure. Exact."""
    garments = [skirt(), Garment(skirt().vertices, skirt().faces), Garment(skirt().vertices, skirt().faces)]
    bodies = [walk(9), walk(5), walk(9)]
    with pytest.warns(RuntimeWarning, match="skirt stopped: Frame 3"):
        plain = simulator(network(Failing)).rollout(garments, bodies)
    for every in (2, 4, 100):
        monkeypatch.setattr(simulator_module, "Recording", lambda s, n, _, every=every: Recording(s, n, every))
        with pytest.warns(RuntimeWarning, match="skirt stopped: Frame 3"):
            blocks = simulator(network(Failing)).rollout(garments, bodies)
        assert all(same(*pair) for pair in zip(plain, blocks, strict=True))
        assert [motion.frames for motion in blocks] == [4, 5, 9]
        with pytest.warns(RuntimeWarning, match="skirt stopped"):
            alone = simulator(network(Failing)).rollout(garments[0], bodies[0])
        assert alone.frames == 4  # all have failed: what was computed after it is dropped


def again(run):
    """A recording for the CPU: its replay runs the frame once more, on the same memory."""
    after = run()

    def replay():
        for held, new in zip(after, run(), strict=True):
            held.copy_(new.clone())

    return after, replay


@pytest.fixture
def sim_with(request, monkeypatch):
    """Makes simulators that replay, on a device; on the CPU by `again`."""

    def make(device, record=again):
        sim = Simulator(network(), device)
        if device == "cpu":
            graphed = graph.GraphedFrames
            monkeypatch.setattr(simulator_module, "GraphedFrames", lambda scene: graphed(scene, record))
            sim.graph = True
        return sim

    return make


@pytest.mark.parametrize("device", DEVICES)
def test_replays_are_the_frames(device, sim_with):
    """A replayed frame would differ from one that is run, or change states that were given out before.

    Exact on a CPU. 1e-4 m on a GPU, whose sums have no fixed order, over 9 frames that feed on each other.
    """
    tolerance = 0.0 if device == "cpu" else 1e-4
    garments, bodies = [skirt(), outfit(), skirt(pins=np.arange(16))], [walk(9), walk(6), walk(9)]
    plain = Simulator(network(), device)
    plain.graph = False
    expected = plain.rollout(garments, bodies)
    sim = sim_with(device)
    for one, other in zip(expected, sim.rollout(garments, bodies), strict=True):
        assert one.frames == other.frames
        assert np.abs(one.vertices - other.vertices).max() <= tolerance

    motion, other = walk(9), body(9, lambda t: (0, 0, -0.02 * t))
    state = sim.start(skirt(), motion.vertices[0], motion.faces)
    for t in range(1, 6):
        state = sim.step(state, motion.vertices[t])
    assert state.graph.recorded
    kept = state.now.positions.clone()
    first = sim.step(state, motion.vertices[6])
    elsewhere = sim.step(sim.step(state, other.vertices[6]), other.vertices[7])
    again_first = sim.step(state, motion.vertices[6])
    assert torch.equal(kept, state.now.positions)
    assert np.abs(first.vertices - again_first.vertices).max() <= tolerance
    assert np.abs(first.vertices - elsewhere.vertices).max() > 1e-3
    assert np.abs(first.vertices - expected[0].vertices[6]).max() <= max(tolerance, 1e-4)  # alone and in a batch


def test_a_recording_that_fails(sim_with):
    """A GPU, driver or library that cannot capture a frame would end the simulation. Exact: frames go on as before."""

    def refuse(run):
        run()
        raise RuntimeError("operation not permitted when stream is capturing\nmore")

    motion = walk(8)
    expected = simulator(network()).rollout(skirt(), motion)
    with pytest.warns(RuntimeWarning, match="RuntimeError: operation not permitted when stream is capturing.*graph=F"):
        result = sim_with("cpu", refuse).rollout(skirt(), motion)
    assert same(expected, result)
