"""Sequences on disk, the plan of a data set, and the quality gate."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from data_bodies import rest_body

from warpgarment import demo
from warpgarment.errors import MeshError
from warpgarment.garment import Garment
from warpgarment.training import dataset
from warpgarment.training.generate import GenerateConfig, plan_sequence, split_of_clips
from warpgarment.training.quality import Limits, QualityGate


def _write(folder: Path) -> dict[str, np.ndarray]:
    with np.load(demo.ASSETS / "tshirt.npz") as shirt, np.load(demo.ASSETS / "body.npz") as body:
        arrays = {
            "garment_rest_vertices": shirt["rest_vertices"],
            "garment_faces": shirt["faces"],
            "pins": shirt["pins"],
            "garment_vertices": shirt["truth"][:5],
            "body_rest_vertices": body["rest_vertices"],
            "body_faces": body["faces"],
            "collider_faces": body["collider_faces"],
            "bone_indices": body["bone_indices"],
            "bone_weights": body["bone_weights"],
            "bone_transforms": body["bone_transforms"][:5],
        }
    dataset.write_sequence(folder, arrays, {"status": "good", "split": "train", "fps": 30.0, "garment": "shirt"})
    return arrays


def test_a_sequence_comes_back_as_it_was_written(tmp_path):
    """If this fails, training sees other positions than were simulated."""
    arrays = _write(tmp_path / "00000_tshirt")
    sequence = dataset.Sequence.load(tmp_path / "00000_tshirt")
    np.testing.assert_array_equal(sequence.vertices, arrays["garment_vertices"])
    np.testing.assert_array_equal(sequence.garment.faces, arrays["garment_faces"])
    assert sequence.full_body().vertices.shape == (5, len(arrays["body_rest_vertices"]), 3)
    assert len(sequence.body().faces) == arrays["collider_faces"].sum()
    assert dataset.list_sequences(tmp_path, split="train") == [tmp_path / "00000_tshirt"]
    assert dataset.list_sequences(tmp_path, split="test") == []
    assert not list(tmp_path.glob(".*")), "the unfinished folder was left behind"


def test_damaged_sequences_are_named(tmp_path):
    """If this fails, a truncated array or manifest is read as data."""
    _write(tmp_path / "a")
    broken = tmp_path / "a" / "garment_vertices.npy"
    broken.write_bytes(broken.read_bytes()[:2000])
    with pytest.raises(MeshError, match=r"a: garment_vertices.npy cannot be read"):
        dataset.Sequence.load(tmp_path / "a")
    shutil.rmtree(tmp_path / "a")
    _write(tmp_path / "a")
    np.save(tmp_path / "a" / "bone_transforms.npy", np.zeros((4, 31, 3, 4), np.float32))
    with pytest.raises(MeshError, match="5 frames of garment, 4 of body"):
        dataset.Sequence.load(tmp_path / "a")
    (tmp_path / "a" / "manifest.json").write_text("{")
    with pytest.raises(MeshError, match="no readable manifest"):
        dataset.Sequence.load(tmp_path / "a")
    with pytest.raises(FileNotFoundError, match="warpgarment generate"):
        dataset.list_sequences(tmp_path / "nowhere")


def test_plans_are_functions_of_seed_and_number(tmp_path):
    """If this fails, a rejected sequence cannot be made again, or test motions are trained on."""
    for name in [f"clip_{k:02d}" for k in range(24)] + ["cmu_salsa_03", "cmu_salsa_18"]:
        (tmp_path / f"{name}.bvh").write_text("MOTION\nFrames: 400\nFrame Time: 0.0333333\n")
    config = GenerateConfig(out=tmp_path, motions=tmp_path)
    plans = [plan_sequence(config, n) for n in range(90)]
    assert plans == [plan_sequence(config, n) for n in range(90)]
    used = {split: {p.motion for p in plans if p.split == split} for split in ("train", "validation", "test")}
    assert not used["train"] & used["test"]
    assert not used["train"] & used["validation"]
    assert not used["validation"] & used["test"]
    assert all(used.values())
    splits = split_of_clips([f"cmu_salsa_{k:02d}" for k in range(1, 31)])
    assert all(splits[f"cmu_salsa_{k:02d}"] == splits[f"cmu_salsa_{k + 15:02d}"] for k in range(1, 16))
    train = [p.category for p in plans if p.split == "train"]
    assert {c: train.count(c) for c in config.categories} == {c: 14 for c in config.categories}
    with pytest.raises(ValueError, match=r"unknown garment categories \['cape'\]"):
        plan_sequence(GenerateConfig(out=tmp_path, categories=("cape",)), 0)


def _gate() -> tuple[QualityGate, np.ndarray, np.ndarray]:
    body = rest_body()
    with np.load(demo.ASSETS / "tshirt.npz") as shirt:
        garment = Garment(shirt["rest_vertices"], shirt["faces"])
    return QualityGate(garment, body.faces, Limits()), garment.vertices.copy(), body.vertices


@pytest.mark.parametrize(
    ("frame", "damage", "message"),  # penetration is measured in every third frame
    [
        (1, lambda v: v * [[1.4, 1.4, 1.4]], "stretch_p99 40.0% is over 30%"),
        (2, lambda v: np.where(np.arange(len(v))[:, None] == 5, np.nan, v), "1 vertices are not finite"),
        (3, lambda v: v + [[0.0, 0.0, -0.06]], "penetration .* mm is over 10 mm"),
    ],
)
def test_the_gate_rejects_bad_frames_and_says_why(frame, damage, message):
    """If this fails, stretched, exploded or penetrating cloth becomes ground truth."""
    gate, vertices, body = _gate()
    assert gate.check(0, vertices, body) is None
    reason = gate.check(frame, damage(vertices), body)
    assert reason is not None
    assert re.search(message, reason), reason


def test_figures_of_a_good_sequence_are_plain_numbers():
    """If this fails, manifests cannot be written as JSON or their figures are of other frames."""
    gate, vertices, body = _gate()
    for frame in range(4):
        assert gate.check(frame, vertices, body) is None
    figures = gate.figures(4)
    json.dumps(figures)
    assert figures["stretch_max"] == pytest.approx(0.0, abs=1e-6)
    assert figures["step_max"] == 0.0
