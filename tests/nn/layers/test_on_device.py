"""A frame of LayersNet in the form that a GPU takes, on a CPU: nothing is read on the way, frames can be replayed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.outfits import inner, layersnet, outer
from support.scenes import walk

import warpgarment.nn.layers.network as module
from benchmarks.frames import FrameCounts
from warpgarment.objects.material import Material
from warpgarment.sim import graph
from warpgarment.sim import simulator as simulator_module
from warpgarment.sim.simulator import Simulator


@pytest.fixture(autouse=True)
def padded(monkeypatch):
    """Tables are padded, as on a GPU."""
    monkeypatch.setattr(module, "WAITS", ())


def test_no_number_is_looked_at_within_a_frame():
    """The host would wait for a GPU in the middle of a frame, and a graph of it could not be recorded."""
    motion = walk(3)
    sim = Simulator(layersnet(), "cpu")
    state = sim.start([inner(), outer()], motion.vertices[0], motion.faces, wind=[1.0, 0.0, 0.0])
    state = sim.step(state, motion.vertices[1])
    assert FrameCounts(state.scene, state.now, torch.from_numpy(motion.vertices[2])).reads == []


def again(run):
    """A recording for the CPU: its replay runs the frame once more, on the same memory."""
    after = run()

    def replay():
        for held, new in zip(after, run(), strict=True):
            held.copy_(new.clone())

    return after, replay


def test_replays_are_the_frames(monkeypatch):
    """Earlier frames, wind or materials of a replay would be those of the recording. Bit for bit."""
    made, graphed = [], graph.GraphedFrames
    monkeypatch.setattr(simulator_module, "GraphedFrames", lambda scene: made.append(graphed(scene, again)) or made[-1])
    network, motion, garments = layersnet(), walk(9), [inner(), outer()]
    wind = np.random.default_rng(0).normal(scale=3.0, size=(9, 2, 3))
    options = {"wind": wind, "materials": [Material(density=0.4), None]}
    plain = Simulator(network, "cpu").rollout(garments, motion, **options)
    sim = Simulator(network, "cpu")
    sim.graph = True
    replayed = sim.rollout(garments, motion, **options)
    assert made[0].recorded
    for one, other in zip(plain, replayed, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
    calm = Simulator(network, "cpu").rollout(garments, motion, materials=options["materials"])
    assert np.abs(calm[0].vertices - plain[0].vertices).max() > 1e-5
