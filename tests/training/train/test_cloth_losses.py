"""Losses that see the cloth as a whole, and training on sequences without a recording."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from reference.physics import energies as reference
from support import meshes
from support import sequences as synthetic
from support.runs import SHAPE, config_for, entries_of

from warpgarment.nn import checkpoint
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments
from warpgarment.training.train import start as train
from warpgarment.training.train.cloth_losses import BENT, GRAVITY, STRAINED, ClothLossConfig, ClothLosses, ClothState
from warpgarment.training.train.training_set import NoTrainingData
from warpgarment.training.train.unrolled_objective import UnrollConfig

FPS = 30.0
ALL = ClothLossConfig(normal=1.0, bending=1.0, membrane=1.0, physics=1.0)
MATERIALS = torch.tensor([[0.2, 1e3, 1e3, 1e-3, 1e-5, 0.2], [0.3, 300.0, 200.0, 4e-3, 1e-5, 0.4]])
RESTS = [meshes.icosphere(1), meshes.irregular_grid()]


def losses(config: ClothLossConfig = ALL, counted=(True, True)) -> ClothLosses:
    garments = [Garment(mesh.vertices, mesh.faces) for mesh in RESTS]
    packed = PackedGarments.pack(garments, torch.device("cpu"))
    return ClothLosses(config, packed, MATERIALS, FPS, torch.tensor(counted))


def points(*found: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.concatenate(found).astype(np.float32))


def states() -> list[list[np.ndarray]]:
    """Four states of each of the two garments, some millimetres apart, as exact float32 numbers."""
    rng = np.random.default_rng(2)
    found = []
    for number, mesh in enumerate(RESTS):
        base = meshes.moved(mesh, number, 0.1).vertices
        found.append([(base + rng.normal(0, 2e-3, base.shape)).astype(np.float32) for _ in range(4)])
    return found


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    n = np.cross(b - a, c - a)
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def test_terms_are_those_of_their_formulas():
    """A term has a wrong mean, sign, unit or moment: against float64 twins, one face and one edge at a time. 1e-4:
    float32 positions of strained cloth."""
    found = states()
    expected = {name: [] for name in ALL.terms}
    for mesh, (x, recorded, now, before), m in zip(RESTS, found, MATERIALS.numpy().astype(float), strict=True):
        rest = mesh.vertices.astype(np.float64)
        density, stretch, shear, bend = m[:4]
        both = stretch + 2 * shear
        stiff = [[both, stretch, 0], [stretch, both, 0], [0, 0, shear]]
        energy = [
            (
                reference.membrane_energy(v.astype(np.float64), mesh.faces, rest, stiff),
                reference.bending_energy(v.astype(np.float64), mesh.faces, rest, bend),
            )
            for v in (x, recorded)
        ]
        area = reference.masses(mesh.faces, rest, 1.0).sum()
        edges = reference.edges_of_two(mesh.faces)
        bent = sum(0.5 * bend * np.linalg.norm(rest[j] - rest[i]) * BENT**2 for i, j in edges)
        strained = 0.5 * area * both * STRAINED**2
        expected["normal"].append(((normals(x, mesh.faces) - normals(recorded, mesh.faces)) ** 2).sum(1).mean())
        for name, k, least in (("membrane", 0, strained), ("bending", 1, bent)):
            expected[name].append(np.log((energy[0][k] + least) / (energy[1][k] + least)) ** 2)
        mass = reference.masses(mesh.faces, rest, density)
        x, now, before = (v.astype(np.float64) for v in (x, now, before))
        inertia = reference.inertia_energy(x, 2 * now - before, mass, FPS**2)
        weight = 9.81 * (mass * (x - now)[:, 1]).sum()
        expected["physics"].append((inertia + weight + sum(energy[0])) / (9.81 * mass.sum()))
    state = ClothState(*(points(*(one[k] for one in found)) for k in range(4)))
    values = losses()(state)
    np.testing.assert_allclose(values, [np.mean(expected[name]) for name in ALL.terms], rtol=1e-4)


def test_the_membrane_is_that_before_the_physics_stage():
    """A network would not be told that it squeezes cloth, since the stage folds what it squeezed."""
    found = states()
    state = ClothState(*(points(*(one[k] for one in found)) for k in range(4)))
    cost, squeezed = losses(ClothLossConfig(membrane=1.0)), state.found * torch.tensor([1.0, 0.9, 1.0])
    torch.testing.assert_close(cost(state._replace(solved=squeezed)), cost(state._replace(found=squeezed)))
    assert cost(state._replace(solved=squeezed)) > 1.1 * cost(state)


def test_gradients_are_those_of_finite_differences():
    """Training would go along another slope than that of its loss. Along the way that float32 positions really went;
    5e-3: normals are float32 and losses are curved."""
    found = states()
    state = ClothState(*(points(*(one[k] for one in found)) for k in range(4)))
    generator = torch.Generator().manual_seed(0)
    for name in ALL.terms:
        cost = losses(ClothLossConfig(**{name: 1.0}))
        x = state.found.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(cost(state._replace(found=x)).sum(), x)
        way = torch.rand(x.shape, generator=generator) * gradient.sign()
        ends = [state.found + by * way for by in (1e-5, -1e-5)]
        values = [cost(state._replace(found=end)).double().sum() for end in ends]
        expected = float((gradient.double() * (ends[0].double() - ends[1].double())).sum())
        assert expected == pytest.approx(float(values[0] - values[1]), rel=5e-3), name


def test_free_fall_is_where_the_potential_is_least():
    """Cloth would be pulled elsewhere than where it falls: for rest shapes in flight the gradient vanishes at
    2 x - x' + g h^2, to 1e-3 (float32 positions) of that a tenth of the fall away."""
    cost = losses(ClothLossConfig(physics=1.0))
    now = points(*(mesh.vertices for mesh in RESTS))
    before = now - torch.tensor([0.01, 0.02, -0.005])
    fallen = 2.0 * now - before - torch.tensor([0.0, GRAVITY / FPS**2, 0.0])

    def slope(x: torch.Tensor) -> float:
        x = x.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(cost(ClothState(x, now, now, before)).sum(), x)
        mean = gradient.reshape(-1, 3).sum(0)
        return float(mean.norm())

    away = fallen + torch.tensor([0.0, 0.1 * GRAVITY / FPS**2, 0.0])
    assert slope(fallen) < 1e-3 * slope(away)


def test_garments_without_a_recording_have_only_their_physics():
    """A network's own positions would be targets."""
    found = states()
    state = ClothState(*(points(*(one[k] for one in found)) for k in range(4)))
    both, first, none = (losses(counted=c)(state) for c in ((True, True), (True, False), (False, False)))
    assert (none[:3] == 0).all()
    assert ((first[:3] > 0) & (first[:3] < both[:3])).all()
    assert none[3] == both[3]


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    synthetic.write(folder, "recorded", frames=16, manifest={"number": 0})
    synthetic.write(folder, "validation", "validation", frames=8, seed=2)
    return folder


def test_training_with_these_terms_lowers_them(data, tmp_path):
    """Gradients of the terms do not reach the weights: the amount of folds must come nearer to the recording's."""
    options = {"overrides": (*SHAPE, "history=3", "dropout=0.0"), "unroll": UnrollConfig(steps=2, position=0.0)}
    options |= {"steps": 10, "batch_size": 2, "log_every": 1, "validate_sequences": 0, "lr": 3e-3, "splits": 1}
    config = config_for(data, tmp_path / "run", **options, cloth=ClothLossConfig(bending=10.0, membrane=1.0))
    train.train(config)
    entries = entries_of(tmp_path / "run")
    first, last = (np.mean([e["loss_bending"] for e in part]) for part in (entries[:3], entries[-3:]))
    assert last < 0.8 * first
    parts = [e["loss_deformation"] + e["loss_singular_values"] + 3 * e["loss_velocity"] for e in entries]
    for entry, rest in zip(entries, parts, strict=True):
        total = rest + 10.0 * entry["loss_bending"] + entry["loss_membrane"]
        assert entry["loss"] == pytest.approx(total, rel=1e-4)


def test_sequences_without_a_recording_train_on_physics_alone(data, tmp_path):
    """A user's garment without a recording is refused with --cloth.physics, or taken without; or a network's own
    positions are targets."""
    synthetic.write(data, "own", frames=16, seed=3, manifest={"recorded": False})
    options = {"overrides": (*SHAPE, "history=3", "dropout=0.0"), "unroll": UnrollConfig(steps=2)}
    options |= {"steps": 3, "batch_size": 2, "log_every": 1, "validate_sequences": 0, "splits": 1}
    for folder in data.iterdir():
        path = folder / "manifest.json"
        content = json.loads(path.read_text())
        if folder.name == "recorded":
            path.write_text(json.dumps(content | {"recorded": False}))
    with pytest.raises(NoTrainingData, match=r"no recording; cloth\.physics"):
        train.train(config_for(data, tmp_path / "none", **options))
    train.train(config_for(data, tmp_path / "run", **options, cloth=ClothLossConfig(physics=1.0)))
    for entry in entries_of(tmp_path / "run"):
        assert entry["loss"] == pytest.approx(entry["loss_physics"], rel=1e-6)
        assert entry["loss_deformation"] == entry["loss_velocity"] == entry["position_m"] == 0.0
        assert entry["gradient_norm"] > 0.0
    assert checkpoint.load(tmp_path / "run" / "network.safetensors").parameter_count() > 0


def test_weights_that_mean_nothing_are_refused(data, tmp_path):
    """A weight would be ignored: in training of single steps, of networks that predict positions, or below zero."""
    with pytest.raises(ValueError, match=r"cloth\.bending is a loss of unrolled training"):
        config_for(data, tmp_path, cloth=ClothLossConfig(bending=1.0))
    with pytest.raises(ValueError, match=r"cloth\.physics is a loss of unrolled training of networks of faces"):
        config_for(
            data,
            tmp_path,
            network="layersnet",
            overrides=(),
            unroll=UnrollConfig(steps=2),
            cloth=ClothLossConfig(physics=1.0),
        )
    with pytest.raises(ValueError, match=r"cloth\.normal must be at least 0"):
        ClothLossConfig(normal=-1.0)
