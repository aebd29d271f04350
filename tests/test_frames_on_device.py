"""A frame that only the device decides: no looking at numbers on the way, launches that do not grow, replays.

What a GPU does differently is done here on the CPU too: all passes of the collisions, reading frames in blocks, and
replays, which the CPU does by running the frame on the recording's memory. Where there is a GPU, the last test runs on
it as well, with a CUDA graph.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
import warp as wp
from test_simulator import Failing, body, network, outfit, simulator, skirt, still, tube, walk
from torch.utils._python_dispatch import TorchDispatchMode

from warpgarment import frame_graph
from warpgarment import simulator as simulator_module
from warpgarment.frame import Recording, advance
from warpgarment.garment import Garment
from warpgarment.kernels import cg
from warpgarment.simulator import Simulator

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
READS = {"_local_scalar_dense", "nonzero", "masked_select", "unique", "equal", "is_nonzero"}  # the host waits for these
VIEWS = {"view", "unsqueeze", "expand", "slice", "select", "t", "transpose", "split", "split_with_sizes", "alias"}
VIEWS |= {"_unsafe_view", "permute", "squeeze", "as_strided", "detach", "unbind", "lift_fresh", "_reshape_alias"}


def same(one, other) -> bool:
    """Whether two rollouts agree in every bit and every status."""
    return np.array_equal(one.vertices, other.vertices, equal_nan=True) and one.status == other.status


class Operators(TorchDispatchMode):
    """Counts torch operators, views left out, and what they are given that the host would wait for."""

    def __init__(self):
        super().__init__()
        self.counts = Counter()
        self.read = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.split("::")[1]
        if name not in VIEWS:
            self.counts[name] += 1
        indices = args[1] if name.startswith(("index", "_index")) and len(args) > 1 else ()
        by_mask = isinstance(indices, (list, tuple)) and any(i is not None and i.dtype == torch.bool for i in indices)
        if name in READS or by_mask:
            self.read.append((name, args[0]))
        return func(*args, **(kwargs or {}))


@pytest.fixture
def launches(monkeypatch):
    """Counts Warp's launches, by kernel, and refits of bodies."""
    counts = Counter()
    for name in ("launch", "launch_tiled"):
        original = getattr(wp, name)

        def counted(kernel, *args, original=original, **options):
            counts[kernel.key] += 1
            return original(kernel, *args, **options)

        monkeypatch.setattr(wp, name, counted)
    refit = wp.Mesh.refit
    monkeypatch.setattr(wp.Mesh, "refit", lambda mesh: (counts.update(["refit"]), refit(mesh))[1])
    # on a CPU reports are looked at straight away
    monkeypatch.setattr(cg.Progress, "_warn", lambda *_: None)
    return counts


def counted_frame(garments, launches):
    """Operators and launches of the second frame of a simulation that leaves every decision to the device."""
    motion = walk(3)
    sim = simulator(network())
    state = sim.start(garments, motion.vertices[0], motion.faces)
    state.scene.early_exit = False
    state = sim.step(state, motion.vertices[1])
    launches.clear()
    with torch.inference_mode(), Operators() as operators:
        advance(state.scene, state.now, torch.from_numpy(motion.vertices[2]))
    return operators, dict(launches)


def resized(number: int) -> list[Garment]:
    """Skirts of one topology and different sizes."""
    return [Garment(*tube(16, 7, bottom=-0.3, top=0.3 + 0.01 * k)) for k in range(number)]


def test_launches_do_not_grow_with_the_batch(launches):
    """A batch would be a loop over garments. Counted, not timed: exactly as many launches for 8 garments as for 2, and
    for 2 as for 1 but for the one gather that lays several garments out in rows.
    """
    counts = {number: counted_frame(resized(number), launches) for number in (1, 2, 8)}
    for number in (2, 8):
        assert counts[number][1] == counts[1][1], number
    assert counts[8][0].counts == counts[2][0].counts
    assert counts[2][0].counts - counts[1][0].counts == Counter({"index": 1})
    assert counts[1][1]["refit"] == 1
    assert sum(counts[1][1].values()) > 10


@pytest.mark.parametrize("garments", [[skirt()], [outfit(), skirt(), skirt(pins=[0, 1])]])
def test_no_number_is_looked_at_within_a_frame(garments, launches):
    """The host would wait for a GPU in the middle of a frame, and a graph of it could not be recorded.

    Operators that read a value or need a count on the host (`item`, `nonzero`, indexing by a mask) do not occur, except
    on the one tensor that lies on the host anyway.
    """
    operators, _ = counted_frame(garments, launches)
    # int64 [3]: sizes of the compliance matrices (kernels/compliance.py)
    read = [(name, tensor) for name, tensor in operators.read if tensor.dtype != torch.int64 or tensor.numel() != 1]
    assert read == []


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
            self.early_exit = False
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
            graphed = frame_graph.GraphedFrames
            monkeypatch.setattr(simulator_module, "GraphedFrames", lambda s, a: graphed(s, a, record))
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
    assert state.scene.graph._recorded is not None
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
    with pytest.raises(ValueError, match="graph=True needs a CUDA device"):
        Simulator(network(), "cpu", graph=True)
