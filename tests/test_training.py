"""Training: samples are what a rollout would see, noise and symmetry are undone by their targets, runs resume
exactly."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import synthetic_sequences
import torch

from warpgarment import checkpoint
from warpgarment.kernels.deformation import deformation_gradient
from warpgarment.kernels.features import FEATURES, LAYOUT, body_interaction, face_features
from warpgarment.kernels.sdf import BodyMeshes
from warpgarment.network import ManifoldAwareTransformer, NetworkConfig, geodesic_weights, rotate_output
from warpgarment.parametrisation import NetworkOutput, Step, context, targets
from warpgarment.training import interactions, train
from warpgarment.training.dataset import Sequence
from warpgarment.training.losses import LossConfig, loss
from warpgarment.training.noise import NoiseBasis, NoiseConfig
from warpgarment.training.pushforward import Pool, PushforwardConfig
from warpgarment.training.samples import Augmentation, SampleBuilder, SequenceData, mirror

SMALL = NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2, dropout=0.1, geodesic_radius=0.2)
SHAPE = ("embedding=16", "layers=1", "feed_forward=16", "heads=2", "geodesic_radius=0.2")
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
    network = ManifoldAwareTransformer(SMALL)
    turned, turned_velocities, frame = network.canonicalise(features, velocities)
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
    from warpgarment.heading import rotation_about_up

    plain = SampleBuilder([loaded], SMALL, QUIET, PLAIN).build([(0, 11)], 30, np.random.default_rng(7))
    builder = SampleBuilder([loaded], SMALL, QUIET, Augmentation(mirror=0.0, yaw=20.0))
    turned = builder.build([(0, 11)], 30, np.random.default_rng(7))
    angle = np.random.default_rng(7).standard_normal(1) * np.radians(20.0)
    g = rotation_about_up(torch.tensor(angle, dtype=torch.float32))[0]
    a, b = (batch.features[0].unflatten(-1, (-1, FEATURES)) for batch in (plain, turned))
    for name in ("deformation_gradient", "body_deformation"):
        before = a[..., LAYOUT[name]].unflatten(-1, (3, 3))
        torch.testing.assert_close((g @ before @ g.T).flatten(-2), b[..., LAYOUT[name]], atol=1e-4, rtol=0)
    for name in ("normal", "centroid", "direction_to_body", "body_velocity"):
        torch.testing.assert_close(a[..., LAYOUT[name]] @ g.T, b[..., LAYOUT[name]], atol=1e-4, rtol=0)
    torch.testing.assert_close(g @ plain.target.psi @ g.T, turned.target.psi, atol=5e-4, rtol=0)


def test_noise_has_the_stated_size_and_spares_pins():
    """Amplitudes off, or pinned vertices displaced. 15 %: 400 draws of a few dozen fields."""
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


def _nothing(network):
    history = network.config.history
    return torch.zeros(1, 2, history * FEATURES), torch.zeros(1, 1, (history - 1) * 3), torch.eye(2)[None]


def test_cache_is_keyed_by_content(tmp_path):
    """A changed sequence would be trained with the interactions of the old one."""
    folder = synthetic_sequences.write(tmp_path / "s", "one", frames=12)
    interactions.cached(Sequence.load(folder), folder, tmp_path / "cache")
    key = interactions.key_of(folder)
    assert [p.name for p in (tmp_path / "cache").iterdir()] == [f"one-{key}"]
    for name in ("garment_positions", "garment_boxes", "bone_rotations"):
        changed = np.load(folder / f"{name}.npy")
        changed.flat[0] += 1
        np.save(folder / f"{name}.npy", changed)
        assert interactions.key_of(folder) != key, name
        key = interactions.key_of(folder)


def config_for(data: Path, out: Path, **changes) -> train.TrainConfig:
    settings = {
        "steps": 12, "batch_size": 4, "overrides": (*SHAPE, "dropout=0.1"), "validate_every": 8, "validate_frames": 3,
        "save_every": 4, "log_every": 1, "statistics_batches": 2, "device": "cpu", "threads": 1,
        "pushforward": PushforwardConfig(every=5, rollouts=2, steps=2, share=0.5), "noise": NoiseConfig(features=0.01),
    }  # fmt: skip
    return train.TrainConfig(data=data, out=out, **(settings | changes))


def losses_of(out: Path) -> dict[int, float]:
    entries = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return {entry["step"]: entry["loss"] for entry in entries if "loss" in entry}


def test_resumed_run_repeats_the_uninterrupted_one(data, tmp_path, monkeypatch):
    """A run that is stopped and resumed takes other samples, noise, dropout or moments. Bit for bit on the CPU."""
    train.train(config_for(data, tmp_path / "whole"))
    whole = losses_of(tmp_path / "whole")
    assert sorted(whole) == list(range(1, 13))
    with monkeypatch.context() as patch:
        over = train.Run.over
        patch.setattr(train.Run, "over", lambda run: over(run) or run.step >= 6)
        train.train(config_for(data, tmp_path / "parts"))
    assert sorted(losses_of(tmp_path / "parts")) == list(range(1, 7))
    path = train.train(config_for(data, tmp_path / "parts", resume=True))
    assert losses_of(tmp_path / "parts") == whole
    network = checkpoint.load(path)
    assert network.config.embedding == 16
    finals = [checkpoint.load(tmp_path / run / "network.safetensors").state_dict() for run in ("whole", "parts")]
    for name, value in finals[0].items():
        assert torch.equal(value, finals[1][name]), name


def test_unusable_sequences_are_skipped_and_counted(data, tmp_path):
    """One broken sequence among good ones would end the run, or be trained on."""
    root = tmp_path / "set"
    synthetic_sequences.write(root, "good", frames=14)
    synthetic_sequences.write(root, "short", frames=8)

    def spoil(content):
        content["garment_vertices"][3, 2] = np.nan

    synthetic_sequences.write(root, "nan", frames=14, spoil=spoil)
    corrupt = synthetic_sequences.write(root, "corrupt", frames=14)
    (corrupt / "garment_positions.npy").write_bytes(b"not an array")
    skipped: dict[str, str] = {}
    config = config_for(root, tmp_path / "out")
    sequences = train.load_sequences(config, SMALL, torch.device("cpu"), skipped)
    assert [s.name for s in sequences] == ["good"]
    assert sorted(skipped) == ["corrupt", "nan", "short"]
    assert "frame 3" in skipped["nan"]
    assert "8 frames" in skipped["short"]
    (root / "good" / "pins.npy").unlink()
    with pytest.raises(train.NoTrainingData, match="none usable"):
        train.load_sequences(config, SMALL, torch.device("cpu"), {})


def test_a_loss_that_is_not_finite_stops_the_run(data, tmp_path, monkeypatch):
    """A diverged run would go on, and nobody could see on what. The batch is kept."""
    build = SampleBuilder.build

    def poisoned(self, picks, faces, rng, displacements=None):
        batch = build(self, picks, faces, rng, displacements)
        batch.target.psi[0, 0, 0, 0] = torch.nan
        return batch

    config = config_for(data, tmp_path / "out", pushforward=PushforwardConfig(share=0.0))
    run_start = train.Run.start

    def start(run, path):
        run_start(run, path)
        monkeypatch.setattr(SampleBuilder, "build", poisoned)

    monkeypatch.setattr(train.Run, "start", start)
    with pytest.raises(train.NonFiniteLoss, match="not_finite_0"):
        train.train(config)
    saved = np.load(tmp_path / "out" / "not_finite_0.npz")
    assert len(saved["sequence"]) == 4
    assert np.isnan(saved["psi"][0, 0, 0, 0])


def test_pool_returns_what_it_saved():
    """A resumed run would start from other displacements."""
    pool = Pool()
    pool.rollouts = [(2, 5, np.arange(36, dtype=np.float32).reshape(3, 4, 3))]
    other = Pool()
    other.restore(pool.tensors())
    sequence, newest, displacement = other.entry(*other.fitting(np.array([9, 9, 50]), 20)[1])
    assert (sequence, newest) == (2, 6)
    np.testing.assert_array_equal(displacement, pool.rollouts[0][2][:2])


def test_settings_are_checked(tmp_path):
    """A misspelt network setting would be ignored."""
    with pytest.raises(ValueError, match="geodesic_radius"):
        config_for(tmp_path, tmp_path, overrides=("radius=1",)).network_config()
    with pytest.raises(ValueError, match="time_limit"):
        train.TrainConfig(data=tmp_path, out=tmp_path)
