"""Twins of recorded sequences: the scene is the one that was recorded, or the command says that it is not."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import igl
import numpy as np
import pytest

from warpgarment.training.data.encoding import boxed
from warpgarment.training.data.sequence import Sequence, list_sequences
from warpgarment.training.data.verify import verify
from warpgarment.training.evaluate.shape import DIFFERENCE, LOOKS
from warpgarment.training.evaluate.twins.__main__ import TwinsConfig, floor_slope, main, make_twins, simulated
from warpgarment.training.evaluate.twins.scene import TwinError, noisy, scene_of
from warpgarment.training.evaluate.twins.stored import read_twin, shape_of
from warpgarment.training.generate.recipes import GenerateConfig
from warpgarment.training.generate.run import generate
from warpgarment.training.teachers import make_teacher


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A set of one test sequence, and one that is not for testing."""
    out = tmp_path_factory.mktemp("set") / "data"
    config = GenerateConfig(
        out=out, first=3, sequences=2, frames=3, faces=400, categories=("tshirt",), bodies="bundled",
        procedural_share=1.0, least_frames=1, attempts=1,
    )  # fmt: skip
    generate(config)
    return out


class Repeating:
    """A teacher whose frames are those recorded, moved by as much as its scene's start is, and by `off` metres."""

    name = "newton"

    def __init__(self, folder, off: float = 0.0):
        self._sequence, self._off = Sequence.load(folder), off
        self._start = np.concatenate([cloth.first for cloth in scene_of(self._sequence).cloths])
        self.runs = 0

    def simulate(self, scene):
        self.runs += 1
        start = np.concatenate([cloth.first for cloth in scene.cloths])
        for vertices in self._sequence.vertices:
            yield vertices + (start - self._start) + np.float32(self._off)

    def settings(self):
        return self._sequence.manifest["parameters"]["teacher"]


@pytest.fixture
def data(made, tmp_path):
    """A copy, to be changed."""
    return shutil.copytree(made, tmp_path / "data")


def folder_of(data):
    return list_sequences(data, "test")[0]


def change(folder, edit) -> None:
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def test_without_noise_the_recording_comes_back(made):
    """The floor would hold what the scene was made differently by. Equal bits of what is stored, on this processor."""
    sequence = Sequence.load(folder_of(made))
    frames = simulated(make_teacher("newton"), scene_of(sequence), len(sequence))
    codes, boxes = boxed(frames)
    np.testing.assert_array_equal(codes, np.load(sequence.folder / "garment_positions.npy"))
    np.testing.assert_array_equal(boxes, np.load(sequence.folder / "garment_boxes.npy"))


def test_twins_are_made_once(data):
    """A twin is the recording itself, is made again by the next run, is large, or harms the set."""
    assert main(["--data", str(data), "--noise", "3"]) == 0
    (path,) = (data / "twins").iterdir()
    folder = folder_of(data)
    assert path.name == f"{folder.name}.json"
    assert path.stat().st_size < 20_000
    sequence = Sequence.load(folder)
    twin = read_twin(path, sequence)
    assert set(twin.figures) == {*DIFFERENCE, *LOOKS}
    assert 0.01 < twin.figures["distance"].mean() < 1.0  # the encoding alone: 0.001 cm
    assert twin.about["teacher"] == sequence.manifest["parameters"]["teacher"]
    assert twin.about["replay_mm"] < 0.02  # half a step of the encoding: 0.008 mm
    before = path.stat().st_mtime_ns
    assert make_twins(TwinsConfig(data, noise=3.0)) == {folder.name: "is there"}
    assert path.stat().st_mtime_ns == before
    assert [p for p in verify(data).problems if p.where != "set.json"] == []


def test_the_floor_is_the_distance_that_was_made(data):
    """Figures are of other frames, in other units, or of a twin without noise. A teacher that carries the noise of its
    start through all frames: the distance is the mean length of the seeded noise, pins excepted. 1e-3 cm: encoding."""
    folder = folder_of(data)
    teacher = Repeating(folder)
    make_twins(TwinsConfig(data, noise=2.0, seed=7), make=lambda name, device: teacher)
    sequence = Sequence.load(folder)
    figures = read_twin(data / "twins" / f"{folder.name}.json", sequence).figures
    rng = np.random.default_rng([7, sequence.manifest["number"]])
    noise = rng.normal(0, 0.002, (len(sequence.garment.vertices), 3))
    noise[sequence.garment.pins] = 0
    expected = 100 * np.linalg.norm(noise, axis=1)
    np.testing.assert_allclose(figures["distance"], expected.mean(), atol=1e-3)
    quarter = shape_of(sequence).quarter
    np.testing.assert_allclose(figures["hem"], expected[quarter == 0].mean(), atol=1e-3)
    assert teacher.runs == 2  # without noise first


def test_pins_and_other_cloths_keep_their_start(made):
    """Noise on pins would tie them elsewhere on the body; no noise must be the scene itself."""
    scene = scene_of(Sequence.load(folder_of(made)))
    held = replace(scene.cloths[0], garment=replace_pins(scene.cloths[0].garment, [4, 9]))
    scene = replace(scene, cloths=(held,))
    moved = noisy(scene, 1e-3, np.random.default_rng(0)).cloths[0].first - held.first
    assert np.abs(moved[[4, 9]]).max() == 0
    assert np.delete(moved, [4, 9], axis=0).std() == pytest.approx(1e-3, rel=0.1)
    assert noisy(scene, 0.0, np.random.default_rng(0)).cloths[0].start is held.start


def replace_pins(garment, pins):
    from warpgarment.objects.garment import Garment

    return Garment(garment.vertices, garment.faces, pins=np.array(pins))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda m: m["parameters"]["teacher"].update(iterations=7), "iterations was 7, is 5"),
        (lambda m: m["parameters"]["teacher"].update(newton="0.1"), "newton was '0.1', is"),
        (lambda m: m["parameters"]["outfit"]["layers"][0].update(ease=0.05), "garment_(faces|rest_vertices)"),
        (lambda m: m["parameters"].update(motion="procedural:walk"), "bone_transforms of the scene"),
        (lambda m: m["parameters"].update(wind={"strength": 3.0}), "wind of the scene made again is not recorded"),
        (lambda m: m["parameters"].pop("seams"), "another seams"),
        (lambda m: m["parameters"].update(motion="cmu_01_01"), "cmu_01_01 is a clip"),
        (lambda m: m["parameters"].pop("outfit"), "has no plan"),
        (lambda m: m.pop("parameters"), "names no teacher"),
    ],
)
def test_another_scene_or_teacher_is_refused_by_name(data, edit, message):
    """A wrong floor is reported after settings, versions or the code that makes scenes have changed."""
    change(folder_of(data), edit)
    with pytest.raises(TwinError, match=message):
        make_twins(TwinsConfig(data))
    assert not list((data / "twins").glob("*.json"))


def test_changed_code_of_the_teacher_is_noticed(data):
    """The teacher's code changes and not its settings: a twin of another physics would be taken for noise. Frames 1 mm
    aside are refused, unless the tolerance is said to be wider; those in place pass."""
    folder = folder_of(data)
    config = TwinsConfig(data)
    moved = Repeating(folder, off=1e-3)
    with pytest.raises(TwinError, match=r"without noise it is 1.73 mm away"):
        make_twins(config, make=lambda name, device: moved)
    assert make_twins(replace(config, tolerance=2.0), make=lambda name, device: moved)


def test_twins_of_another_time_are_refused(data):
    """A floor is read that is damaged, of another recording, or of other noise than is asked for."""
    folder = folder_of(data)
    config = TwinsConfig(data)
    teacher = Repeating(folder)
    make_twins(config, make=lambda name, device: teacher)
    with pytest.raises(TwinError, match=r"noise_mm 0\.1, not 1\.0"):
        make_twins(replace(config, noise=1.0), make=lambda name, device: teacher)
    path = data / "twins" / f"{folder.name}.json"
    text = path.read_text()
    first = json.loads(text)["figures"]["distance"][5]
    path.write_text(text.replace(str(first), str(first + 1), 1))
    with pytest.raises(TwinError, match="checksum"):
        read_twin(path, Sequence.load(folder))
    path.write_text(text)
    positions = np.load(folder / "garment_positions.npy")
    positions[3, 5, 1] ^= 1
    np.save(folder / "garment_positions.npy", positions)
    with pytest.raises(TwinError, match="another recording"):
        read_twin(path, Sequence.load(folder))
    runs = teacher.runs
    make_twins(replace(config, tolerance=1.0), make=lambda name, device: teacher)  # is made anew
    assert teacher.runs == runs + 2
    assert read_twin(path, Sequence.load(folder)).figures["distance"].shape == (33,)


def test_a_simulation_that_fails_leaves_no_twin(data):
    """A floor of NaN would be stored."""
    folder = folder_of(data)
    failing = Repeating(folder)
    failing.simulate = lambda scene: iter(np.full_like(failing._sequence.vertices, np.nan))
    with pytest.raises(TwinError, match="not finite"):
        make_twins(TwinsConfig(data, check=0), make=lambda name, device: failing)
    assert not list((data / "twins").glob("*"))


def test_slope_of_the_floor_is_that_of_a_line(made):
    """The factor for --unroll.floor is not the twin's distance for each metre from the body: a twin that is 0.3 of that
    distance away, which libigl measures, has 0.3. 1e-4: its distances are float64."""
    sequence = Sequence.load(next(iter(list_sequences(made, "test"))))
    recorded, body = np.array(sequence.vertices), sequence.body()
    away = np.zeros_like(recorded)
    for t, frame in enumerate(recorded):
        solid = body.vertices[t].astype(np.float64), body.faces.astype(np.int64)
        outside = igl.signed_distance(frame.astype(np.float64), *solid)[0] > 0.0
        away[t, :, 1] = 0.3 * outside * np.sqrt(igl.point_mesh_squared_distance(frame.astype(np.float64), *solid)[0])
    assert floor_slope(recorded, recorded + away, body) == pytest.approx(0.3, rel=1e-4)
    assert floor_slope(recorded, recorded, body) == 0.0
