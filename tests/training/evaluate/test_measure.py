"""Evaluation: figures belong to the frames they claim, baselines move as described, results are written whole."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from support import sequences as synthetic_sequences

from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.evaluate import measure as evaluate
from warpgarment.training.evaluate.measure import EvaluateConfig, NoTestData
from warpgarment.training.rollouts import kabsch, rigid, skinned
from warpgarment.training.tables.options import OptionMissing


def moving_body(frames: int, move) -> tuple[BodyMotion, Garment]:
    content = synthetic_sequences.arrays(frames=2)
    rest, faces = trimesh.remesh.subdivide_to_size(content["body_rest_vertices"], content["body_faces"], max_edge=0.06)
    rest, corners = np.unique(rest.round(6), axis=0, return_inverse=True)  # join what subdividing left apart
    vertices = np.stack([move(rest.astype(np.float64), t) for t in range(frames)])
    garment = Garment(content["garment_rest_vertices"], content["garment_faces"])
    return BodyMotion(vertices.astype(np.float32), corners.reshape(-1)[faces].astype(np.int32), 30.0), garment


def rotate(points: np.ndarray, t: int) -> np.ndarray:
    turned = Rotation.from_euler("xyz", [0.1 * t, 0.3 * t, -0.2 * t]).apply(points)
    return turned + np.array([0.1 * t, 0.02 * t, 0.0])


@pytest.mark.parametrize("method", [skinned, rigid])
def test_baselines_follow_a_rigid_body(method):
    """Frames or weights are wrong: on a body that only turns and travels, both baselines are exact (1e-5 m:
    float32)."""
    body, garment = moving_body(4, rotate)
    moved = method(garment, garment.vertices, body)
    for t in range(4):
        np.testing.assert_allclose(moved[t], rotate(garment.vertices.astype(np.float64), t), atol=1e-5)


def test_skinned_follows_a_bending_body_more_closely_than_rigid():
    """The skinned baseline does not follow the skin beneath: on a shearing body the offset from the skin must stay."""

    def shear(points, t):
        return points + np.outer(points[:, 1] - 0.3, [0.1 * t, 0.0, 0.0])

    body, garment = moving_body(4, shear)
    wanted = shear(garment.vertices.astype(np.float64), 3)
    errors = [np.linalg.norm(m(garment, garment.vertices, body)[3] - wanted, axis=1).mean() for m in (skinned, rigid)]
    assert errors[0] < 0.4 * errors[1]


def test_kabsch_agrees_with_scipy():
    """The fit is a reflection or the inverse. Against scipy's Rotation.align_vectors in float64."""
    rng = np.random.default_rng(0)
    source = rng.standard_normal((20, 3))
    target = rng.standard_normal((20, 3)) + 2.0
    rotation, translation = kabsch(source, target)
    expected, _ = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))
    np.testing.assert_allclose(rotation, expected.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(rotation @ source.mean(0) + translation, target.mean(0), atol=1e-12)


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    root = tmp_path_factory.mktemp("evaluation")
    synthetic_sequences.write(root / "data", "one", "test", frames=16, seed=1, pins=3)
    synthetic_sequences.write(root / "data", "two", "test", frames=14, seed=2)
    synthetic_sequences.write(root / "data", "brief", "test", frames=9)
    torch.manual_seed(0)
    network = ManifoldAwareTransformer(NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2))
    checkpoint.save(network, root / "network.safetensors")
    weights = str(root / "network.safetensors")
    config = EvaluateConfig(data=root / "data", out=root / "out", network=weights, device="cpu")
    return config, evaluate.evaluate(config)


def test_result_counts_predicted_frames_only(evaluated):
    """Given frames, whose error is zero, would flatter the figures."""
    config, result = evaluated
    frames = {(row["sequence"], row["start"]): row["frames"] for row in result["sequences"]}
    assert frames == {("one", "warm"): 6, ("one", "cold"): 15, ("two", "warm"): 4, ("two", "cold"): 13}
    assert list(result["skipped"]) == ["brief"]
    sequence = Sequence.load(config.data / "two")
    body = sequence.body()
    part = BodyMotion(body.vertices[9:14], body.faces, 30.0)
    moved = rigid(sequence.garment, sequence.vertices[9], part)[1:].astype(np.float64)
    expected = 100 * np.linalg.norm(moved - sequence.vertices[10:14], axis=-1).mean()
    row = next(r for r in result["sequences"] if (r["sequence"], r["start"]) == ("two", "warm"))
    assert row["rigid"]["mean_vertex_error_cm"] == pytest.approx(expected, rel=1e-6)
    mean = np.mean([r["rigid"]["mean_vertex_error_cm"] for r in result["sequences"] if r["start"] == "warm"])
    assert result["mean"]["warm"]["rigid"]["mean_vertex_error_cm"] == pytest.approx(mean, rel=1e-9)


def test_untrained_residual_network_moves_like_skin(evaluated):
    """Rollouts are misaligned by a frame, or start elsewhere: skin would not stay within a centimetre of the
    recording."""
    _, result = evaluated
    for start in ("warm", "cold"):
        figures = result["mean"][start]["network"]
        assert figures["failed"] == 0
        assert figures["mean_vertex_error_cm"] < 2.0


def test_files_are_written(evaluated):
    """A result is missing, or partial files are left behind."""
    config, result = evaluated
    assert sorted(p.name for p in config.out.iterdir()) == ["error_over_time.png", "evaluation.json", "evaluation.md"]
    saved = json.loads((config.out / "evaluation.json").read_text())
    assert saved["mean"]["cold"]["network"]["sequences"] == 2
    text = (config.out / "evaluation.md").read_text()
    assert "| warm | skinned |" in text
    assert f"{result['mean']['warm']['rigid']['mean_vertex_error_cm']:.2f}" in text
    assert (config.out / "error_over_time.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_two_evaluations_into_one_folder(evaluated, tmp_path, monkeypatch):
    """The second evaluation into a folder takes the half-written file of the first, which then fails."""
    _, result = evaluated
    curves = {("network", start): [np.ones(3)] for start in ("warm", "cold")}
    drawn, draw = [], evaluate.draw

    def twice(path, curves):
        draw(path, curves)
        drawn.append(path)
        if len(drawn) == 1:
            evaluate.write(tmp_path / "out", result, curves, picture=True)

    monkeypatch.setattr(evaluate, "draw", twice)
    evaluate.write(tmp_path / "out", result, curves, picture=True)
    assert len(drawn) == 2
    names = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert names == ["error_over_time.png", "evaluation.json", "evaluation.md"]


def test_nothing_to_evaluate_is_said(evaluated, tmp_path):
    """An empty folder would give a table of nothing."""
    config, _ = evaluated
    synthetic_sequences.write(tmp_path / "data", "brief", "test", frames=5)
    with pytest.raises(NoTestData, match="5 frames"):
        evaluate.evaluate(EvaluateConfig(data=tmp_path / "data", out=tmp_path / "out", network=config.network))


def test_missing_folders_are_named(tmp_path):
    """Options that only tables can do without would end in a traceback."""
    for config, option in (
        (EvaluateConfig(out=tmp_path, picture=False), "--data"),
        (EvaluateConfig(data=tmp_path, picture=False), "--out"),
    ):
        with pytest.raises(OptionMissing, match=option):
            evaluate.evaluate(config)
