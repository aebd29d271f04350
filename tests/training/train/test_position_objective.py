"""Training of networks that predict positions: samples, losses, the rollouts before them, a run."""

from __future__ import annotations

import dataclasses
import json
import sys
import types

import igl
import numpy as np
import pytest
import torch
from support import sequences
from support.outfits import GARMENTS, MATERIAL, TRAINED, batch_of, builder_of, network_of, recorded
from support.runs import config_for, entries_of
from support.sequences import two_layers

from warpgarment.errors import MeshError
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import ARCHITECTURES, Architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import VertexStep
from warpgarment.nn.layers.config import LayersNetConfig
from warpgarment.nn.layers.network import LayersNet
from warpgarment.nn.network import GarmentNetwork
from warpgarment.objects.body import BodyMotion
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.rollouts import predict
from warpgarment.training.samples.statistics import position_statistics
from warpgarment.training.train.config import TrainConfig
from warpgarment.training.train.position_objective import PositionConfig, PositionObjective, vertex_normals
from warpgarment.training.train.start import train
from warpgarment.training.train.unrolled_objective import UnrollConfig

SHAPE = tuple(f"{name}={value}" for name, value in TRAINED.items())


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Recorded outfits."""
    return recorded(tmp_path_factory.mktemp("layers"))


class Told(LayersNet):
    """Answers with given frames, whatever its inputs are, and keeps these."""

    def told(self, frames):
        self.frames, self.seen, self.modes = frames, [], []
        return self

    def predict(self, inputs, layout, *, bfloat16=False):
        self.seen.append(inputs)
        self.modes.append((self.training, torch.is_grad_enabled()))
        after = self.frames[len(self.seen) - 1]
        return VertexStep(after, layout.cloth.means(after))


def told(frames) -> Told:
    """A network that knows its answers."""
    torch.manual_seed(0)
    return Told(LayersNetConfig(**TRAINED)).told(frames).train()


def test_losses_of_known_frames(data):
    """A term would be measured otherwise than it is described. 1e-5 of values near one, in float32."""
    batch = batch_of(data, network_of())
    offset = torch.tensor([0.03, 0.0, 0.04])  # 0.5 dm
    objective = PositionObjective(told([batch.frames[3] + offset]), PositionConfig(body=0.0, layers=0.0), "float32")
    losses = dict(zip(objective.figures, objective(batch).tolist(), strict=True))
    assert losses["loss_position"] == pytest.approx(0.25, rel=1e-4)
    assert losses["loss_patch"] == pytest.approx(0.25, rel=1e-4)
    assert losses["loss_normal"] == pytest.approx(0.0, abs=1e-8)
    assert losses["position_m"] == pytest.approx(0.05, rel=1e-4)
    assert losses["loss"] == pytest.approx(0.5, rel=1e-4)
    exact = PositionObjective(told([batch.frames[3]]), PositionConfig(), "float32")(batch)
    assert exact[:4].abs().max() < 1e-9


def test_normals_against_igl(data):
    """Normals of another weighting would be compared. 1e-5, of unit vectors in float32."""
    garment = Sequence.load(data / "a").garment
    found = vertex_normals(torch.tensor(garment.vertices), torch.tensor(garment.faces))
    expected = igl.per_vertex_normals(garment.vertices.astype(float), garment.faces.astype(np.int64), 1)
    assert np.abs(found.numpy() - expected).max() < 1e-5


def distances(points: torch.Tensor, body, frame: int) -> np.ndarray:
    """Signed distances from a body in a frame by libigl [m]."""
    mesh = body.vertices[frame].astype(float), body.faces.astype(np.int64)
    where = points.numpy().astype(float)
    inside = igl.fast_winding_number(*mesh, where) > 0.5
    return np.sqrt(igl.point_mesh_squared_distance(where, *mesh)[0]) * np.where(inside, -1, 1)


def test_collisions_with_the_body(data):
    """Cloth in the body would not be pushed out, or cloth outside would. Against libigl, 1e-4 of the loss."""
    batch = batch_of(data, network_of())
    frame = batch.frames[3].clone()
    count = len(frame) // 2
    sequence = Sequence.load(data / "a")
    body = sequence.body()
    middle = torch.tensor(body.vertices[6].mean(axis=0), dtype=torch.float32)
    frame[:7, [0, 2]] = middle[[0, 2]] + 0.3 * (frame[:7, [0, 2]] - middle[[0, 2]])
    answer = frame.requires_grad_()
    config = PositionConfig(position=0, patch=0, normal=0, layers=0, rollout=0)
    objective = PositionObjective(told([answer]), config, "float32")
    objective.progress = 1.0
    losses = objective(batch)
    losses[0].backward()
    distance = distances(answer.detach()[:count], body, 6)
    inside = np.flatnonzero(distance < 1e-4)
    assert len(inside) == 7
    assert losses[4].item() == pytest.approx(np.mean((10 * (1e-4 - distance[inside])) ** 2), rel=1e-4)
    moved = answer.grad.norm(dim=1).nonzero()[:, 0].tolist()
    assert moved == inside.tolist()
    step = answer.detach() - 1e-3 * answer.grad / answer.grad.norm(dim=1, keepdim=True).clamp(min=1e-12)
    after = distances(step[:count], body, 6)
    assert (after[inside] - distance[inside]).min() > 0.9e-3  # straight out


def test_collisions_between_layers(data):
    """The outer garment would not be kept outside the inner one, or the inner one would be moved, or the garment of the
    next body be kept out of the last one of this."""
    batch = batch_of(data, network_of())
    frame = batch.frames[3].clone()
    count = len(frame) // 4  # of a garment
    chosen = count + torch.arange(14, 20)  # of the outer one, moved to 4 mm within the inner one
    inner = frame[14:20]
    middle = frame[:count].mean(dim=0)
    out = inner - middle
    out[:, 1] = 0
    frame[chosen] = inner - 4e-3 * out / out.norm(dim=1, keepdim=True)
    answer = frame.requires_grad_()
    objective = PositionObjective(
        told([answer]), PositionConfig(position=0, patch=0, normal=0, body=0, layers=1.0, rollout=0), "float32"
    )
    objective.progress = 1.0
    losses = objective(batch)
    losses[0].backward()
    assert answer.grad.norm(dim=1).nonzero()[:, 0].tolist() == chosen.tolist()
    assert 0.02**2 < losses[5].item() < 0.05**2  # 4 mm in dm, a little less to the flat faces
    assert ((-answer.grad[chosen] * out).sum(dim=1) > 0).all()


def test_rollouts_before_the_loss(data):
    """The step from which predictions replace the truth would not be that of the sample, or gradients would flow
    through earlier steps. Exact."""
    network = network_of()
    batch = batch_of(data, network, ((0, 9), (1, 9)), ahead=4)
    answers = [batch.frames[3 + k] + 0.001 * (k + 1) for k in range(5)]
    batch = dataclasses.replace(batch, draw=torch.tensor([0.0, 0.5]))  # from the start, and from the middle
    objective = PositionObjective(told(answers), PositionConfig(rollout=4, body=0, layers=0), "float32")
    objective.progress = 1.0
    assert objective.ahead(batch) == 4
    objective(batch)
    seen, modes = objective.network.seen, objective.network.modes
    assert modes == [(False, False)] * 4 + [(True, True)]
    first, second = (batch.sample_of_vertex == k for k in (0, 1))
    for k, inputs in enumerate(seen):
        assert torch.equal(inputs.next_body, batch.body[3 + k])
        frames = [inputs.vertices, *inputs.previous]
        for j, frame in enumerate(frames):  # frame t - j
            number = k - 1 - j  # of the answer that it is, if it is one
            for mine, start in ((first, 0), (second, 2)):
                predicted = number >= start or (number >= 0 and start == 0)
                wanted = answers[number] if predicted else batch.frames[2 + k - j]
                assert torch.equal(frame[mine], wanted[mine]), (k, j, start)


def test_rollouts_grow(data):
    """Long rollouts would come before the network can do a step, or never. Exact."""
    batch = batch_of(data, network_of(), ahead=9)
    objective = PositionObjective(network_of(), PositionConfig(rollout=9), "float32")
    for epoch in range(10):
        objective.progress = (epoch + 0.5) / 10
        assert objective.ahead(batch) == epoch


def test_several_steps_with_gradient(data):
    """A prediction would not be the input of the next step, or no gradient would flow through it."""
    network = network_of().train()
    batch = batch_of(data, network, steps=3)
    losses = PositionObjective(network, PositionConfig(), "float32")(batch)
    losses[0].backward()
    long = network.decoder[-1].weight.grad.clone()
    network.zero_grad()
    assert torch.isfinite(long).all()
    single = batch_of(data, network)
    PositionObjective(network, PositionConfig(), "float32")(single)[0].backward()
    assert (long - network.decoder[-1].weight.grad).abs().max() > 1e-6


@pytest.mark.parametrize("still", [True, False])
def test_gradients_of_several_steps_are_finite(data, still):
    """Training would stop at still air: its speed has no derivative at zero, and directions turn with the cloth."""
    network = network_of().train()
    batch = batch_of(data, network, steps=2)
    if still:
        batch = dataclasses.replace(batch, wind=torch.zeros_like(batch.wind))
    PositionObjective(network, PositionConfig(), "float32")(batch)[0].backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is None or torch.isfinite(parameter.grad).all(), name


def test_a_few_steps_lower_the_loss(data):
    """Gradients would not lead downhill. The loss of one batch falls to less than half within 20 steps."""
    network = network_of(residual=True).train()
    builder = builder_of(data, network)
    batches = [builder.build([(0, t), (1, t)], None, np.random.default_rng(t)) for t in (4, 6, 8)]
    network.set_statistics(position_statistics(batches, network))
    objective = PositionObjective(network, PositionConfig(body=0.0, layers=0.0), "float32")
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    found = []
    for _ in range(20):
        optimiser.zero_grad()
        losses = objective(batches[0])
        losses[0].backward()
        optimiser.step()
        found.append(losses[0].item())
    assert found[-1] < 0.5 * found[0]


def test_a_run(data, tmp_path):
    """`train --network layersnet` would not train, validate on whole outfits, save, or resume with the same losses."""
    options = {
        "network": "layersnet", "overrides": SHAPE, "steps": 6, "batch_size": 2, "validate_every": 4,
        "outfit": PositionConfig(rollout=2), "lr": 1e-3,
    }  # fmt: skip
    path = train(config_for(data, tmp_path / "run", **options))
    loaded = checkpoint.load(path)
    assert isinstance(loaded, LayersNet)
    assert (loaded.acceleration_std != 1).any()
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert any(np.isfinite(line.get("rollout_error_cm", np.nan)) for line in log)
    assert {"loss_position", "loss_normal", "loss_layers"} < entries_of(tmp_path / "run")[0].keys()
    again = train(config_for(data, tmp_path / "run", **(options | {"resume": True, "steps": 8})))
    assert len(entries_of(tmp_path / "run")) == 8
    assert again.exists()


def test_settings_that_do_not_fit():
    """A setting would be silently without effect, or end in a stack trace."""
    with pytest.raises(ValueError, match="predict positions are not compiled"):
        TrainConfig("data", "out", steps=1, network="layersnet", compile=True)
    with pytest.raises(ValueError, match=r"outfit.body must be at least 0, got -1"):
        PositionConfig(body=-1)
    with pytest.raises(ValueError, match=r"outfit.rollout must be at most 64, got 100"):
        PositionConfig(rollout=100)


@pytest.mark.parametrize("cold", [True, False])
def test_recorded_outfits_are_rolled_out_garment_by_garment(data, cold):
    """Validation would simulate an outfit as one garment, or without its wind and materials. Bit for bit."""
    sequence, simulator = Sequence.load(data / "d"), Simulator(network_of(), "cpu")
    newest, first = 4, 4 if cold else 2
    found = predict(simulator, sequence, newest, 5, cold=cold)
    garments = list(sequence.worn)
    assert [len(garment.vertices) for garment in garments] == [len(sequence.garment.vertices) // 2] * 2
    assert sequence.materials == (MATERIAL, None)
    body = sequence.body()
    part = BodyMotion(body.vertices[first:10], body.faces, body.fps)
    known = [np.array(sequence.vertices[first : newest + 1, layer.vertices]) for layer in sequence.layers]
    start = {"first_vertices": [k[0] for k in known]} if cold else {"history": known}
    direct = simulator.rollout(garments, part, materials=[MATERIAL, None], wind=sequence.wind[first:10], **start)
    for layer, motion in zip(sequence.layers, direct, strict=True):
        np.testing.assert_array_equal(found[:, layer.vertices], motion.vertices[newest + 1 - first :])


def test_a_material_that_is_none(data, tmp_path):
    """A manifest of nonsense would end in a stack trace."""
    wrong = {"garments": [GARMENTS[0], {"name": "outer", "material": {"density": -1.0}}]}
    sequence = Sequence.load(sequences.write(tmp_path, "e", frames=8, spoil=two_layers, manifest=wrong))
    with pytest.raises(MeshError, match=r"e: material of outer: a material's density must be positive"):
        _ = sequence.materials


class Drift(GarmentNetwork):
    """Every vertex moves on at one learned speed."""

    def __init__(self, config):
        super().__init__(config)
        self.speed = torch.nn.Parameter(torch.zeros(3))

    def layout(self, garments, packed, *, face_splits=1):
        return None

    def predict(self, inputs, layout, *, bfloat16=False):
        return VertexStep(inputs.vertices + self.speed)


class DriftArchitecture(Architecture):
    config, subsets = NetworkConfig, False

    def build(self, config):
        return Drift(config)

    def memory(self, sizes, config):
        return {"network": 0}

    def flops(self, config, faces, components, rows):
        return 0, 0


@pytest.mark.parametrize("positions", [True, False])
def test_any_network_that_predicts_positions(data, tmp_path, monkeypatch, positions):
    """A user's network of positions could not be trained; or one whose kind hides that would end in a stack trace."""
    module = types.ModuleType("drift")
    module.ARCHITECTURE = DriftArchitecture()
    module.ARCHITECTURE.positions = positions
    monkeypatch.setitem(sys.modules, "drift", module)
    monkeypatch.setitem(ARCHITECTURES, "drift", "drift")
    module.ARCHITECTURE.presets = {"drift": NetworkConfig(architecture="drift", history=3)}
    options = {"network": "drift", "overrides": (), "steps": 4, "batch_size": 2, "outfit": PositionConfig(rollout=1)}
    config = config_for(data, tmp_path / "run", **options, unroll=UnrollConfig(steps=2))
    if positions:
        assert checkpoint.load(train(config)).speed.abs().min() > 1e-5
        return
    with pytest.raises(ValueError, match=r"a Drift has no forward_normalised.* set positions = True"):
        train(config)
