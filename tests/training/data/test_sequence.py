"""Sequences on disk, and the quality gate."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from support import sequences as synthetic_sequences
from support.bodies import rest_body

from warpgarment import demo
from warpgarment.errors import MeshError
from warpgarment.geometry.skinning import linear_blend_skinning
from warpgarment.objects.garment import Garment
from warpgarment.training.data import sequence as dataset
from warpgarment.training.generate.quality import Limits, QualityGate


def _shirt(frames: int = 5) -> dict[str, np.ndarray]:
    """The bundled T-shirt on the bundled body."""
    with np.load(demo.ASSETS / "tshirt.npz") as shirt, np.load(demo.ASSETS / "body.npz") as body:
        return {
            "garment_rest_vertices": shirt["rest_vertices"],
            "garment_faces": shirt["faces"],
            "pins": shirt["pins"],
            "garment_vertices": shirt["truth"][:frames],
            "body_rest_vertices": body["rest_vertices"],
            "body_faces": body["faces"],
            "collider_faces": body["collider_faces"],
            "bone_indices": body["bone_indices"],
            "bone_weights": body["bone_weights"],
            "bone_transforms": body["bone_transforms"][:frames],
        }


MANIFEST = {"status": "good", "split": "train", "fps": 30.0, "garment": "shirt", "category": "tshirt"}


def _write(folder: Path, frames: int = 5) -> dict[str, np.ndarray]:
    arrays = _shirt(frames)
    dataset.write_sequence(folder, arrays, MANIFEST)
    return arrays


def _outfit() -> dict[str, np.ndarray]:
    """A tube of cloth over another one, in the wind."""
    inner, outer = synthetic_sequences.arrays(frames=4), synthetic_sequences.arrays(frames=4, around=10, rings=5)
    shift = len(inner["garment_rest_vertices"])
    both = dict(inner)
    for name, axis in (("garment_rest_vertices", 0), ("garment_vertices", 1)):
        both[name] = np.concatenate([inner[name], outer[name] * np.float32(1.2)], axis=axis)
    both["garment_faces"] = np.concatenate([inner["garment_faces"], outer["garment_faces"] + shift])
    both["garment_starts"] = np.array([0, shift, len(both["garment_rest_vertices"])])
    both["wind"] = np.arange(12, dtype=np.float32).reshape(4, 3)
    return both


def test_a_sequence_comes_back_as_it_was_written(tmp_path):
    """If this fails, training sees other positions than were simulated. Positions to half a step of a box of 1.2 m,
    0.01 mm, and the body to 0.05 mm, against the float arrays."""
    arrays = _write(tmp_path / "00000_tshirt")
    sequence = dataset.Sequence.load(tmp_path / "00000_tshirt")
    assert len(sequence) == 5
    assert sequence.vertices.dtype == np.float32
    assert np.ptp(arrays["garment_vertices"], axis=1).max() < 1.2
    assert np.abs(sequence.vertices - arrays["garment_vertices"]).max() < 1e-5
    np.testing.assert_array_equal(sequence.garment.vertices, arrays["garment_rest_vertices"])
    np.testing.assert_array_equal(sequence.garment.faces, arrays["garment_faces"])
    np.testing.assert_array_equal(sequence.garment.pins, arrays["pins"])
    names = ("body_rest_vertices", "bone_indices", "bone_weights", "bone_transforms")
    body = linear_blend_skinning(*(arrays[name] for name in names))
    assert np.linalg.norm(sequence.full_body().vertices - body, axis=-1).max() < 5e-5
    np.testing.assert_array_equal(sequence.full_body().faces, arrays["body_faces"])
    assert len(sequence.body().faces) == arrays["collider_faces"].sum()
    assert sequence.wind is None
    assert [(layer.name, layer.category) for layer in sequence.layers] == [("shirt", "tshirt")]
    assert sequence.layers[0].vertices == slice(0, len(arrays["garment_rest_vertices"]))
    assert dataset.list_sequences(tmp_path, split="train") == [tmp_path / "00000_tshirt"]
    assert dataset.list_sequences(tmp_path, split="test") == []
    assert not list(tmp_path.glob(".*")), "the unfinished folder was left behind"


def test_what_was_read_is_written_as_the_same_bytes(tmp_path):
    """If this fails, cloth is simulated on another body than the one stored with it."""
    arrays = _write(tmp_path / "once")
    dataset.write_sequence(tmp_path / "twice", dataset.Sequence.load(tmp_path / "once").arrays(), MANIFEST)
    first, second = (dataset.read_manifest(tmp_path / name)["checksums"] for name in ("once", "twice"))
    assert first == second
    rest, bones, weights = (arrays[name] for name in ("body_rest_vertices", "bone_indices", "bone_weights"))
    simulated_on = linear_blend_skinning(
        *dataset.stored_body(rest, bones, weights), dataset.stored_transforms(arrays["bone_transforms"])
    )
    read = dataset.Sequence.load(tmp_path / "twice").full_body().vertices
    np.testing.assert_array_equal(read, simulated_on)


def test_bytes_per_garment_vertex(tmp_path):
    """If this fails, the standard set grows. Under 8 bytes a frame and vertex for 540 vertices and 1,000 faces, 200
    frames, on the bundled body of 2.9k vertices and 31 bones, manifest and headers included."""
    grid, faces = synthetic_sequences.tube(20, 27, 0.2, 0.6, 1.4)
    assert (len(grid), len(faces)) == (540, 1040)
    arrays = _shirt(1)
    assert len(arrays["body_rest_vertices"]) > 2800
    turns = np.tile(arrays["bone_transforms"], (200, 1, 1, 1))
    arrays |= {
        "garment_rest_vertices": grid,
        "garment_faces": faces,
        "pins": np.arange(20),
        "garment_vertices": grid + np.zeros((200, 1, 1)),
        "bone_transforms": turns,
    }
    manifest = MANIFEST | {"parameters": {str(k): float(k) for k in range(100)}}
    dataset.write_sequence(tmp_path / "s", arrays, manifest)
    size = sum(path.stat().st_size for path in (tmp_path / "s").iterdir())
    assert size / 200 / 540 < 8


def test_outfits_have_layers_and_wind(tmp_path):
    """If this fails, the vertices of one garment are taken for another's."""
    arrays = _outfit()
    garments = [{"name": "a", "category": "shirt", "material": {"density": 0.2}}, {"name": "b", "category": "coat"}]
    dataset.write_sequence(tmp_path / "s", arrays, MANIFEST | {"garments": garments})
    sequence = dataset.Sequence.load(tmp_path / "s")
    inner, outer = sequence.layers
    assert (inner.vertices, outer.vertices) == (slice(0, 72), slice(72, 122))
    assert (inner.faces, outer.faces) == (slice(0, 120), slice(120, 200))
    assert (outer.name, outer.category, inner.entry["material"]) == ("b", "coat", {"density": 0.2})
    assert arrays["garment_faces"][outer.faces].min() == 72
    np.testing.assert_array_equal(sequence.wind, arrays["wind"])
    dataset.write_sequence(tmp_path / "more", arrays, MANIFEST | {"garments": garments[:1]})
    with pytest.raises(MeshError, match=r"more: manifest.json does not describe 2 garments"):
        dataset.Sequence.load(tmp_path / "more")


def test_a_body_without_bones(tmp_path):
    """If this fails, recordings whose body is only positions cannot be kept."""
    arrays = synthetic_sequences.arrays(frames=6)
    skin = ("body_rest_vertices", "bone_indices", "bone_weights", "bone_transforms")
    body = linear_blend_skinning(*(arrays.pop(name) for name in skin))
    dataset.write_sequence(tmp_path / "s", arrays | {"body_vertices": body}, MANIFEST)
    sequence = dataset.Sequence.load(tmp_path / "s")
    assert np.abs(sequence.full_body().vertices - body).max() < 2e-5  # a box of 1.6 m
    assert set(sequence.arrays()) == {*arrays, "body_vertices"}
    assert len(sequence.body().faces) == arrays["collider_faces"].sum()


def test_format_1_is_still_read(tmp_path):
    """If this fails, data sets that exist are lost. Written here as it used to be: floats as they are."""
    arrays = _shirt()
    types = {"garment_faces": np.int32, "pins": np.int32, "body_faces": np.int32, "bone_indices": np.uint8}
    (tmp_path / "old").mkdir()
    for name, array in arrays.items():
        kind = bool if name == "collider_faces" else types.get(name, np.float32)
        np.save(tmp_path / "old" / f"{name}.npy", np.asarray(array, kind))
    for version in ({}, {"format": 1}):
        (tmp_path / "old" / "manifest.json").write_text(json.dumps(MANIFEST | version))
        sequence = dataset.Sequence.load(tmp_path / "old")
        np.testing.assert_array_equal(sequence.vertices, arrays["garment_vertices"])
        assert len(sequence.body().faces) == arrays["collider_faces"].sum()
        assert sequence.wind is None
        assert len(sequence.layers) == 1
    dataset.write_sequence(tmp_path / "new", sequence.arrays(), sequence.manifest)
    assert dataset.read_manifest(tmp_path / "new")["format"] == 2
    old, new = (sum(p.stat().st_size for p in (tmp_path / name).iterdir()) for name in ("old", "new"))
    assert new < 0.6 * old


def _replace(name: str, change):
    """Damages one array."""

    def damage(folder: Path) -> None:
        np.save(folder / f"{name}.npy", change(np.load(folder / f"{name}.npy")))

    return damage


def _truncate(folder: Path) -> None:
    path = folder / "garment_positions.npy"
    path.write_bytes(path.read_bytes()[:2000])


def _pickle(folder: Path) -> None:
    np.save(folder / "wind.npy", np.array([{}, []], dtype=object), allow_pickle=True)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_truncate, "garment_positions.npy cannot be read"),
        (_pickle, r"wind.npy cannot be read \(.*Python objects"),
        (lambda f: (f / "pins.npy").write_bytes(b""), "pins.npy cannot be read"),
        (lambda f: (f / "garment_boxes.npy").unlink(), r"garment_boxes.npy cannot be read \(No such file"),
        (_replace("garment_positions", lambda a: a.astype(np.int64)), "garment_positions.npy is int64, not uint16"),
        (_replace("bone_rotations", lambda a: a[:3]), r"bone_rotations.npy has shape \[3, 2\], not .* with T = 4 as"),
        (_replace("bone_origins", lambda a: a[0]), r"bone_origins.npy has shape \[3\], not \[T,3\]"),
        (_replace("bone_weights", lambda a: a[:, :0]), r"not \[U,W-1\] with W-1 = 1 as in bone_indices.npy"),
        (_replace("collider_faces", lambda a: a[1:]), r"collider_faces.npy .* = \d+ as in body_faces.npy"),
        (_replace("garment_faces", lambda a: a + 1), r"3 of 600 entries of garment_faces.npy exceed 0..121"),
        (_replace("pins", lambda a: np.array([500], np.uint16)), "1 of 1 entries of pins.npy exceed"),
        (_replace("bone_indices", lambda a: a + 1), "entries of bone_indices.npy exceed 0..1"),
        (_replace("garment_faces", lambda a: a[:0]), "garment_faces.npy is empty"),
        (_replace("garment_starts", lambda a: a[[0, 2, 1]]), "garment_starts.npy is .*, not 0 to 122, rising"),
        (_replace("garment_starts", lambda a: a - np.int32([0, 3, 0])), "does not list the faces of one garment"),
        (lambda f: (f / "manifest.json").write_text("{"), "no readable manifest"),
        (lambda f: (f / "manifest.json").write_text('{"format": 3}'), "format 3 is not known"),
        (lambda f: (f / "manifest.json").write_text('{"format": 2}'), "None frames per second"),
    ],
)
def test_damaged_sequences_are_named(tmp_path, damage, message):
    """If this fails, a truncated array or manifest is read as data."""
    dataset.write_sequence(tmp_path / "00007_outfit", _outfit(), MANIFEST)
    damage(tmp_path / "00007_outfit")
    with pytest.raises(MeshError, match=message) as error:
        dataset.Sequence.load(tmp_path / "00007_outfit")
    assert "00007_outfit" in str(error.value)


def test_what_cannot_be_read_is_not_written(tmp_path):
    """If this fails, a mistake is found when the data are used, not when they are made."""
    arrays = _outfit()
    for change, message in (
        ({"garment_vertices": arrays["garment_vertices"][:2]}, "T = 2"),
        ({"garment_faces": arrays["garment_faces"] + 200}, "garment_faces.npy exceed"),
        ({"body_vertices": np.zeros((4, 3, 3))}, "either bone_transforms or body_vertices"),
        ({"colour": np.zeros(3)}, "unknown arrays colour"),
    ):
        with pytest.raises(MeshError, match=f"s: .*{message}"):
            dataset.write_sequence(tmp_path / "s", arrays | change, MANIFEST)
    with pytest.raises(MeshError, match="arrays are missing"):
        dataset.write_sequence(tmp_path / "s", {}, MANIFEST)
    dataset.write_sequence(tmp_path / "s", {}, MANIFEST | {"status": "rejected"})
    with pytest.raises(FileExistsError, match="s exists"):
        dataset.write_sequence(tmp_path / "s", arrays, MANIFEST)
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
    with pytest.raises(FileNotFoundError, match="warpgarment generate"):
        dataset.list_sequences(tmp_path / "nowhere")


def test_two_sets_are_not_mixed(tmp_path):
    """If this fails, a folder holds sequences of two recipes, and nobody knows which."""
    configuration = {"recipe": "cloth3d", "faces": 1200, "categories": ("tshirt", "dress")}
    dataset.write_set_manifest(tmp_path / "set", configuration, {"substeps": 10}, numbers=range(3))
    dataset.write_set_manifest(tmp_path / "set", configuration, {"substeps": 10}, numbers=[7, 2, 3])
    written = dataset.read_set_manifest(tmp_path / "set")
    assert written["numbers"] == [[0, 3], [7, 7]]
    assert written["configuration"]["categories"] == ["tshirt", "dress"]
    assert written["versions"]["numpy"] == np.__version__
    other = configuration | {"faces": 700, "seed": 1}
    with pytest.raises(dataset.DatasetMismatch, match="faces was 1200, is 700; seed was null, is 1; substeps was 10"):
        dataset.write_set_manifest(tmp_path / "set", other, {"substeps": 5})
    assert dataset.read_set_manifest(tmp_path / "set") == written
    assert dataset.read_set_manifest(tmp_path) is None
    (tmp_path / "set" / "set.json").write_text("[]")
    with pytest.raises(MeshError, match=r"no readable set.json \(not a JSON object\)"):
        dataset.read_set_manifest(tmp_path / "set")


def _gate() -> tuple[QualityGate, np.ndarray, np.ndarray]:
    body = rest_body()
    with np.load(demo.ASSETS / "tshirt.npz") as shirt:
        garment = Garment(shirt["rest_vertices"], shirt["faces"])
    return QualityGate((garment,), body.faces, Limits()), garment.vertices.copy(), body.vertices


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
