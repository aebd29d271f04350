"""Frames that are replayed on a CPU are those that are computed one by one, in every bit.

Without replays (`graph=False`) a frame is what its stages are called for. Networks of patches replay all of a frame,
others the contact with bodies and what follows it.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.scenes import body, network, outfit, simulator, skirt, tube, walk

import warpgarment as wg
from warpgarment.kernels.collision.body_contacts import BodyContacts
from warpgarment.kernels.collision.solver import CollisionSolver
from warpgarment.kernels.replay.pieces import CHECKS, WARM_UP
from warpgarment.kernels.replay.recording import Recording
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.nn.patches import fused
from warpgarment.objects.garment import Garment
from warpgarment.sim.simulator import Simulator

FRAMES = WARM_UP + 1 + CHECKS + 10


@pytest.fixture(scope="module")
def fast():
    return wg.Simulator.from_pretrained("fast", device="cpu").network


def pressed(frames: int):
    """A capsule that sways far enough to come into the cloth."""
    return body(frames, lambda t: (0.03 * np.sin(0.4 * t), 0.0, 0.02 * t), lambda t: (0.0, 0.05 * t, 0.0))


GARMENTS = {
    "one": [skirt()],
    "several, with pins": [skirt(), outfit(), skirt(pins=np.arange(16))],
    "more vertices than have an inverse": [Garment(*tube(64, 40, bottom=-0.3, top=0.3))],
}


@pytest.mark.parametrize("patches", [True, False])
@pytest.mark.parametrize("name", GARMENTS)
def test_replays_are_the_frames(name, patches, fast):
    """A replay would use an input, a tree or a history of another frame. Exact, statuses too; most of the frames are
    replays, of two passes of contact where the body comes into the cloth."""
    made, motion, garments = fast if patches else network(), pressed(FRAMES), GARMENTS[name]
    plain = Simulator(made, "cpu", graph=False).rollout(garments, motion)
    sim = Simulator(made, "cpu")
    for one, other in zip(plain, sim.rollout(garments, motion), strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        assert one.status == other.status
    assert {"network", "collision", "features"} < set(sim.timings)


def test_most_of_a_frame_is_replayed(fast, monkeypatch):
    """All tests here would pass if nothing were replayed. Stages are counted: after the first frames the network is not
    called any more, and neither is contact with the body."""
    calls = []
    monkeypatch.setattr(fused, "predict", lambda *args, real=fused.predict: calls.append("network") or real(*args))
    find = BodyContacts.find
    monkeypatch.setattr(BodyContacts, "find", lambda *args: calls.append("contact") or find(*args))
    motion = walk(FRAMES)
    Simulator(fast, "cpu").rollout(skirt(), motion)
    expected = WARM_UP + 1 + CHECKS
    assert calls.count("network") == 1 + expected  # the first frame has no history of its own
    assert calls.count("contact") <= 2 * expected


@pytest.mark.parametrize("layers", [None, [[0, 1]]])
def test_outfits(layers, fast):
    """Cloth that meets cloth works between replays, with results that they overwrite later. Exact."""
    shirt = Garment(*tube(24, 9, bottom=-0.2, top=0.35, radius=(0.34, 0.24)))
    plain, replayed = (
        Simulator(fast, "cpu", graph=graph).rollout([skirt(), shirt], pressed(FRAMES), layers=layers)
        for graph in (False, None)
    )
    for one, other in zip(plain, replayed, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        assert one.status == other.status


def test_states_are_values(fast):
    """A replay would change states that were given out, or go on from another one than it is given. Exact."""
    motion, other = walk(FRAMES), pressed(FRAMES)
    sim = Simulator(fast, "cpu")
    states = [sim.start(skirt(), motion.vertices[0], motion.faces)]
    copies = []
    for t in range(1, FRAMES):
        states.append(sim.step(states[-1], motion.vertices[t]))
        now = states[-1].now
        copies.append([*(t.clone() for t in now.outcome), now.velocities.clone(), now.features.whole().clone()])
    for state, copy in zip(states[1:], copies, strict=True):
        now = state.now
        for one, kept in zip((*now.outcome, now.velocities, now.features.whole()), copy, strict=True):
            np.testing.assert_array_equal(one, kept)
    middle = states[FRAMES // 2]
    sim.step(sim.step(middle, other.vertices[1]), other.vertices[2])
    again = sim.step(middle, motion.vertices[FRAMES // 2 + 1])
    np.testing.assert_array_equal(again.vertices, states[FRAMES // 2 + 1].vertices)


def test_weights_that_change_are_seen(fast):
    """Frames would be replayed with the weights that were recorded. Exact."""
    motion, results = walk(2 * FRAMES), []
    for graph in (False, None):
        made = wg.Simulator.from_pretrained("fast", device="cpu").network
        sim = Simulator(made, "cpu", graph=graph)
        state = sim.start(skirt(), motion.vertices[0], motion.faces)
        for t in range(1, 2 * FRAMES):
            if t == FRAMES:
                with torch.no_grad():
                    made.face_head.weight.mul_(1.5)
            state = sim.step(state, motion.vertices[t])
        results.append(state.vertices)
    np.testing.assert_array_equal(*results)
    same = Simulator(fast, "cpu").rollout(skirt(), motion).vertices[-1]
    assert np.abs(same - results[0]).max() > 1e-4


def test_threads_may_change(fast):
    """Recorded ranges are those of a number of threads. Exact."""
    motion, before = walk(2 * FRAMES), torch.get_num_threads()
    plain = Simulator(fast, "cpu", graph=False).rollout(skirt(), motion).vertices
    sim = Simulator(fast, "cpu")
    state = sim.start(skirt(), motion.vertices[0], motion.faces)
    try:
        for t in range(1, 2 * FRAMES):
            torch.set_num_threads(1 + t // FRAMES)
            state = sim.step(state, motion.vertices[t])
            np.testing.assert_array_equal(state.vertices, plain[t])
    finally:
        torch.set_num_threads(before)


class Keeps:
    """A contact source and corrector that keeps what it is given, and what that was."""

    name = "keeps"

    def __init__(self) -> None:
        self.given: list[tuple[torch.Tensor, torch.Tensor]] = []

    def keep(self, *tensors: torch.Tensor) -> None:
        self.given += [(t, t.clone()) for t in tensors]

    def find(self, vertices, frame):
        self.keep(vertices, frame.origin)
        return BodyContacts().find(vertices, frame)

    def __call__(self, before, after, next_body, finite):
        self.keep(before, after, next_body, finite)
        return after

    def memory(self, sizes):
        return {}

    def unchanged(self) -> bool:
        return len(self.given) > FRAMES and all(np.array_equal(t, c, equal_nan=True) for t, c in self.given)


@pytest.mark.parametrize("kind", ["contact_sources", "correctors"])
def test_what_users_are_given_is_theirs(kind, fast):
    """A corrector that looks at earlier frames, or a source of contacts, would find later ones in their place."""
    sim, keeps = Simulator(fast, "cpu"), Keeps()
    setattr(sim, kind, [keeps])
    result = sim.rollout(skirt(), walk(FRAMES))
    assert keeps.unchanged()
    plain = Simulator(fast, "cpu", graph=False).rollout(skirt(), walk(FRAMES))
    np.testing.assert_array_equal(result.vertices, plain.vertices)


def test_a_garment_that_fails_late(fast):
    """A replay would hide that a garment is not finite, or spoil its neighbour. Exact."""
    motions = [walk(FRAMES), walk(FRAMES)]
    broken = motions[0].vertices.copy()
    results = []
    for graph in (False, None):
        sim = Simulator(fast, "cpu", graph=graph)
        state = sim.start([skirt(), outfit()], [m.vertices[0] for m in motions], [m.faces for m in motions])
        for t in range(1, FRAMES):
            if t == FRAMES - 4:
                positions = state.now.positions.clone()
                positions[: len(skirt().vertices)] = 1e30
                state = type(state)(state.scene, state.single, state.frame, state.now._replace(positions=positions))
            state = sim.step(state, [broken[t], motions[1].vertices[t]])
        results.append((state.vertices, state.status))
    for one, other in zip(*(vertices for vertices, _ in results), strict=True):
        np.testing.assert_array_equal(one, other)
    assert results[0][1] == results[1][1]


def test_large_batches_are_not_replayed(fast, monkeypatch):
    """Their memory would grow by what all kernels work with."""
    monkeypatch.setattr("warpgarment.sim.scene.MOST_REPLAYED", 191)
    state = Simulator(fast, "cpu").start(skirt(), walk(1).vertices[0], walk(1).faces)
    assert not state.scene.pieces.on
    assert simulator(network(), graph=True).replay
    assert not simulator(network(), graph=False).replay


@pytest.mark.parametrize("what", [(Recording, "replay"), (CollisionSolver, "solve"), (BodyMeshes, "update")])
def test_frames_that_are_interrupted(what, fast, monkeypatch):
    """After Ctrl-C, a frame that is stepped again would find search trees that a replay has moved, or a recording that
    was half made. Exact; every seventh call is interrupted when it has done its work."""
    motion, calls, missed, (owner, name) = walk(FRAMES), [], 0, what
    real = getattr(owner, name)
    plain = Simulator(fast, "cpu", graph=False).rollout(skirt(), motion).vertices
    sim = Simulator(fast, "cpu")
    state = sim.start(skirt(), motion.vertices[0], motion.faces)

    def interrupted(*args):
        result = real(*args)
        calls.append(name)
        if len(calls) % 7 == 2:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(owner, name, interrupted)
    while state.frame + 1 < FRAMES:
        try:
            state = sim.step(state, motion.vertices[state.frame + 1])
        except KeyboardInterrupt:
            missed += 1
            continue
        np.testing.assert_array_equal(state.vertices, plain[state.frame])
    assert missed


def test_a_network_whose_prediction_is_replaced(fast):
    """Frames would be replayed with the prediction that was recorded. Exact."""
    motion, results, asked = walk(FRAMES), [], []
    for graph in (False, None):
        sim = Simulator(wg.Simulator.from_pretrained("fast", device="cpu").network, "cpu", graph=graph)
        state = sim.start(skirt(), motion.vertices[0], motion.faces)
        for t in range(1, FRAMES):
            if t == FRAMES - 3:
                real = sim.network.predict
                sim.network.predict = lambda *args, real=real, **more: asked.append(0) or real(*args, **more)
            state = sim.step(state, motion.vertices[t])
        results.append(state.vertices)
    np.testing.assert_array_equal(*results)
    assert len(asked) == 2 * 3


def test_memory_of_weights_that_change_again_and_again(fast):
    """Results of recordings that are forgotten would stay: a few arrays for each change of the weights."""
    made, motion, kept = wg.Simulator.from_pretrained("fast", device="cpu").network, walk(FRAMES), []
    sim = Simulator(made, "cpu")
    state = sim.start(skirt(), motion.vertices[0], motion.faces)
    for _ in range(4):
        with torch.no_grad():
            made.face_head.weight.mul_(1.001)
        for t in range(1, FRAMES):
            state = sim.step(state, motion.vertices[t])
        kept.append(len(state.scene.pieces._own))
    assert kept[-1] == kept[1]
