"""`warpgarment generate` from end to end, on the bundled body."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest

from warpgarment.training.data.sequence import Sequence, list_sequences, read_manifest
from warpgarment.training.data.set_manifest import DatasetMismatch
from warpgarment.training.data.verify import verify
from warpgarment.training.generate.recipes import GenerateConfig
from warpgarment.training.generate.run import generate, make_sequences, numbers_to_make


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return GenerateConfig(
        out=tmp_path_factory.mktemp("set") / "data", sequences=2, frames=3, faces=500, categories=("tshirt", "skirt"),
        bodies="bundled", procedural_share=1.0, least_frames=1, attempts=1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def made(config):
    generate(config)
    return config.out


def test_sequences_are_whole_and_simulated(made, config):
    """If this fails, the generator writes something that cannot be trained on."""
    folders = list_sequences(made)
    assert len(folders) == 2
    for folder in folders:
        sequence = Sequence.load(folder)
        assert sequence.vertices.shape == (33, len(sequence.garment.vertices), 3)
        moved = np.linalg.norm(np.diff(sequence.vertices, axis=0), axis=-1)
        assert 1e-5 < moved.max() < 0.1
        assert sequence.manifest["figures"]["penetration"] < 0.01
        assert abs(len(sequence.garment.faces) - 500) < 150


def test_what_is_made_passes_its_own_check(made):
    """If this fails, `dataset verify` and the generator disagree on what a set is."""
    report = verify(made)
    assert report.problems == [], report
    assert report.sequences == 2


def test_a_run_goes_on_where_it_stopped(made, config):
    """If this fails, what is made is made again, or what is missing is not."""
    before = {p: p.stat().st_mtime_ns for p in made.glob("*/manifest.json")}
    assert numbers_to_make(config) == []
    assert numbers_to_make(replace(config, sequences=5)) == [2, 3, 4]
    assert numbers_to_make(replace(config, sequences=5, shard="1/2")) == [3]
    generate(config)
    assert {p: p.stat().st_mtime_ns for p in made.glob("*/manifest.json")} == before


def test_a_sequence_is_a_function_of_its_number(made, config, tmp_path):
    """If this fails, two machines make different sets from the same seed."""
    again = replace(config, out=tmp_path)
    make_sequences(again, [1])
    first = read_manifest(next(made.glob("00001_*")))
    second = read_manifest(next(tmp_path.glob("00001_*")))
    assert first["checksums"] == second["checksums"]
    assert first["parameters"] == second["parameters"]


def test_other_options_in_the_same_folder_are_refused(made, config):
    """If this fails, two different sets are mixed in one folder."""
    with pytest.raises(DatasetMismatch, match="faces"):
        generate(replace(config, faces=700))


def test_a_rejected_sequence_keeps_its_reason_and_can_be_made_again(config, tmp_path, monkeypatch):
    """If this fails, nobody can find out why a sequence was rejected."""
    from warpgarment.training.generate import quality

    monkeypatch.setattr(quality.Limits, "__init__", _strict(quality.Limits.__init__))
    strict = replace(config, out=tmp_path, attempts=2)
    (manifest,) = make_sequences(strict, [0])
    assert manifest["status"] == "rejected"
    assert "frame 0: stretch_p99" in manifest["reason"]
    assert [m["attempt"] for m in manifest["rejected_attempts"]] == [0]
    assert list_sequences(tmp_path) == []
    kept = replace(strict, out=tmp_path / "again", attempt=1, keep_rejected=True)
    (same,) = make_sequences(kept, [0])
    assert same["reason"] == manifest["reason"]
    json.dumps(manifest)


def _strict(original):
    def init(self, *args, **kwargs):
        original(self, *args, **(kwargs | {"stretch": 1e-9}))

    return init


def test_ray_makes_the_same(made, config, tmp_path):
    """If this fails, a cluster gives other data than one machine."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    other = replace(config, out=tmp_path / "ray", sequences=1, ray="local")
    generate(other)
    first, second = (read_manifest(next(p.glob("00000_*"))) for p in (made, other.out))
    assert first["checksums"] == second["checksums"]


def test_velocities_are_an_addition(made, config, tmp_path):
    """With velocities, sequences are others, cannot be told from those without, or are mixed with them in one set."""
    with_them = replace(config, out=tmp_path, velocities=True, first=1, sequences=1)
    generate(with_them)
    one, other = (Sequence.load(next(root.glob("00001_*"))) for root in (made, tmp_path))
    np.testing.assert_array_equal(one.vertices, other.vertices)
    assert one.velocities is None
    assert other.manifest["velocities"] is True
    assert "velocities" not in one.manifest
    mean = np.diff(other.vertices, axis=0) * 30.0  # over a frame, of ten substeps: not that at its end
    assert np.abs(other.velocities[1:] - mean).mean() < 0.3 * np.abs(mean).mean()
    assert "--velocities" in with_them.command()
    assert verify(tmp_path).problems == []
    with pytest.raises(DatasetMismatch, match="velocities was null, is true"):
        generate(replace(with_them, out=made))
