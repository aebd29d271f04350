"""Garments of an outfit in the simulator: nothing that was free crosses, what crosses is said, others are untouched."""

from __future__ import annotations

import igl
import ipctk
import numpy as np
import pytest
import torch
from support.scenes import Failing, body, network, simulator, skirt, tube, walk

from benchmarks.frames import FrameCounts
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.objects.status import RolloutStatus, Verdict
from warpgarment.sim.arguments import outfits
from warpgarment.sim.stages.meet import Meet

SHAKING = body(8, lambda t: (0.03 * (t % 2), 0.0, 0.02 * t), lambda t: (0.0, 0.15 * t, 0.1 * (t % 2)))


def layered(gap: float = 0.012, **options) -> list[Garment]:
    """Two skirts over each other, `gap` [m] apart."""
    return [
        Garment(*tube(16, 7, bottom=-0.3, top=0.3 - 0.01 * k, radius=(0.3 + gap * k, 0.19 + gap * k)), **options)
        for k in range(2)
    ]


def crosses(garments, frames) -> bool:
    """Whether any triangles cross, by ipctk."""
    start = np.cumsum([0, *(len(g.vertices) for g in garments)])
    faces = np.concatenate([g.faces + s for g, s in zip(garments, start, strict=False)]).astype(np.int32)
    vertices = np.concatenate(frames).astype(float)
    return ipctk.has_intersections(ipctk.CollisionMesh(vertices, ipctk.edges(faces), faces), vertices)


def restless(**changes):
    """A network whose random output is centimetres a frame, so that layers would pass through each other."""
    made = network(**changes)
    made.set_statistics({"psi_std": torch.full((9,), 0.1), "q_std": torch.full((3,), 0.01)})
    return made


def test_what_is_free_at_the_start_stays_free():
    """Layers would cross in a rollout. By ipctk in every frame; without layers most frames cross. The vertices still
    move by centimetres, stay outside the body, and the status counts nothing."""
    garments = layered()
    free = simulator(restless()).rollout(garments, SHAKING, layers=True)
    alone = simulator(restless()).rollout(garments, SHAKING)
    crossing = [crosses(garments, [m.vertices[t] for m in alone]) for t in range(8)]
    assert not crossing[0]
    assert sum(crossing) >= 4
    assert not any(crosses(garments, [m.vertices[t] for m in free]) for t in range(8))
    for motion, other in zip(free, alone, strict=True):
        assert np.linalg.norm(motion.vertices[-1] - motion.vertices[0], axis=1).min() > 0.01
        assert not np.array_equal(motion.vertices, other.vertices)
        assert [(s.layer_crossings, s.self_crossings) for s in motion.status] == [(0, 0)] * 8
        assert motion.status[0].lag is None
        assert all(s.lag is not None and 0.0 <= s.lag < 0.3 for s in motion.status[1:])
        assert max(s.max_penetration for s in motion.status) < 0.02


def test_without_layers_nothing_changes():
    """A stage that nobody asked for would cost time or change bits: garments without an outfit beside an outfit, and a
    batch without any, give the same bits, and no figure."""
    garments = [skirt(), *layered(), skirt(pins=[0, 1])]
    alone = simulator(network()).rollout(garments, walk(5))
    sim = simulator(network())
    beside = sim.rollout(garments, walk(5), layers=[[1, 2]])
    for k in (0, 3):
        assert np.array_equal(alone[k].vertices, beside[k].vertices)
        assert beside[k].status[-1].layer_crossings is None
        assert beside[k].status[-1].lag is None
    assert beside[1].status[-1].layer_crossings == 0
    off = simulator(network())
    assert np.array_equal(off.rollout(garments, walk(5), layers=False)[1].vertices, alone[1].vertices)
    assert "layers" not in off.timings
    assert "layers" in sim.timings


def test_outfits_of_a_batch_do_not_see_each_other():
    """Outfits at the same place would push each other. A batch of two is equal to one at a time, to 0.1 mm: solves of
    a batch stop together."""
    one, other = layered(), layered(gap=0.02)
    together = simulator(restless()).rollout([*one, *other], SHAKING, layers=[[0, 1], [2, 3]])
    apart = [*simulator(restless()).rollout(one, SHAKING, layers=True)]
    apart += simulator(restless()).rollout(other, SHAKING, layers=True)
    for a, b in zip(together, apart, strict=True):
        assert np.abs(a.vertices[:3] - b.vertices[:3]).max() < 1e-4


def test_a_start_that_crosses_is_told():
    """Someone would blame the network. The number of pairs in frame 0 is that of a rollout's own count, and the verdict
    names the remedy."""
    garments = layered(gap=0.0005)
    garments[1] = Garment(garments[1].vertices + np.float32([0.01, 0, 0]), garments[1].faces, name="jacket")
    with pytest.warns(RuntimeWarning, match="cross in the first frame"):
        motions = simulator(network()).rollout(garments, walk(3), layers=True)
    first = [motion.status[0] for motion in motions]
    assert first[0].layer_crossings == first[1].layer_crossings > 10
    assert first[0].verdict is Verdict.CROSSING
    assert "layers" in first[0].message


@pytest.mark.parametrize("depth", [0.01, 0.02])
def test_a_start_that_crosses_is_put_in_order(depth):
    """A jacket pushed into a dress would stay there for the whole motion. Its front is pushed `depth` through the
    inner layer; by ipctk nothing crosses after ten frames, and every vertex of the outer layer is outside the inner
    one. The status counts down to 0 and stays there."""
    inner, outer = layered()
    way = np.clip(1 - (np.linalg.norm(outer.vertices - [0.0, 0.0, 0.25], axis=1) / 0.15) ** 2, 0, None)
    pushed = outer.vertices - np.float32(depth + 0.012) * np.sqrt(way)[:, None] * np.float32([0, 0, 1])
    first = [inner.vertices, pushed.astype(np.float32)]
    garments = [inner, outer]
    assert crosses(garments, first)
    with pytest.warns(RuntimeWarning, match="cross in the first frame"):
        motions = simulator(network()).rollout(garments, walk(14), first_vertices=first, layers=True)
    assert motions[0].status[0].layer_crossings > 8
    assert [m.status[t].layer_crossings for m in motions for t in range(10, 14)] == [0] * 8
    for t in range(10, 14):
        assert not crosses(garments, [m.vertices[t] for m in motions])
        at = motions[0].vertices[t]
        distance = igl.signed_distance(
            motions[1].vertices[t].astype(float),
            at.astype(float),
            inner.faces.astype(np.int64),
            sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
        )[0]
        assert distance.min() > -1e-6


def test_a_frame_of_layers_is_decided_on_the_device(monkeypatch):
    """The host would wait for a GPU in the middle of a frame, or a GPU get other layers than a CPU: no number is looked
    at if every motion is tried, and the results are the same bits. Launches do not grow with the number of outfits."""
    counts = []
    for number in (1, 4):
        garments = [garment for _ in range(number) for garment in layered()]
        layers = [[2 * k, 2 * k + 1] for k in range(number)]
        sim = simulator(network())
        state = sim.start(garments, SHAKING.vertices[0], SHAKING.faces, layers=layers)
        state = sim.step(state, SHAKING.vertices[1])
        counts.append(FrameCounts(state.scene, state.now, torch.from_numpy(SHAKING.vertices[2])))
    assert counts[0].reads == counts[1].reads == []
    assert counts[0].launches == counts[1].launches
    early = simulator(restless()).rollout(layered(), SHAKING, layers=True)
    made = Meet.__init__

    def on_device(self, *args):
        made(self, *args)
        self.early_exit = False

    monkeypatch.setattr(Meet, "__init__", on_device)
    late = simulator(restless()).rollout(layered(), SHAKING, layers=True)
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(early, late, strict=True))


def test_a_garment_that_fails_does_not_hold_the_others():
    """NaN of one layer would spread to the other."""
    garments = layered()
    with pytest.warns(RuntimeWarning, match="stopped"):
        motions = simulator(network(Failing)).rollout(garments, walk(6), layers=True)
    assert not motions[0].status[-1].finite
    assert motions[1].frames == 6
    assert np.isfinite(motions[1].vertices).all()


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ([[0, 1], []], "empty"),
        ([[0, 3]], "garment 3"),
        ([[0], [0, 1]], "twice"),
        ([[1, 2]], "different bodies"),
    ],
)
def test_outfits_that_make_no_sense_are_refused(layers, message):
    """A wrong list would give crossing garments, or an error about indices from deep inside."""
    with pytest.raises(ValueError, match=message):
        outfits(layers, [0, 0, 1])


def test_outfits_of_true_are_those_of_the_bodies():
    """Garments on different bodies would be one outfit."""
    assert outfits(True, [0, 1, 0, 1]) == [[0, 2], [1, 3]]
    assert outfits(None, [0, 0]) == outfits(False, [0, 0]) == []


def test_figures_are_saved(tmp_path):
    """A motion read back would seem never to have been checked, or one that was not checked to be free."""
    status = [RolloutStatus.judged(0, True, 0.0, layer_crossings=3, self_crossings=0, lag=None)]
    status.append(RolloutStatus.judged(1, True, 0.0, lag=0.25))
    moved = GarmentMotion(np.zeros((2, 3, 3), np.float32), np.array([[0, 1, 2]], np.int32), 30.0, status)
    moved.save(tmp_path / "a.npz")
    assert GarmentMotion.load(tmp_path / "a.npz").status == status
    assert status[0].verdict is Verdict.CROSSING
    assert status[1].verdict is Verdict.OK
