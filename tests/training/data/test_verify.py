"""`warpgarment dataset verify`: a sound set passes, and everything that can be wrong with one is found and named."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support import sequences as synthetic_sequences

from warpgarment import cli
from warpgarment.training.data.sequence import write_sequence
from warpgarment.training.data.set_manifest import write_set_manifest
from warpgarment.training.data.verify import verify

CONFIGURATION = {"recipe": "cloth3d", "seed": 0, "held_out": ["skirt"]}


def _add(root: Path, number: int, split: str = "train", **entries) -> Path:
    manifest = {"number": number, "seed": 0, "motion": f"clip_{number}", "category": "dress"} | entries
    settings = {"frames": 6, "seed": number, "around": 8, "rings": 4}
    return synthetic_sequences.write(root, f"{number:05d}_dress", split, manifest=manifest, **settings)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """Two sequences to train on, one to test on, one rejected."""
    root = tmp_path_factory.mktemp("sound") / "set"
    _add(root, 0, motion="cmu_salsa_03")
    _add(root, 1, motion="procedural:walk", rejected_attempts=[{"reason": "frame 3: penetration"}] * 2)
    _add(root, 3, "test", motion="procedural:walk", category="skirt")
    rejected = {"status": "rejected", "split": "train", "garment": "tube", "motion": "clip_2", "fps": 30.0, "frames": 4}
    write_sequence(
        root / "00002_dress", {}, rejected | {"number": 2, "reason": "frame 4: stretch_p99 40.0% is over 30%"}
    )
    write_set_manifest(root, CONFIGURATION, {}, numbers=range(4))
    return root


@pytest.fixture
def root(sound, tmp_path) -> Path:
    """A copy to be damaged."""
    return shutil.copytree(sound, tmp_path / "set")


def test_a_sound_set_passes_and_is_counted(sound, tmp_path, capsys):
    """If this fails, a set that is as it should be cannot be published, or is another one than the report says."""
    report = verify(sound)
    assert report.problems == []
    assert (report.sequences, report.rejected, report.rejected_attempts, report.frames) == (3, 1, 2, 18)
    assert report.size == sum(path.stat().st_size for path in sound.glob("*/*"))
    assert report.splits["train"] == {"sequences": 2, "frames": 12, "categories": {"dress": 2}}
    assert report.splits["test"] == {"sequences": 1, "frames": 6, "categories": {"skirt": 1}}
    assert _command("verify", sound, "--json", tmp_path / "report.json") == 0
    assert "3 sequences, 18 frames" in capsys.readouterr().out
    assert json.loads((tmp_path / "report.json").read_text())["frames"] == 18


def _command(*arguments) -> int:
    cli.VERBS.setdefault("dataset", cli.Verb("cli.dataset", "Dataset", "run", "Check a data set."))
    return cli.main(["dataset", *map(str, arguments)])


def _flip_a_bit(folder: Path) -> None:
    path = folder / "garment_positions.npy"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


def _sealed(folder: Path, **entries) -> None:
    """Changes the manifest; checksums are made to fit the files."""
    manifest = json.loads((folder / "manifest.json").read_text()) | entries
    manifest["checksums"] = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.glob("*.npy"))}
    (folder / "manifest.json").write_text(json.dumps(manifest))


def _save(folder: Path, name: str, array: np.ndarray) -> None:
    """Changes an array; its checksum is made to fit."""
    np.save(folder / f"{name}.npy", array)
    _sealed(folder)


def _without(folder: Path, key: str) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest[key]
    (folder / "manifest.json").write_text(json.dumps(manifest))


def _nan(folder: Path) -> None:
    boxes = np.load(folder / "garment_boxes.npy")
    boxes[4] = np.nan
    _save(folder, "garment_boxes", boxes)


def _double_face(folder: Path) -> None:
    faces = np.load(folder / "garment_faces.npy")
    faces[7] = faces[6]
    _save(folder, "garment_faces", faces)


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (_flip_a_bit, "garment_positions.npy does not have its checksum"),
        (lambda f: (f / "pins.npy").unlink(), "pins.npy is missing"),
        (lambda f: (f / "notes.txt").write_text("?"), "notes.txt is not in manifest.json"),
        (lambda f: _save(f, "garment_boxes", np.zeros((5, 2, 3), np.float32)), "garment_boxes.npy has shape [5, 2, 3]"),
        (lambda f: _save(f, "pins", np.array([900], np.uint16)), "1 of 1 entries of pins.npy exceed 0..31"),
        (_nan, "garment_vertices holds 96 values that are not finite (first: frame 4)"),
        (_double_face, "rest mesh: "),
        (lambda f: (f / "manifest.json").unlink(), "holds no readable manifest.json"),
        (lambda f: (f / "manifest.json").write_text("{"), "holds no readable manifest.json"),
        (lambda f: _without(f, "fps"), "manifest.json does not say fps"),
        (lambda f: _sealed(f, split="training"), "manifest.json says 'training' for split"),
        (lambda f: _sealed(f, status="rejected", reason=""), "manifest.json says '' for reason"),
        (lambda f: _sealed(f, frames=7), "6 frames, manifest.json says 7"),
        (lambda f: _sealed(f, figures={"stretch": float("nan")}), "1 figures that are not finite (first: stretch)"),
        (lambda f: _sealed(f, format=9), "format 9 is not known"),
        (lambda f: _sealed(f, seed=8), "made with seed 8, the set with 0"),
        (lambda f: _sealed(f, number=0), "another sequence has the number 0 too"),
        (lambda f: _sealed(f, category="skirt"), "trains on skirt, held out for tests"),
        (
            lambda f: _sealed(f, garments=[{"name": "a", "category": "skirt"}]),
            "trains on skirt, held out for tests",
        ),
    ],
)
def test_a_damaged_sequence_is_named(root, damage, problem):
    """If this fails, a sequence that cannot be trusted is trained on."""
    damage(root / "00001_dress")
    problems = verify(root).problems
    assert [p.what for p in problems if p.where == "00001_dress" and problem in p.what], problems
    assert {p.where for p in problems} <= {"00001_dress", "00000_dress", "set.json"}


def test_what_is_tested_is_not_trained_on(root):
    """If this fails, figures of the test are those of what was learned by heart. The partners of a salsa, 03 and 18,
    are one performance; procedural motions are never the same twice."""
    _sealed(root / "00003_dress", motion="cmu_salsa_18")
    (problem,) = verify(root).problems
    assert problem.where == "00003_dress"
    assert "tests on cmu_salsa_18, of a performance trained on in 00000_dress" in problem.what
    shutil.rmtree(root / "00003_dress")
    content = synthetic_sequences.arrays(frames=4, seed=1, around=8, rings=4)  # the garment of number 1
    entries = {
        "status": "good",
        "split": "test",
        "garment": "other",
        "motion": "x",
        "fps": 30,
        "frames": 4,
        "number": 3,
    }
    write_sequence(root / "00003_dress", content, entries)
    (problem,) = verify(root).problems
    assert (problem.where, problem.what) == ("00003_dress", "tests on a garment trained on in 00001_dress")


def test_what_is_missing_or_left_over_is_named(root, tmp_path):
    """If this fails, a set is published that is not complete, or holds the remains of killed workers."""
    shutil.rmtree(root / "00002_dress")
    (root / ".00009_dress.1234.partial").mkdir()
    (root / "empty").mkdir()
    (root / "card").mkdir()
    found = {p.where: p.what for p in verify(root).problems}
    assert set(found) == {"set.json", ".00009_dress.1234.partial", "empty"}
    assert "1 of 4 planned sequences are missing (first: number 2)" in found["set.json"]
    assert "unfinished" in found[".00009_dress.1234.partial"]
    (root / "set.json").write_text("{")
    assert "no readable set.json" in {p.where: p.what for p in verify(root).problems}["set.json"]
    (tmp_path / "nothing").mkdir()
    assert "holds no sequence" in verify(tmp_path / "nothing").problems[0].what
    with pytest.raises(FileNotFoundError, match="no data set at"):
        verify(tmp_path / "nowhere")


def test_the_command_fails_with_one_line(root, capsys):
    """If this fails, a script goes on with a damaged set."""
    _flip_a_bit(root / "00000_dress")
    (root / "00001_dress" / "pins.npy").unlink()
    assert _command("verify", root) == 2
    printed = capsys.readouterr()
    (line,) = [line for line in printed.err.splitlines() if line.startswith("warpgarment:")]
    assert "VerificationFailed" in line
    assert "2 problems, first 00000_dress: garment_positions.npy does not have its checksum" in line
    assert "00001_dress: pins.npy is missing" in printed.out
