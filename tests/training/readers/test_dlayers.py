"""D-LAYERS samples: meta.json and pickles as the authors' public readers use them."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from support.files.readers import STRIP, TRIANGLES, moving

from warpgarment.errors import MeshError
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.training.readers import PickleRefused, detect, read_dlayers, read_recording
from warpgarment.training.readers.blender_cloth import blender_material, mass_ratio, wind_speed
from warpgarment.training.teachers import Cloth, ClothScene
from warpgarment.training.teachers.blender.units import BlenderSettings, blender_numbers

FIRST, LAST = 2, 8  # of the clip's ten frames
FRAMES = LAST - FIRST
SCALE = 10.0
CLOTH = {"mass": 0.4, "tension_stiffness": 40.0, "bending_stiffness": 30.0, "self_friction": 50.0}


def meta(**changes) -> dict:
    """A sample's description: two garments, wind from frame 12 of Blender's timeline, which is frame 2 here."""
    human = {"gender": "female", "betas": [0.5] * 10, "motion_path": "motion/07_01.pkl", "seq_start": FIRST}
    human |= {"seq_end": LAST, "frame_start": 10, "scale": SCALE, "collision": {"friction": 60.0}}
    garments = [{"name": "jacket_hood", "cloth": CLOTH | {"mass": 0.8}}, {"name": "dress_sleeveless", "cloth": CLOTH}]
    half = np.sqrt(0.5)
    pivots = [
        {"frame_start": 12, "rotation_quaternion": [1.0, 0.0, 0.0, 0.0], "strength": 200.0},  # (w, x, y, z): up
        {
            "frame_start": 14,
            "rotation_quaternion": [half, half, 0.0, 0.0],
            "strength": [50.0],
        },  # a quarter about X: to -Y, our +Z
    ]
    return {"human": human, "garment": garments, "wind": [{"pivot_list": pivots}]} | changes


def garment_data(shift: float = 0.0, frames: int = FRAMES) -> dict:
    start = STRIP + [shift, 0.0, 0.0]
    data = {"vertices": SCALE * moving(start, frames), "faces": TRIANGLES.astype(np.int32), "tpose": SCALE * start}
    return {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in data.items()}


def write_sample(root: Path, description: dict | None = None) -> Path:
    folder = root / "data" / "00396"
    folder.mkdir(parents=True)
    (folder / "meta.json").write_text(json.dumps(description or meta()))
    for name, shift in (("jacket_hood", 1.0), ("dress_sleeveless", 0.0)):
        dump(folder / f"{name}.pkl", garment_data(shift))
    (root / "motion").mkdir()
    poses = np.arange(10 * 72, dtype=np.float64).reshape(10, 72) / 1000.0
    dump(root / "motion" / "07_01.pkl", {"poses": poses, "trans": np.arange(30.0).reshape(10, 3)})
    return folder


def dump(path: Path, data) -> None:
    path.write_bytes(pickle.dumps(data, protocol=4))


def test_a_sample_comes_out_at_life_size_and_upright(tmp_path):
    """If this fails, garments of the data set have the wrong size, axes, frames or order."""
    recording = read_dlayers(write_sample(tmp_path))
    assert [g.rest.name for g in recording.garments] == ["dress_sleeveless", "jacket_hood"]  # jackets outermost
    for garment, shift in zip(recording.garments, (0.0, 1.0), strict=True):
        x, y, z = np.moveaxis(moving(STRIP + [shift, 0.0, 0.0], FRAMES), -1, 0)
        np.testing.assert_allclose(garment.vertices, np.stack([x, z, -y], axis=-1), atol=1e-6)  # float32
        np.testing.assert_allclose(garment.rest.vertices, STRIP + [shift, 0.0, 0.0], atol=1e-6)
        np.testing.assert_array_equal(garment.rest.faces, TRIANGLES)
    poses = recording.poses
    np.testing.assert_array_equal(poses.rotations[0], np.arange(144, 216).reshape(24, 3) / 1000.0)
    np.testing.assert_array_equal(poses.trans, np.arange(30.0).reshape(10, 3)[FIRST:LAST])
    np.testing.assert_array_equal(poses.betas, [0.5] * 10)
    assert (poses.gender, poses.up, poses.centred, recording.fps) == ("female", "z", False, 30.0)
    assert recording.attributes["garment"][0]["cloth"] == CLOTH
    assert recording.attributes["motion"] == "motion/07_01.pkl"


def test_wind_blows_when_and_where_the_sample_says(tmp_path):
    """If this fails, wind starts at another frame, or blows from another side."""
    wind = read_dlayers(write_sample(tmp_path)).wind
    assert not wind[:2].any()
    speed = np.linalg.norm(wind, axis=1)
    np.testing.assert_allclose(wind[2:4], speed[2:4, None] * [[0.0, 1.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(wind[4:], speed[4:, None] * [[0.0, 0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(speed[2] / speed[4], 2.0, rtol=1e-6)  # a quarter of the pressure


def test_wind_presses_as_hard_as_blenders(tmp_path):
    """If this fails, the speed of the air and the recorded motion do not belong together.

    Both accelerations of a sheet that faces the wind, worked out apart: Blender's 0.02 A s per unit of mass and frame,
    and drag 1/2 rho cd v^2 over the density.
    """
    mass, strength, ratio = 0.4, 200.0, mass_ratio([Garment(STRIP, TRIANGLES)])
    speed = wind_speed(strength, ratio=ratio, scale=SCALE, fps=30.0)
    area = 2 * 0.25**2
    density = mass / ratio * 6 / area
    per_vertex = 0.02 * (area * SCALE**2 / 6) * (strength / 30.0) / mass  # units per frame^2
    assert 0.5 * 1.225 * 1.2 * speed**2 / density == pytest.approx(per_vertex * 30.0**2 / SCALE, rel=1e-9)


def test_materials_move_as_the_blender_teacher_moves_them():
    """If this fails, cloth taken from a recording and simulated again with Blender's numbers is another cloth.

    The other way round is the teacher's own code. Stiffness over density is what a recording determines.
    """
    garment = Garment(STRIP, TRIANGLES)
    material = Material(density=0.3, stretch=500.0, shear=500.0, bend=2e-3, friction=0.45)
    numbers = blender_numbers(ClothScene((Cloth(garment, 0.25, material=material),), frames=2), BlenderSettings())[0]
    cloth = numbers["cloth"] | numbers["collision"]
    back = blender_material(cloth, garment, ratio=7.0, friction=None, scale=BlenderSettings().scale, fps=30.0)
    for name in ("stretch", "shear", "bend"):
        expected = getattr(material, name) / material.density
        assert getattr(back, name) / back.density == pytest.approx(expected, rel=1e-6)
    assert back.friction == pytest.approx(0.45)
    assert blender_material(CLOTH | {"mass": None}, garment, ratio=7.0, friction=None, scale=10.0, fps=30.0) is None


def test_materials_keep_the_proportions_of_the_garments(tmp_path):
    """If this fails, the heavier garment of an outfit is not the heavier one."""
    dress, jacket = read_dlayers(write_sample(tmp_path)).materials
    assert jacket.density == pytest.approx(2 * dress.density)
    assert (jacket.density + dress.density) / 2 == pytest.approx(0.2 * 0.6 / 0.5)  # masses 0.8 and 0.4, the middle 0.5
    assert dress.friction == pytest.approx(0.6)


def test_a_body_made_of_the_poses_is_turned_upright(tmp_path):
    """If this fails, the body lies on its back beside the outfit."""
    faces = np.array([[0, 1, 2]])
    folder = write_sample(tmp_path)
    recording = read_dlayers(folder, body=lambda p: (p.trans[:, None] + np.eye(3), faces))
    np.testing.assert_allclose(recording.body.vertices[0], [[7, 8, -7], [6, 8, -8], [6, 9, -7]])
    (tmp_path / "motion" / "07_01.pkl").unlink()
    given = BodyMotion(np.tile(np.eye(3), (FRAMES, 1, 1)), faces, 30.0)
    assert read_dlayers(folder, body=given).body is given  # no clip needed


def test_other_releases_of_the_description_are_read(tmp_path):
    """If this fails, samples with everything under `simulate`, or with a longer recording, cannot be read."""
    folder = write_sample(tmp_path, {"simulate": meta(wind=[])})
    dump(folder / "jacket_hood.pkl", garment_data(1.0, FRAMES + 3))
    recording = read_recording(folder)
    assert detect(folder) == "dlayers"
    assert (recording.wind, len(recording)) == (None, FRAMES)
    moved = read_dlayers(folder, root=tmp_path)
    assert len(moved.poses) == FRAMES


class Runs:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


@pytest.mark.parametrize("name", ["data/00396/jacket_hood.pkl", "motion/07_01.pkl"])
def test_commands_in_a_sample_do_not_run(tmp_path, name):
    """If this fails, reading somebody's sample runs their commands."""
    folder, marker = write_sample(tmp_path), tmp_path / "ran"
    dump(tmp_path / name, {"vertices": Runs(marker), "poses": Runs(marker)})
    with pytest.raises(PickleRefused, match=r"\.system' at byte"):
        read_dlayers(folder)
    assert not marker.exists()


def human(**changes) -> dict:
    return meta(human=meta()["human"] | changes)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda f: (f / "meta.json").unlink(), r"holds no meta\.json"),
        (lambda f: (f / "meta.json").write_text("{"), "not readable JSON"),
        (lambda f: (f / "meta.json").write_text("[" * 100_000), "not readable JSON"),
        (lambda f: (f / "meta.json").write_text('{"human": {}}'), "no 'human' and 'garment' in it"),
        (lambda f: describe(f, meta(garment=[{"name": "../x"}])), "'garment' must list garments with their names"),
        (lambda f: describe(f, human(scale="ten")), r"human\.scale must be a number, it is 'ten'"),
        (lambda f: describe(f, human(seq_end=1)), "frames 2 to 1: not a sequence"),
        (lambda f: describe(f, human(seq_end=11)), r"10 frames of poses, .*meta\.json asks for 2 to 11"),
        (lambda f: describe(f, human(motion_path="no.pkl")), r"the clip 'no\.pkl' is not below .* root="),
        (lambda f: describe(f, meta(wind=[{"pivot_list": [{"frame_start": 12}]}])), "'wind' cannot be read"),
        (lambda f: describe(f, meta(wind=[{}, {}])), "'wind' must be a list of one field"),
        (lambda f: (f / "jacket_hood.pkl").unlink(), r"1 of 2 garments are missing: jacket_hood\.pkl"),
        (lambda f: dump(f / "jacket_hood.pkl", garment_data(1.0, 4)), "4 frames where meta.json says 6"),
        (
            lambda f: dump(f / "jacket_hood.pkl", {"faces": TRIANGLES}),
            r"'vertices' must be an array .* \[N,N,3\], it is missing",
        ),
        (
            lambda f: dump(f / "jacket_hood.pkl", garment_data() | {"faces": STRIP}),
            r"'faces' must .* float64 \[6, 3\]",
        ),
        (lambda f: dump(f / "jacket_hood.pkl", garment_data() | {"tpose": STRIP[:4]}), "belong to different meshes"),
        (lambda f: dump(f / "jacket_hood.pkl", broken()), r"1 of 6 frames of jacket_hood hold NaN .*frames 3\)"),
        (lambda f: (f / "jacket_hood.pkl").write_bytes(b"\x80\x04"), "not a readable pickle"),
    ],
)
def test_damaged_samples_are_named(tmp_path, spoil, match):
    """If this fails, a damaged sample becomes wrong training data, or an error that does not say what to do."""
    folder = write_sample(tmp_path)
    spoil(folder)
    with pytest.raises(MeshError, match=match):
        read_dlayers(folder)


def describe(folder: Path, description: dict) -> None:
    (folder / "meta.json").write_text(json.dumps(description))


def broken() -> dict:
    data = garment_data()
    data["vertices"][3, 1, 2] = np.nan
    return data
