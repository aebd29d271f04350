"""Training samples: they are what a rollout would see, and noise and symmetry are undone by their targets."""

from __future__ import annotations

import inspect
import itertools
import typing
from pathlib import Path

import numpy as np
import pytest
import torch
from support import sequences as synthetic_sequences

from warpgarment.kernels.deformation.gradients import deformation_gradient
from warpgarment.kernels.features.channels import FEATURES, LAYOUT
from warpgarment.kernels.features.face import body_interaction, face_features
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.nn.attention import geodesic_weights
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.nn.heading import canonical_frame, rotate_features, rotate_vectors
from warpgarment.nn.inputs import NormalisedOutput
from warpgarment.nn.parametrisation import NetworkOutput, Step, context, targets
from warpgarment.nn.run import rotate_output
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.samples import interactions
from warpgarment.training.samples.augmentation import Augmentation, mirror
from warpgarment.training.samples.noise import NoiseBasis, NoiseConfig
from warpgarment.training.samples.recorded import SequenceData
from warpgarment.training.samples.single_step import SampleBuilder
from warpgarment.training.train import losses
from warpgarment.training.train.losses import LossConfig, loss

SMALL = NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2, dropout=0.1, geodesic_radius=0.2)
QUIET = NoiseConfig(position=0.0, offset=0.0)
PLAIN = Augmentation(mirror=0.0, yaw=0.0)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return synthetic_sequences.write_set(tmp_path_factory.mktemp("set") / "sequences", train=3, frames=16, pins=4)


@pytest.fixture(scope="module")
def loaded(data) -> SequenceData:
    folder = data / "train_0"
    return SequenceData(Sequence.load(folder), folder, interactions.default_cache(data), SMALL, torch.device("cpu"))


def plain_sample(sequence: Sequence, t: int, history: int):
    """Features [1,F,H*34], velocities, Phi of frames t and t+1, all in world space, one frame after another."""
    garment, body = sequence.garment, sequence.body()
    rest, faces = torch.from_numpy(garment.vertices), torch.from_numpy(garment.faces)
    inverse = _inverse(garment.vertices, garment.faces)
    bodies = torch.from_numpy(np.array(body.vertices, np.float32))
    rows, centres = [], []
    for frame in range(t - history + 1, t + 1):
        now = max(frame, 0)
        vertices = torch.from_numpy(np.array(sequence.vertices[now]))
        centroids = vertices[faces.long()].mean(dim=1)
        meshes = BodyMeshes(bodies[now].contiguous(), torch.from_numpy(body.faces))
        after = bodies[now + 1 if frame >= 0 else now]  # before the first frame the body stands still
        found = body_interaction(centroids.contiguous(), None, meshes, after.contiguous())
        mean = centroids.mean(dim=0, keepdim=True)
        garment_of_face = torch.zeros(len(faces), dtype=torch.int32)
        rows.append(face_features(inverse, vertices, faces, garment_of_face, mean, found))
        centres.append(mean)
    velocities = torch.cat([b - a for a, b in itertools.pairwise(centres)]).reshape(1, 1, -1)
    newest, following = (torch.from_numpy(np.array(sequence.vertices[k])) for k in (t, t + 1))
    phi, phi_next = (deformation_gradient(rest, v, faces) for v in (newest, following))
    q = following[faces.long()].mean(dim=(0, 1)) - newest[faces.long()].mean(dim=(0, 1))
    return torch.stack(rows, 1).reshape(1, len(faces), -1), velocities, phi, phi_next, q


def _inverse(rest: np.ndarray, faces: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.linalg.inv(_frames(rest.astype(np.float64), faces)).astype(np.float32))


def _frames(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.stack([b - a, c - a, normal / np.linalg.norm(normal, axis=1, keepdims=True)], axis=-1)


@pytest.mark.parametrize("t", [0, 4, 12])
def test_sample_is_what_the_network_sees(loaded, t):
    """Wrong history order, cold start, heading or cache: a sample differs from features made frame by frame in world
    space.

    Tolerance 2e-4: the sample is turned before the features are computed, in float32, the other after. A closest
    point on an edge belongs to two body faces, and a mesh built anew may name the other one than a refitted mesh:
    such ties are left out.
    """
    builder = SampleBuilder([loaded], SMALL, QUIET, PLAIN)
    batch = builder.build([(0, t)], len(loaded.faces), np.random.default_rng(0))
    features, velocities, phi, phi_next, q = plain_sample(loaded.source, t, SMALL.history)
    frame = canonical_frame(features)
    turned, turned_velocities = rotate_features(features, frame), rotate_vectors(velocities, frame)
    wrong = ((batch.features - turned).abs().unflatten(-1, (-1, FEATURES)) > 2e-4).any(dim=(0, 2))  # [F,34]
    tied = wrong[:, 19:31].any(dim=1)
    assert not wrong[:, :19].any()
    assert not wrong[:, 31:].any()
    assert tied.float().mean() < 0.5
    torch.testing.assert_close(batch.velocities, turned_velocities, atol=1e-5, rtol=0)
    psi = torch.from_numpy(phi_next.double().numpy() @ np.linalg.inv(phi.double().numpy())).float()
    sigma = torch.from_numpy(np.linalg.svd(phi_next.double().numpy(), compute_uv=False)).float()
    step = Step(psi[None], sigma[None], q[None, None])
    said = targets(step, context(features, torch.zeros(1, len(phi), dtype=torch.int64), 1), residual=True)
    said = rotate_output(said, frame)
    torch.testing.assert_close(batch.target.psi[:, ~tied], said.psi[:, ~tied], atol=5e-4, rtol=0)
    torch.testing.assert_close(batch.target.singular_values, said.singular_values, atol=2e-4, rtol=0)
    torch.testing.assert_close(batch.target.velocity, said.velocity, atol=0.02 * float(q.norm()), rtol=0)  # ties, again
    distances = torch.from_numpy(loaded.source.garment.geodesics.copy())[None]
    weights = geodesic_weights(distances, SMALL.geodesic_radius, SMALL.geodesic_power)
    torch.testing.assert_close(batch.weights, weights, atol=2e-3, rtol=2e-3)  # kept in float16: 1e-3 relative


def test_displaced_history_leads_back(loaded):
    """Targets not relative to the displaced frame: the answer would not restore the recorded next frame.

    Psi_out R Phi~ must be the recorded Phi_{t+1} (turned), z~ + q its centre. 2e-3: float32, Psi of strained faces.
    """
    config = NetworkConfig.small(embedding=16, layers=1, heads=2, residual=False, heading="world")
    world = SequenceData(loaded.source, loaded.source.folder, interactions.default_cache(loaded.source.folder.parent),
                         config, torch.device("cpu"))  # fmt: skip
    builder = SampleBuilder([world], config, NoiseConfig(position=0.006, offset=0.01, clean=0.0, spread=1.0), PLAIN)
    batch = builder.build([(0, 11)], len(world.faces), np.random.default_rng(3))
    newest = batch.features[..., -FEATURES:]
    phi = newest[..., LAYOUT["deformation_gradient"]].reshape(-1, 3, 3)
    vertices = torch.from_numpy(np.array(loaded.source.vertices[11:13]))
    recorded = deformation_gradient(world.rest, vertices[0], world.faces)
    assert (phi - recorded).abs().amax() > 0.02  # it was displaced
    wanted = deformation_gradient(world.rest, vertices[1], world.faces)
    torch.testing.assert_close(batch.target.psi[0] @ phi, wanted, atol=2e-3, rtol=0)
    corners = vertices[1][world.faces.long()]
    moved = corners.mean(dim=(0, 1)) - vertices[0][world.faces.long()].mean(dim=(0, 1))
    assert (batch.target.velocity[0, 0] - moved).norm() > 1e-4  # q makes up for the offset


def test_override_displaces_the_newest_frames(loaded):
    """A pushforward override lands on the wrong frames, or the target ignores it."""
    builder = SampleBuilder([loaded], SMALL, QUIET, PLAIN)
    shift = np.zeros((2, len(loaded.rest), 3), np.float32)
    shift[:, :, 1] = 0.01
    plain = builder.build([(0, 12)], 20, np.random.default_rng(5))
    moved = builder.build([(0, 12)], 20, np.random.default_rng(5), [shift])
    jump = (moved.velocities - plain.velocities).reshape(-1, 3)
    expected = torch.zeros_like(jump)
    expected[-2, 1] = 0.01  # up between the frames t-2 and t-1, where the override begins
    torch.testing.assert_close(jump, expected, atol=1e-6, rtol=0)
    difference = (moved.target.velocity - plain.target.velocity)[0, 0]
    torch.testing.assert_close(difference, torch.tensor([0.0, -0.01, 0.0]), atol=1e-6, rtol=0)


def test_mirror_commutes_with_features(loaded):
    """Wrong signs: the mirrored features are not the features of the mirrored garment. 1e-4: float32."""
    faces, vertices = loaded.faces, torch.from_numpy(np.array(loaded.source.vertices[5]))
    m = torch.tensor([-1.0, 1.0, 1.0])
    flipped = faces[:, [0, 2, 1]].contiguous()  # outward stays outward
    body = loaded.source.body()
    now, after = (torch.from_numpy(np.array(body.vertices[k])) for k in (5, 6))
    body_faces = torch.from_numpy(body.faces)

    def features(vertices, faces, rest, now, after, body_faces):
        centroids = vertices[faces.long()].mean(dim=1)
        found = body_interaction(centroids, None, BodyMeshes(now.contiguous(), body_faces), after.contiguous())
        inverse = _inverse(rest.numpy(), faces.numpy())
        none = torch.zeros(len(faces), dtype=torch.int32)
        return face_features(inverse, vertices, faces, none, centroids.mean(0, keepdim=True), found)[None]

    plain = features(vertices, faces, loaded.rest, now, after, body_faces)
    other = features(vertices * m, flipped, loaded.rest * m, now * m, after * m, body_faces[:, [0, 2, 1]].contiguous())
    still = torch.eye(3).expand(1, len(faces), 3, 3)
    nothing = NetworkOutput(still, torch.ones(1, len(faces), 3), torch.zeros(1, 1, 3))
    mirrored, _, _ = mirror(plain, torch.zeros(1, 1, 27), nothing, torch.tensor([True]))
    wrong = ((mirrored - other).abs() > 1e-4)[0]
    assert not wrong[:, :19].any()
    assert not wrong[:, 31:].any()
    assert wrong[:, 19:31].any(dim=1).float().mean() < 0.5  # closest points on edges: either body face may be named


def test_joint_yaw_turns_the_sample(loaded):
    """World and rest turned by different angles: turning a sample is not turning its vectors. 1e-4: float32."""
    from warpgarment.nn.heading import rotation_about_up

    plain = SampleBuilder([loaded], SMALL, QUIET, PLAIN).build([(0, 11)], 30, np.random.default_rng(7))
    builder = SampleBuilder([loaded], SMALL, QUIET, Augmentation(mirror=0.0, yaw=20.0))
    turned = builder.build([(0, 11)], 30, np.random.default_rng(7))
    angle = np.random.default_rng(7).spawn(1)[0].standard_normal() * np.radians(20.0)
    g = rotation_about_up(torch.tensor([angle], dtype=torch.float32))[0]
    a, b = (batch.features[0].unflatten(-1, (-1, FEATURES)) for batch in (plain, turned))
    for name in ("deformation_gradient", "body_deformation"):
        before = a[..., LAYOUT[name]].unflatten(-1, (3, 3))
        torch.testing.assert_close((g @ before @ g.T).flatten(-2), b[..., LAYOUT[name]], atol=1e-4, rtol=0)
    for name in ("normal", "centroid", "direction_to_body", "body_velocity"):
        torch.testing.assert_close(a[..., LAYOUT[name]] @ g.T, b[..., LAYOUT[name]], atol=1e-4, rtol=0)
    torch.testing.assert_close(g @ plain.target.psi @ g.T, turned.target.psi, atol=5e-4, rtol=0)


def test_noise_has_the_stated_size_and_spares_pins():
    """Amplitudes would be wrong, or pinned vertices displaced. 15 %: 400 draws of a few dozen fields."""
    vertices, faces = synthetic_sequences.tube(16, 12, 0.2, 0.0, 1.0)
    pins = np.arange(16)
    free = NoiseBasis(faces, np.zeros(len(vertices), int), np.zeros(0, int))
    held = NoiseBasis(faces, np.zeros(len(vertices), int), pins)
    config = NoiseConfig(position=0.004, offset=0.0, walk=0.0, spread=1.0, clean=0.0)
    rng = np.random.default_rng(0)
    drawn = np.stack([free.displacement(3, config, rng) for _ in range(400)])
    expected = 0.004 * np.sqrt(1 + 1 / 4 + 1 / 16 + 1 / 64)
    assert np.sqrt((drawn**2).mean()) == pytest.approx(expected, rel=0.15)
    np.testing.assert_array_equal(drawn[:, 0], drawn[:, 2])  # no walk: the same in all frames
    moved = held.displacement(3, NoiseConfig(clean=0.0), rng)
    assert np.abs(moved[:, pins]).max() == 0.0
    assert np.abs(moved[:, -16:]).max() > 1e-4


def test_loss_is_the_weighted_sum_of_absolute_differences():
    """Weights, units or the mask of components are lost. Against NumPy in float64, 1e-5: float32."""
    network = ManifoldAwareTransformer(SMALL)
    network.set_statistics({"psi_std": torch.full((9,), 0.1), "q_std": torch.full((3,), 0.01)})
    generator = torch.Generator().manual_seed(0)
    shapes = ((2, 5, 9), (2, 5, 3), (2, 2, 3))
    a, b = (type(network(*_nothing(network)))(*(torch.randn(s, generator=generator) for s in shapes)) for _ in range(2))
    mask = torch.tensor([[True, False], [True, True]])
    parts = [np.abs(x.double().numpy() - y.double().numpy()) for x, y in zip(a, b, strict=True)]
    velocity = parts[2].sum(-1)[mask.numpy()].mean()
    expected = parts[0].sum(-1).mean() + parts[1].sum(-1).mean() + 3 * velocity
    assert float(loss(a, b, network, LossConfig(), mask).total) == pytest.approx(expected, rel=1e-5)
    physical = 0.1 * parts[0].sum(-1).mean() + parts[1].sum(-1).mean() + 3 * 0.01 * velocity
    assert float(loss(a, b, network, LossConfig(units="physical"), mask).total) == pytest.approx(physical, rel=1e-5)


@pytest.mark.parametrize(
    "name", [n for n, f in inspect.getmembers(losses, inspect.isfunction) if f.__module__ == losses.__name__]
)
def test_types_of_losses_can_be_looked_up(name):
    """A type in a signature is not imported, so that reading the annotations is a NameError."""
    assert "return" in typing.get_type_hints(getattr(losses, name))


def _nothing(network):
    history = network.config.history
    return torch.zeros(1, 2, history * FEATURES), torch.zeros(1, 1, (history - 1) * 3), torch.eye(2)[None]


def test_a_scaled_sample_is_one_of_a_scaled_world(data, loaded, tmp_path):
    """Some length is not scaled, or something that has no unit is: features, velocities, geodesic weights and target of
    a scaled sample are those of a sequence whose garment and body were written larger.

    1e-3 (features), 2e-3 (weights): positions on disk have 16 bits, weights are kept in float16. A closest point on an
    edge may belong to another body face after rounding: such ties are left out.
    """
    builder = SampleBuilder([loaded], SMALL, QUIET, Augmentation(mirror=0.0, yaw=0.0, scale=0.1))
    batch = builder.build([(0, 11)], len(loaded.faces), np.random.default_rng(3))
    stream = np.random.default_rng(3).spawn(1)[0]
    stream.standard_normal(), stream.uniform(), stream.random()
    factor = 1.0 + 0.1 * stream.uniform(-1.0, 1.0)
    assert abs(factor - 1.0) > 0.02

    def enlarge(content):
        for name in ("garment_rest_vertices", "garment_vertices", "body_rest_vertices"):
            content[name] = (content[name] * factor).astype(np.float32)
        content["bone_transforms"][..., 3] *= factor

    folder = synthetic_sequences.write(tmp_path / "large", "train_0", spoil=enlarge, frames=16, pins=4, seed=0)
    large = SequenceData(Sequence.load(folder), folder, tmp_path / "cache", SMALL, torch.device("cpu"))
    other = SampleBuilder([large], SMALL, QUIET, PLAIN).build([(0, 11)], len(large.faces), np.random.default_rng(3))
    wrong = ((batch.features - other.features).abs().unflatten(-1, (-1, FEATURES)) > 1e-3).any(dim=(0, 2))
    tied = wrong[:, 19:31].any(dim=1)
    assert not wrong[:, :19].any()
    assert not wrong[:, 31:].any()
    assert tied.float().mean() < 0.5
    torch.testing.assert_close(batch.velocities, other.velocities, atol=1e-4, rtol=0)
    torch.testing.assert_close(batch.weights, other.weights, atol=2e-3, rtol=5e-3)
    torch.testing.assert_close(batch.target.psi[:, ~tied], other.target.psi[:, ~tied], atol=2e-3, rtol=0)
    torch.testing.assert_close(batch.target.singular_values, other.target.singular_values, atol=1e-3, rtol=0)
    with pytest.raises(ValueError, match="gravity"):
        Augmentation(scale=0.5)


def test_parts_of_a_batch_are_the_batch(loaded):
    """Processes that share a batch would train on other samples than one process alone. Bit for bit: the same work."""
    builder = SampleBuilder([loaded], SMALL, NoiseConfig(), Augmentation(scale=0.02))
    picks = [(0, 3), (0, 12), (0, 7), (0, 10)]
    whole = builder.build(picks, 30, np.random.default_rng(5))
    parts = [builder.build(picks, 30, np.random.default_rng(5), part=p) for p in (slice(0, 2), slice(2, 4))]
    assert [i for p in parts for i in p.ids] == whole.ids
    for name in ("features", "velocities", "weights"):
        assert torch.equal(torch.cat([getattr(p, name) for p in parts]), getattr(whole, name)), name
    for a, b, c in zip(*(p.target for p in parts), whole.target, strict=True):
        assert torch.equal(torch.cat([a, b]), c)


def test_losses_of_parts_average_to_the_loss_of_the_batch():
    """Where garments have different numbers of components, a mean over processes would weigh components wrongly.
    Against the whole batch, 1e-6: float32."""
    network = ManifoldAwareTransformer(SMALL)
    generator = torch.Generator().manual_seed(0)
    a, b = (
        NormalisedOutput(*(torch.randn(s, generator=generator) for s in ((4, 5, 9), (4, 5, 3), (4, 3, 3))))
        for _ in range(2)
    )
    mask = torch.arange(3)[None] < torch.tensor([1, 1, 3, 2])[:, None]
    whole = loss(a, b, network, LossConfig(), mask)
    halves = []
    for part, width in ((slice(0, 2), 1), (slice(2, 4), 3)):  # the first half needs no padding, hence no mask
        x, y = (NormalisedOutput(o[0][part], o[1][part], o[2][part][:, :width]) for o in (a, b))
        halves.append(loss(x, y, network, LossConfig(), None if width == 1 else mask[part], torch.tensor(7 / 2)))
    for k in range(4):
        torch.testing.assert_close((halves[0][k] + halves[1][k]) / 2, whole[k], atol=0, rtol=1e-6)


def test_large_garments_train_without_all_pairs(data, tmp_path, monkeypatch):
    """A large garment would fill memory and disk with F x F distances, or train with other weights than it moves with.

    Against P exp(-(D_c s/r)^p) P^T in float64, for a garment made s times as large; 1e-5: float32.
    """
    monkeypatch.setattr("warpgarment.objects.garment.POOLED", 10)
    folder = data / "train_0"
    sequence = SequenceData(Sequence.load(folder), folder, tmp_path, SMALL, torch.device("cpu"))
    assert not list(tmp_path.rglob("geodesics.npy"))
    found = SampleBuilder([sequence], SMALL, QUIET, PLAIN).build([(0, 3)], 30, np.random.default_rng(0)).weights
    assert found.shape == (1, 30, 30)
    subset = np.arange(0, len(sequence.faces), 3)
    pooled = sequence.source.garment.pooled_geodesics
    p = np.zeros((len(subset), len(pooled.distances)))
    np.add.at(p, (np.arange(len(subset))[:, None], pooled.nearest[subset]), pooled.weight[subset].astype(np.float64))
    expected = p @ np.exp(-((pooled.distances.astype(np.float64) * 1.1 / 0.2) ** 2)) @ p.T
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(sequence.shown.weights(subset, 1.1).numpy(), expected, atol=1e-5)
    assert "geodesics" not in vars(sequence.source.garment)
