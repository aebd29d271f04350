"""Predicted memory against what torch allocates, and what is said when a batch does not fit."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from support.memory import allocated
from support.scenes import network, skirt, tube, walk

from warpgarment.errors import NotEnoughMemory
from warpgarment.geometry.pooled_geodesics import CENTRES, NEAR, PooledGeodesics
from warpgarment.kernels.collision.operator import Model
from warpgarment.kernels.features.channels import FEATURES
from warpgarment.kernels.operator import pack, unpack
from warpgarment.kernels.poisson.operator import matrix_of
from warpgarment.kernels.poisson.solver import PoissonSolver
from warpgarment.nn.architecture import build_network
from warpgarment.nn.config import NetworkConfig
from warpgarment.objects.garment import Garment
from warpgarment.sim import history, memory
from warpgarment.sim.simulator import Simulator

FACTOR = 1.5


def garment(around: int, along: int) -> Garment:
    """A skirt of 2 around (along - 1) faces with made-up distances: real ones take a while and as much memory."""
    made = Garment(*tube(around, along, bottom=-0.3, top=0.3))
    centroids = made.vertices[made.faces].mean(axis=1)
    made.__dict__["geodesics"] = np.linalg.norm(centroids[:, None] - centroids, axis=2).astype(np.float32)
    return made


def pooled(around: int, along: int) -> Garment:
    """The same with made-up distances between centres, as garments beyond 10,000 faces have them."""
    made = Garment(*tube(around, along, bottom=-0.3, top=0.3))
    centroids = made.vertices[made.faces].mean(axis=1)
    centres = centroids[np.linspace(0, len(centroids) - 1, CENTRES).astype(int)]
    length, nearest = cKDTree(centres).query(centroids, NEAR)
    weight = 1.0 / (length + 0.01)
    distances = np.linalg.norm(centres[:, None] - centres, axis=2).astype(np.float32)
    made.__dict__["pooled_geodesics"] = PooledGeodesics(
        distances, nearest.astype(np.int32), (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    )
    return made


def factor_of(solver) -> list[torch.Tensor]:
    """The factor among what a solver's operator is given, found as the solver itself finds it."""
    model = solver._model
    return pack((matrix_of(model) if isinstance(solver, PoissonSolver) else unpack(model, Model)).factor)


SMALL, BASE, FAST = (kind(layers=1) for kind in (NetworkConfig.small, NetworkConfig.base, NetworkConfig.fast))
ONE, MANY = garment(32, 17), [garment(around, 13) for around in (12, 16, 22, 24, 28, 32)]


@pytest.mark.parametrize(
    ("garments", "config", "options"),
    [
        ([ONE], SMALL, {}),
        ([ONE], SMALL, {"face_splits": 4}),
        (MANY, SMALL, {}),
        ([MANY[1]] * 8, SMALL, {}),
        ([MANY[1]] * 8, BASE, {}),
        ([MANY[1]] * 8, BASE, {"half": True}),
        ([garment(64, 40)], SMALL, {"face_splits": 8}),
        ([ONE], FAST, {}),
        (MANY, FAST, {}),
        ([MANY[1]] * 8, FAST, {"half": True}),
        ([pooled(128, 41)], SMALL, {"face_splits": 4}),
        ([pooled(128, 41)], FAST, {}),
    ],
)
def test_prediction(garments, config, options):
    """A batch that fits would be refused, or one that does not fit accepted.

    Factor 1.5 of torch's count, set-up included. Geodesic distances, factors and rows of the compliance lie in NumPy's
    memory and are counted apart; of the rows, one frame takes no more than is predicted. The last three have too many
    vertices for a compliance matrix, the last two too many faces for a matrix of all pairs of them.
    """
    motion = walk(2)
    splits = {k: v for k, v in options.items() if k == "face_splits"}
    sim = Simulator(build_network(config), "cpu", half=options.get("half", False))
    scenes = []

    def run():
        state = sim.start(garments, motion.vertices[0], motion.faces, **splits)
        for _ in range(config.history if config is FAST else 1):  # until all frames of the history are its own
            state = sim.step(state, motion.vertices[1])
        scenes.append(state.scene)

    unique = {id(g): g for g in garments}.values()
    arrays = [] if config is FAST else [a for g in unique for a in (g.pooled_geodesics if g.pools else [g.geodesics])]
    distances = sum(array.nbytes for array in arrays)
    measured = allocated(run)
    factors = sum(
        tensor.nbytes
        for solver in (scenes[0].reconstruct.solver, scenes[0].contact.solver)
        for tensor in factor_of(solver)
    )
    measured += distances + factors
    predicted = memory.predict(garments, [motion], config, **options)
    assert predicted.parts.get("geodesic distances", 0) == distances
    assert 1 / FACTOR < predicted.parts["factors of the solvers"] / factors < FACTOR
    rows = unpack(scenes[0].contact.solver._model, Model).rows
    kept = 4 * sum(int(used) * (len(rows.values) // max(1, int(rows.capacity.sum()))) for used in rows.used)
    assert 0 <= kept <= predicted.parts["rows of compliance"]
    ratio = (predicted.total - predicted.parts["bodies"] - predicted.parts["rows of compliance"]) / measured
    assert 1 / FACTOR < ratio < FACTOR, f"{predicted}, measured {measured / 1e6:.1f} MB"


def test_prediction_of_a_large_batch(monkeypatch):
    """Garments of one mesh would count as several, or the history of a large batch as many times as that of a small
    one. Two frames of a batch whose frames are tensors of their own, within a factor of 1.5 of torch's count."""
    monkeypatch.setattr(history, "MOST_BYTES", 0)
    motion, garments = walk(3), [garment(32, 17) for _ in range(12)]
    sim = Simulator(build_network(FAST), "cpu")
    predicted = memory.predict(garments, [motion], FAST)
    assert predicted == memory.predict(garments[:1] * 12, [motion], FAST)
    stack = 4 * FAST.history * FEATURES * sum(len(one.faces) for one in garments)
    assert predicted.parts["history of features"] == pytest.approx(1.1 * stack)

    def run():
        state = sim.start(garments, motion.vertices[0], motion.faces)
        for frame in (1, 2, *[1, 2] * 5):
            state = sim.step(state, motion.vertices[frame])

    ratio = predicted.total / allocated(run)
    assert 1 / FACTOR < ratio < FACTOR, f"{predicted}, {ratio:.2f} of what was allocated"


@pytest.mark.parametrize("garments", [[ONE, ONE], MANY, [MANY[1]] * 3])
def test_prediction_of_layers(garments):
    """Pairs of faces would be left out, and an outfit fill the memory. What layers add to the most that is allocated is
    within a factor of 1.5 of the entry."""
    motion, layers = walk(2), [list(range(len(garments)))]
    sim = Simulator(build_network(FAST), "cpu")

    def run(layers):
        state = sim.start(garments, motion.vertices[0], motion.faces, layers=layers)
        sim.step(state, motion.vertices[1])

    run(None)  # what is allocated once and kept
    needed = allocated(lambda: run(layers)) - allocated(lambda: run(None))
    predicted = memory.predict(garments, [motion], FAST, layers=layers).parts["pairs of layers"]
    assert memory.predict(garments, [motion], FAST).parts["pairs of layers"] == 0
    assert 1 / FACTOR < predicted / needed < FACTOR, f"{predicted / 1e6:.1f} MB, measured {needed / 1e6:.1f} MB"


def test_batches_that_do_not_fit(monkeypatch):
    """The system would kill the process, or CUDA fail somewhere in the middle. What the message advises must fit."""
    garments = [garment(20, 13) for _ in range(8)]
    for number, made in enumerate(garments):  # eight meshes, which share nothing
        made.vertices = made.vertices * np.float32(1.0 + 1e-4 * number)
    sim = Simulator(network(), "cpu")
    needed = memory.predict(garments, [walk(1)], sim.network.config).total
    monkeypatch.setattr(memory, "free", lambda device: int(0.85 * needed / memory.USABLE))
    with pytest.raises(NotEnoughMemory, match=r"8 garments need .* MB: .*geodesic weights .*more than") as caught:
        sim.rollout(garments, walk(2))
    message = str(caught.value)
    splits = int(re.search(r"face_splits=(\d+)", message)[1])
    most = int(re.search(r"at most (\d+) of the 8 garments", message)[1])
    assert 1 < most < 8
    sim.rollout(garments, walk(2), face_splits=splits)
    sim.rollout(garments[:most], walk(2))
    with pytest.raises(NotEnoughMemory):
        sim.rollout(garments[: most + 1], walk(2))
    assert issubclass(NotEnoughMemory, MemoryError)

    monkeypatch.setattr(memory, "free", lambda device: 1000)
    with pytest.raises(NotEnoughMemory, match="Coarsen the garments"):
        sim.rollout(skirt(), walk(2))
    monkeypatch.setattr(memory, "free", lambda device: None)  # not known: nothing is refused
    sim.rollout(skirt(), walk(2))


def test_free_memory():
    """The limit would be no limit. What Linux says is more than this process has taken, and at most all there is."""
    available = memory.free("cpu")
    total = next(line for line in open("/proc/meminfo") if line.startswith("MemTotal"))
    assert 2**24 < available <= 1024 * int(total.split()[1])
