"""What holds for every kind of network: files, order of vertices, heading, padding, a training step, memory."""

from __future__ import annotations

import dataclasses
import sys
import types
import typing
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support import sequences as synthetic_sequences
from support.memory import allocated
from support.runs import config_for, losses_of
from support.scenes import outfit, skirt, tube, walk

from warpgarment.errors import CheckpointError
from warpgarment.kernels.features.channels import FACE
from warpgarment.kernels.features.skin import bind
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import ARCHITECTURES, GrowthError, architecture, build_network, preset
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import FrameInputs, NetworkSizes
from warpgarment.nn.network import GarmentNetwork
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedBodies, PackedGarments
from warpgarment.sim.simulator import Simulator
from warpgarment.training.train.config import TrainConfig
from warpgarment.training.train.start import train

TINY = {"embedding": 16, "layers": 1, "feed_forward": 16, "heads": 2, "manifold_heads": 1, "history": 3, "dropout": 0.0}
TINY |= {"geodesic_power": 2.0, "geodesic_radius": 0.2, "patch_spacing": 0.15, "residual": True, "norm_first": True}
TINY |= {"face_embedding": 16, "face_feed_forward": 16, "face_layers": 1, "heading": "canonical"}
OWN = {"layers": {"world_heads": 1, "body_radius": 0.25, "patch_radius": 0.2, "decoder": 16}}
CPU = torch.device("cpu")

every_kind = pytest.mark.parametrize("kind", ARCHITECTURES)


def settings(kind: str, **changes) -> NetworkConfig:
    """The first named shape of a kind, made tiny."""
    return dataclasses.replace(next(iter(architecture(kind).presets.values())), **(TINY | OWN.get(kind, {}) | changes))


def made(kind: str, **changes) -> GarmentNetwork:
    """Random weights whose output is small: a few millimetres and degrees a frame."""
    torch.manual_seed(0)
    network = build_network(settings(kind, **changes))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    scales = {"psi_std": 0.02, "singular_value_std": 2e-3, "q_std": 2e-3, "acceleration_std": 2e-4}
    lengths = network.statistics
    network.set_statistics({name: torch.full((lengths[name],), v) for name, v in scales.items() if name in lengths})
    return network.eval()


def rollout(network: GarmentNetwork, garments, body: BodyMotion, frames: int = 5, **options):
    """Without collisions, whose contacts come and go with rounding."""
    return Simulator(network, "cpu", collision_passes=0).rollout(garments, body, frames=frames, **options)


@every_kind
def test_presets_are_of_their_kind(kind):
    """`--network` would offer a name that trains another kind, or not offer one that there is."""
    for name, config in architecture(kind).presets.items():
        assert preset(name) == config
        assert config.architecture == kind
        assert isinstance(config, architecture(kind).config)
    named = {name for known in ARCHITECTURES for name in architecture(known).presets}
    assert set(typing.get_args(typing.get_type_hints(TrainConfig)["network"])) == named
    with pytest.raises(ValueError, match=r"no network 'huge'; there are base, small, fast"):
        preset("huge")


@every_kind
def test_save_and_load(kind, tmp_path, monkeypatch):
    """A trained network would not be the one that is loaded; or a name in a file would decide what is imported."""
    network = made(kind)
    network.save(tmp_path / "network.safetensors")
    loaded = checkpoint.load(tmp_path / "network.safetensors")
    assert type(loaded) is type(network)
    assert loaded.config == network.config
    assert not loaded.training
    assert loaded.state_dict().keys() == network.state_dict().keys()
    for name, tensor in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name
    monkeypatch.setitem(ARCHITECTURES, "other", ARCHITECTURES[kind])
    object.__setattr__(network.config, "architecture", "other")
    network.save(tmp_path / "other.safetensors")
    monkeypatch.delitem(ARCHITECTURES, "other")
    with pytest.raises(CheckpointError, match=r"architecture must be .*got 'other'"):
        checkpoint.load(tmp_path / "other.safetensors")


@every_kind
def test_order_of_vertices_does_not_matter(kind):
    """Motion would depend on how a mesh file numbers vertices and faces.

    1e-4 m: sums in another order over three frames, and a Poisson solve to its own tolerance of that size.
    """
    garment, rng = outfit(), np.random.default_rng(3)
    vertices, faces = rng.permutation(len(garment.vertices)), rng.permutation(len(garment.faces))
    place = np.argsort(vertices)
    other = Garment(garment.vertices[vertices], place[garment.faces[faces]].astype(np.int32))
    expected = rollout(made(kind), garment, walk(4), 4).vertices
    found = rollout(made(kind), other, walk(4), 4).vertices
    assert np.abs(expected[-1] - expected[0]).max() > 0.01  # it moves
    assert np.abs(found - expected[:, vertices]).max() < 1e-4


@every_kind
def test_yaw_turns_the_answer(kind):
    """A garment would move otherwise on a body that faces another way, with a heading that the network takes out.

    1e-4 m: float32 of positions up to a metre, over three frames, whose rounding the network's weights enlarge.
    """
    garment, motion = skirt(), walk(4)
    turn = Rotation.from_euler("y", 2.0).as_matrix().astype(np.float32)
    turned = BodyMotion(motion.vertices @ turn.T, motion.faces, motion.fps)
    plain = rollout(made(kind), garment, motion, 4).vertices
    found = rollout(made(kind), garment, turned, 4, first_vertices=garment.vertices @ turn.T).vertices
    assert np.abs(plain[-1] - plain[0]).max() > 0.01
    assert np.abs(found - plain @ turn.T).max() < 1e-4


@every_kind
def test_a_batch_is_its_garments_alone(kind):
    """Garments of one batch would influence each other, or padding would influence them.

    2e-5 m: float32 sums of other lengths, four frames.
    """
    garments, network = [skirt(), outfit(), skirt()], made(kind)
    bodies = [walk(5) for _ in garments]  # garments on one body may see each other
    together = rollout(network, garments, bodies)
    for garment, motion in zip(garments, together, strict=True):
        assert np.abs(motion.vertices - rollout(network, garment, walk(5)).vertices).max() < 2e-5


@every_kind
@pytest.mark.parametrize("splits", [1, 3])
def test_face_splits(kind, splits):
    """A kind that needs whole garments would get parts of them, or a kind that can take parts would not."""
    packed = PackedGarments.pack([skirt()], CPU)
    layout = made(kind).layout([skirt()], packed, face_splits=splits)
    if architecture(kind).positions:
        assert layout.cloth.patches == made(kind).layout([skirt()], packed).cloth.patches
        return
    rows = sum(len(view.face_index) for view in layout.views)
    assert rows == (splits if architecture(kind).subsets else 1)
    assert torch.equal(layout.face_component, packed.face_component)


@every_kind
@pytest.mark.parametrize("splits", [2, 1])
def test_a_training_step(kind, splits, tmp_path):
    """A kind could be simulated with but not trained, on parts of garments or on whole ones."""
    data = synthetic_sequences.write_set(tmp_path / "set", train=2, frames=8)
    name = next(iter(architecture(kind).presets))
    shape = tuple(f"{key}={value}" for key, value in (TINY | OWN.get(kind, {})).items())
    options = {"network": name, "overrides": shape, "steps": 2, "splits": splits, "batch_size": 2, "lr": 1e-2}
    path = train(config_for(data, tmp_path / "run", **options))
    assert all(np.isfinite(list(losses_of(tmp_path / "run").values())))
    trained = checkpoint.load(path)
    assert trained.config == settings(kind)
    last = trained.decoder[-1] if architecture(kind).positions else trained.face_head
    assert last.weight.any()  # a residual network starts at zero


@every_kind
@pytest.mark.parametrize("number", [1, 6])
def test_memory_is_within_its_forecast(kind, number):
    """A batch that fits would be refused, or one that does not fit accepted.

    Factor 1.5 of torch's count, as in memory.py. Of the layout and one call of the network, on garments of 768 faces
    with made-up distances.
    """
    config = dataclasses.replace(next(iter(architecture(kind).presets.values())), layers=1)
    network, garments = build_network(config).eval(), []
    for _ in range(number):
        garment = Garment(*tube(24, 17, bottom=-0.3, top=0.3))
        centroids = garment.vertices[garment.faces].mean(axis=1)
        garment.__dict__["geodesics"] = np.linalg.norm(centroids[:, None] - centroids, axis=2).astype(np.float32)
        garments.append(garment)
    packed = PackedGarments.pack(garments, CPU)
    features = torch.randn(len(packed.faces), config.history, FACE.width)
    velocities = torch.zeros(packed.component_count, config.history - 1, 3)
    rest, beneath = packed.rest_vertices, garments[0]
    bodies = PackedBodies.pack([beneath.faces], [len(beneath.vertices)], [0] * number, CPU)
    body = torch.from_numpy((beneath.vertices * [0.9, 1.0, 0.9]).astype(np.float32))
    past = {"previous": rest.expand(2, -1, -1), "previous_body": body.expand(2, -1, -1), "bodies": bodies}
    on = np.zeros(len(rest), np.int64)
    skin = bind(rest.numpy(), on, body.numpy(), bodies.vertex_offsets, CPU)

    @torch.inference_mode()
    def call() -> None:
        layout = network.layout(garments, packed)
        network.predict(FrameInputs(features, velocities, rest, body, body, skin=skin, **past), layout)

    sizes = NetworkSizes(garments, cpu=True, body_vertices=len(body))
    forecast = dict(architecture(kind).memory(sizes, config))
    forecast.pop("geodesic distances", None)  # they are made up, before the count begins
    passing = max(forecast.pop(name, 0) for name in ("network", "making weights"))
    assert 1 / 1.5 < (sum(forecast.values()) + passing) / allocated(call) < 1.5


@every_kind
def test_starting_from_a_network(kind):
    """`--init` would change a network that is to be trained further in its own shape, or grow one without a rule."""
    network = made(kind)
    assert architecture(kind).start_from(network, network.config, grow=False) is network
    larger = dataclasses.replace(network.config, embedding=32, heads=4, manifold_heads=2)
    try:
        grown = architecture(kind).start_from(network, larger, grow=True)
    except GrowthError as error:
        assert "Leave out grow" in str(error)  # noqa: PT017 (some kinds grow)
    else:
        assert grown.config == larger


@dataclasses.dataclass(frozen=True)
class OwnConfig(NetworkConfig):
    """Settings of a kind that has one more than others."""

    rounds: int = 3


def test_settings_of_a_kind_of_its_own(tmp_path, monkeypatch):
    """Settings of a user's kind would be lost on the way to a file, refused in it, or not be there to override."""

    class Own(type(architecture("faces"))):
        config = OwnConfig

    module = types.ModuleType("own")
    monkeypatch.setitem(sys.modules, "own", module)
    monkeypatch.setitem(ARCHITECTURES, "own", "own")
    module.ARCHITECTURE = Own()
    module.ARCHITECTURE.presets = {"mine": OwnConfig(**TINY, architecture="own")}
    config = TrainConfig(Path(), Path(), network="mine", overrides=("rounds=5", "layers=2"), steps=1).network_config()
    assert config == OwnConfig(**(TINY | {"layers": 2}), architecture="own", rounds=5)
    config = TrainConfig(Path(), Path(), overrides=("architecture=own", "rounds=4"), steps=1).network_config()
    assert config == OwnConfig(**(vars(NetworkConfig.small()) | {"architecture": "own"}), rounds=4)
    with pytest.raises(ValueError, match="no network setting 'rounds'"):
        TrainConfig(Path(), Path(), overrides=("rounds=4",), steps=1).network_config()
    build_network(config).save(tmp_path / "own.safetensors")
    assert checkpoint.load(tmp_path / "own.safetensors").config == config


def test_names_that_there_are_not():
    """A misspelt kind would end in a stack trace of an import."""
    with pytest.raises(ValueError, match='architecture must be "faces", "patches" or "layers", got \'tokens\''):
        architecture("tokens")
    with pytest.raises(ValueError, match="got 'tokens'"):
        TrainConfig(Path(), Path(), overrides=("architecture=tokens",), steps=1).network_config()
