"""The Blender teacher around its subprocess: a stand-in speaks for Blender, which these tests do not need."""

from __future__ import annotations

import ast
import os
import sys
import textwrap
import time
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from warpgarment.io.pc2 import read_pc2
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.training.materials import RANGES, to_blender
from warpgarment.training.teachers import Cloth, ClothScene, TeacherError, make_teacher
from warpgarment.training.teachers.blender import environment
from warpgarment.training.teachers.blender.teacher import BlenderTeacher, write_scene
from warpgarment.training.teachers.blender.units import (
    LAYERED,
    BlenderSettings,
    blender_numbers,
    pin_path,
    steps_taken,
    to_y_up,
    to_z_up,
)
from warpgarment.training.teachers.checks import hanging_strip

STAND_IN = """
    import json, os, sys, time
    from pathlib import Path
    import numpy as np
    folder = Path(sys.argv[1])
    numbers = json.loads((folder / "scene.json").read_text())
    with np.load(folder / "scene.npz", allow_pickle=False) as data:
        start = data["start"]
    out = sys.stdout.buffer
    def send(frame):
        block = (start + np.float32([0, 0, frame])).astype("<f4").tobytes()
        out.write(len(block).to_bytes(4, "little") + block)
        out.flush()
    frames = numbers["last_frame"] - numbers["first_frame"] + 1
    out.write(b"warpgarment-frames 1\\n")
"""
ALL = "for frame in range(frames): send(frame)"
SLOW = "Path({told!r}).write_text(f'{{os.getpid()}} {{folder}}'); send(0); time.sleep(60)"
DYING = "send(0); send(1); out.close(); sys.exit('Segmentation fault in the tailor')"


def _teacher(tmp_path: Path, ending: str, **settings) -> BlenderTeacher:
    """A teacher whose Blender is a script of this test."""
    script = tmp_path / "stand_in.py"
    script.write_text(textwrap.dedent(STAND_IN) + ending)
    return BlenderTeacher(BlenderSettings(**settings), sys.executable, script=script)


def _sheet(height: float = 0.17, size: float = 0.4, cells: int = 10, pins=()) -> Garment:
    grid, faces = igl.triangulated_grid(cells + 1, cells + 1)[:2]
    grid = np.asarray(grid, float) * size - size / 2
    vertices = np.stack([grid[:, 0], np.full(len(grid), height), -grid[:, 1]], 1)
    return Garment(vertices.astype(np.float32), np.asarray(faces, np.int32), pins=np.array(pins, int))


def _ball(frames: int, speed: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.15)
    path = np.zeros((frames, 1, 3))
    path[:, 0, 0] = speed * np.arange(frames) / 30.0
    return (ball.vertices[None] + path).astype(np.float32), ball.faces.astype(np.int32)


def test_frames_arrive_in_order_upright_and_in_metres(tmp_path):
    """If this fails, frames are lost or swapped, lie on their side, or have Blender's scale."""
    sheet = _sheet()
    scene = ClothScene((Cloth(sheet, 0.04), Cloth(_sheet(0.3), 0.04)), frames=4, settle=3)
    frames = list(_teacher(tmp_path, ALL, scale=8.0).simulate(scene))
    assert [f.dtype for f in frames] == [np.float32] * 4
    first = np.concatenate([c.first for c in scene.cloths])
    for number, frame in enumerate(frames):  # the stand-in lifts everything by one of Blender's units a frame
        np.testing.assert_allclose(frame, first + [0.0, number / 8.0, 0.0], atol=1e-6)  # float32 of half a metre


def test_scenes_of_other_lengths_run_side_by_side(tmp_path):
    """If this fails, a batch mixes up its scenes or stops with the shortest."""
    scenes = [ClothScene((Cloth(_sheet(h), 0.04),), frames=n, settle=0) for h, n in ((0.1, 2), (0.5, 3))]
    shown = list(_teacher(tmp_path, ALL).simulate_many(scenes))
    assert [[f is not None for f in row] for row in shown] == [[True, True], [True, True], [False, True]]
    assert shown[1][0][0, 1] == pytest.approx(0.2)
    assert shown[2][1][0, 1] == pytest.approx(0.7)


def test_leaving_early_ends_the_child_and_removes_its_files(tmp_path):
    """If this fails, a rejected sequence leaves a Blender running, or its files behind."""
    told = tmp_path / "told.txt"
    running = _teacher(tmp_path, SLOW.format(told=str(told))).simulate(
        ClothScene((Cloth(_sheet(), 0.04),), frames=9, settle=0)
    )
    next(running)
    child, folder = told.read_text().split()
    assert Path(folder, "scene.npz").exists()
    began = time.perf_counter()
    running.close()
    assert time.perf_counter() - began < 10, "it waited for the child instead of ending it"
    with pytest.raises(ProcessLookupError):
        os.kill(int(child), 0)
    assert not Path(folder).exists()


def test_the_death_of_the_child_is_told_with_its_last_words(tmp_path):
    """If this fails, a crash in Blender looks like the end of a sequence, or says nothing about its cause."""
    running = _teacher(tmp_path, DYING).simulate(ClothScene((Cloth(_sheet(), 0.04),), frames=5, settle=0))
    next(running), next(running)
    with pytest.raises(TeacherError, match=r"frame 2 of 5 .* status 1(.|\n)*fault in the tailor"):
        next(running)
    (tmp_path / "mute.py").write_text("raise ImportError('libtailor.so: cannot open')")
    mute = BlenderTeacher(environment=sys.executable, script=tmp_path / "mute.py")
    with pytest.raises(TeacherError, match=r"did not begin(.|\n)*libtailor.so"):
        next(mute.simulate(ClothScene((Cloth(_sheet(), 0.04),), frames=5)))


def test_what_cannot_be_simulated_is_refused_before_anything_runs(tmp_path):
    """If this fails, a broken scene reaches Blender, which simulates anything."""
    with pytest.raises(TeacherError, match="frames"):
        next(_teacher(tmp_path, ALL).simulate(ClothScene((Cloth(_sheet(), 0.04),))))


def test_up_stays_up_and_right_stays_right():
    """If this fails, Blender's scene is mirrored, or gravity pulls it sideways."""
    np.testing.assert_array_equal(to_z_up(np.array([0.0, 1.0, 0.0])), [0.0, 0.0, 1.0])
    turned = to_z_up(np.eye(3))
    np.testing.assert_allclose(turned @ turned.T, np.eye(3))
    assert np.linalg.det(turned) == pytest.approx(1.0)
    points = np.random.default_rng(0).normal(size=(2, 5, 3))
    np.testing.assert_array_equal(to_y_up(to_z_up(points)), points)


def test_pins_move_with_a_body_that_moves_rigidly():
    """If this fails, waistbands slip on the body. Tolerance: the body's path is float32, at 2 m."""
    frames, faces = _ball(1)
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(20, 3))
    points = 0.16 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    turns, shifts = Rotation.random(6, random_state=2), rng.normal(size=(6, 3))
    turns = Rotation.concatenate([Rotation.identity(), turns])
    shifts = np.concatenate([np.zeros((1, 3)), shifts])
    body = np.stack([turn.apply(frames[0]) + shift for turn, shift in zip(turns, shifts, strict=True)])
    expected = np.stack([turn.apply(points) + shift for turn, shift in zip(turns, shifts, strict=True)])
    np.testing.assert_allclose(pin_path(points, body.astype(np.float32), faces), expected, atol=2e-6)


def test_blender_is_given_the_body_and_the_pins_in_the_right_frames(tmp_path):
    """If this fails, cloth and body are a frame apart, or settling does not stand still."""
    frames, faces = _ball(4, speed=1.0)
    loose = np.concatenate([frames, np.full((4, 1, 3), 7.0, np.float32)], axis=1)  # a vertex no face needs
    scene = ClothScene((Cloth(_sheet(pins=[5, 60]), 0.04),), loose, faces, settle=2)
    settings = BlenderSettings()
    write_scene(tmp_path, scene, settings)
    numbers, _ = blender_numbers(scene, settings)
    assert numbers["first_frame"] == 4, "frame 1 is the start; two frames settle; the next is the first shown"
    body, path = (to_y_up(read_pc2(tmp_path / name).vertices) / settings.scale for name in ("body.pc2", "pins.pc2"))
    assert len(body) == len(path) == numbers["last_frame"] == 7
    np.testing.assert_allclose(body[:4], np.repeat(frames[:1], 4, axis=0), atol=1e-6)
    np.testing.assert_allclose(body[3:], frames, atol=1e-6)
    moved = frames.mean(1) - frames[0].mean(0)
    np.testing.assert_allclose(path[3:, 60] - path[0, 60], moved, atol=2e-6)  # float32 at ten times life size
    assert not np.ptp(path[:, 0], axis=0).any(), "a vertex that is not pinned has no way to go"


def test_several_cloths_are_kept_further_apart():
    """If this fails, layers lie so close that Blender lets them through each other, or coarse cloth touches itself."""

    def told(count: int, cells: int) -> tuple[float, float]:
        sheet = _sheet(cells=cells)
        scene = ClothScene(tuple(Cloth(sheet, 0.04) for _ in range(count)), frames=1)
        ends = sheet.vertices[sheet.edges].astype(np.float64)
        mean = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
        return blender_numbers(scene, BlenderSettings())[0]["collision"]["self_distance_min"], mean

    settings = BlenderSettings()
    one, mean = told(1, 6)
    assert mean > 4 * settings.layer_distance, "coarse enough for the whole distance"
    assert told(2, 6)[0] / one == pytest.approx(settings.layer_distance / settings.self_distance)
    fine, mean = told(2, 20)
    assert fine / one == pytest.approx(0.25 * mean / settings.self_distance)


def test_numbers_stand_for_the_material():
    """If this fails, materials mean another cloth in Blender: compared with the mapping of the materials themselves.

    That one keeps Blender's clock, on which gravity is 0.00981 a frame squared; at ten times life size these are 100
    frames a second. Tolerance: it takes triangles for equilateral, those of the ball differ by 15 %.
    """
    frames, faces = _ball(1)
    ball = Garment(frames[0], faces)
    materials = (Material(), Material(density=0.4, stretch=300.0, shear=300.0, bend=5e-3, friction=0.6))
    cloths = tuple(Cloth(ball, 0.03, material=m) for m in materials)
    scene = ClothScene(cloths, frames=1, fps=100.0)
    numbers, arrays = blender_numbers(scene, BlenderSettings(compression=1.0))
    told, area = numbers["cloth"], 0.5 * igl.doublearea(ball.vertices.astype(float), ball.faces.astype(np.int64)).sum()
    np.testing.assert_allclose(numbers["gravity"], [0.0, 0.0, -9.81], atol=1e-9)
    assert numbers["collider"]["cloth_friction"] == pytest.approx(40.0), "the mean of both"
    for k, material in enumerate(materials):
        theirs = to_blender(material, vertices=len(ball.vertices), area=area)
        at = k * len(ball.vertices)
        for mine, weight, name in (("tension", "structural", "tension"), ("bending", "bending", "bending")):
            low, high = told[f"{mine}_stiffness"], told[f"{mine}_stiffness_max"]
            stiffness = low + arrays[weight][at] * (high - low)
            assert stiffness / told["mass"] == pytest.approx(theirs[name] / theirs["mass"], rel=0.05)


def test_wind_pushes_as_drag_does():
    """If this fails, the wind of a scene is another one in Blender. The law is 1/2 rho cd w^2 on a face across it."""
    wind = np.array([[0.0, 0.0, 3.0], [4.0, 0.0, 0.0]])
    scene = ClothScene((Cloth(_sheet(), 0.04),), frames=2, settle=1, wind=wind)
    for scale in (1.0, 10.0):
        settings = BlenderSettings(scale=scale)
        numbers, arrays = blender_numbers(scene, settings)
        mass = 0.2 * 0.4**2 / 121  # of a vertex [kg]
        area = scale**2  # of a square metre
        force = 0.02 * area * arrays["wind"][:, 3] / 30.0  # Blender's, in units of its mass and length, per frame^2
        newtons = force * mass / numbers["cloth"]["mass"] / scale * 30.0**2
        speeds = [3.0, 3.0, 3.0, 4.0]  # at the start, while settling, and in both frames
        np.testing.assert_allclose(newtons, 0.5 * 1.225 * 1.2 * np.square(speeds), rtol=1e-6)  # the sheet is float32
        np.testing.assert_allclose(arrays["wind"][-2:, :3], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    vacuum = blender_numbers(scene, BlenderSettings(drag=0.0))[1]
    assert "wind" not in vacuum


def test_substeps_that_blender_miscounts_are_refused():
    """If this fails, every frame silently lasts 13/12 of a frame, as measured in a free fall with 12 substeps."""
    assert [n for n in range(1, 20) if steps_taken(n) != n] == [12, 19]
    with pytest.raises(ValueError, match="takes 13"):
        BlenderSettings(substeps=12)


def test_stiff_hinges_get_more_substeps_and_are_limited_beyond():
    """If this fails, leather trembles: Blender's bending is explicit, stable for a stiffness below mass over step^2."""
    quality, hardness = [], []
    for bend in (1e-3, 0.5, 1.0, 100.0):
        scene = ClothScene((Cloth(_sheet(), 0.04, material=Material(bend=bend)),), frames=1)
        told = blender_numbers(scene, BlenderSettings())[0]["cloth"]
        quality.append(told["quality"])
        hardness.append(told["bending_stiffness"] / told["mass"] / told["quality"] ** 2)
        assert max(told["tension_stiffness"], told["bending_stiffness"]) == pytest.approx(1000.0), "of 10,000 at most"
    assert quality[0] == 10 < quality[1] < quality[2] < quality[3] == 42
    assert max(hardness) == pytest.approx(4.0)


def test_data_are_made_with_the_settings_that_were_chosen(monkeypatch):
    """If this fails, `generate --teacher blender` draws cloth through the body, as the plain settings did."""
    monkeypatch.setenv(environment.VARIABLE, sys.executable)
    teacher = make_teacher("blender")
    assert isinstance(teacher, BlenderTeacher)
    assert teacher._settings == LAYERED
    told = blender_numbers(ClothScene((Cloth(_sheet(), 0.04),), frames=1), LAYERED)[0]
    assert told["cloth"]["quality"] == 20
    assert told["cloth"]["compression_stiffness"] == pytest.approx(0.3 * told["cloth"]["tension_stiffness"])
    kept = told["collision"]["distance_min"] + told["collider"]["thickness_outer"]
    assert kept / LAYERED.scale == pytest.approx(6e-3), "the distance from the body that is kept [m]"


def test_a_missing_environment_names_the_command(monkeypatch, tmp_path):
    """If this fails, a user without Blender does not learn how to get it."""
    monkeypatch.delenv(environment.VARIABLE, raising=False)
    monkeypatch.setenv("WARPGARMENT_CACHE", str(tmp_path))
    with pytest.raises(TeacherError, match=r"python -m warpgarment.training.teachers.blender.environment"):
        make_teacher("blender")
    monkeypatch.setenv(environment.VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(TeacherError, match="nowhere"):
        make_teacher("blender")
    with pytest.raises(TeacherError, match="has no bpy"):
        environment.version_of(Path(sys.executable))


def _fake_python(path: Path, version: str, pip: str = "true") -> Path:
    """An interpreter that says its version, and whose `venv` and `pip` do next to nothing."""
    path.write_text(
        f"""#!/bin/sh
        case "$*" in
            *version_info*) echo {version};;
            *"-m venv"*) mkdir -p "$4/bin" && cp "$0" "$4/bin/python";;
            *"-m pip"*) {pip};;
        esac
        """
    )
    path.chmod(0o755)
    return path


@pytest.mark.usefixtures("capsys")
def test_the_environment_is_made_whole_or_not_at_all(tmp_path):
    """If this fails, a Python of another version gets as far as pip, or a broken environment is left to be found."""
    with pytest.raises(TeacherError, match=r"needs Python 3.11; .*is 3.9.*--python python3.11"):
        environment.make_environment(tmp_path / "a", _fake_python(tmp_path / "old", "3.9"))
    with pytest.raises(TeacherError, match="no pythonnowhere"):
        environment.make_environment(tmp_path / "a", "pythonnowhere")
    failing = _fake_python(tmp_path / "failing", "3.11", "echo no room left >&2; exit 1")
    with pytest.raises(TeacherError, match="no room left"):
        environment.make_environment(tmp_path / "b", failing)
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "b").exists()
    good = _fake_python(tmp_path / "good", "3.11")
    python = environment.make_environment(tmp_path / "c", good)
    assert python == environment.find_environment(tmp_path / "c")
    assert environment.make_environment(tmp_path / "c", "pythonnowhere") == python, "it is there; nothing is made"


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    """If this fails, `--path` of a folder in use empties it."""
    (tmp_path / "thesis.txt").write_text("all of it")
    with pytest.raises(TeacherError, match="something else"):
        environment.make_environment(tmp_path, _fake_python(tmp_path.parent / "python", "3.11"))
    assert (tmp_path / "thesis.txt").exists()


def test_the_script_needs_nothing_of_this_package():
    """If this fails, the script cannot run in Blender's environment, or Blender's licence comes into this process."""
    tree = ast.parse(Path(environment.__file__).with_name("script.py").read_text())
    imports = [n for n in ast.walk(tree) if isinstance(n, (ast.Import, ast.ImportFrom))]
    names = {alias.name for n in imports if isinstance(n, ast.Import) for alias in n.names}
    names |= {str(n.module).partition(".")[0] for n in imports if isinstance(n, ast.ImportFrom)}
    assert names - set(sys.stdlib_module_names) == {"bpy", "mathutils", "numpy"}
    assert "bpy" not in sys.modules


@pytest.mark.skipif(
    environment.VARIABLE not in os.environ, reason="needs Blender, of which a variable names the Python"
)
def test_blender_drapes_a_sheet_over_a_moving_ball():
    """If this fails, real Blender lets cloth through, leaves a body behind, or does not repeat itself."""
    frames, faces = _ball(5, speed=1.0)
    scene = ClothScene((Cloth(_sheet(), 0.04, material=Material(friction=0.5)),), frames, faces, settle=8)
    shown = np.stack(list(BlenderTeacher().simulate(scene)))
    distance = igl.signed_distance(shown[-1].astype(float), frames[-1].astype(float), faces.astype(np.int64))[0]
    assert 0.002 < distance.min() < 0.006, "it lies on the ball at the distance that is kept, 4 mm"
    assert shown[-1, 0, 1] < 0.12, "the corners do not fall"
    moved = shown[-1].mean(0)[0] - shown[0].mean(0)[0]
    assert 0.02 < moved < 4.0 / 30.0, "friction does not take it along"
    np.testing.assert_array_equal(shown, np.stack(list(BlenderTeacher().simulate(scene))))


@pytest.mark.skipif(
    environment.VARIABLE not in os.environ, reason="needs Blender, of which a variable names the Python"
)
def test_blender_stretches_as_the_material_asks():
    """If this fails, a network is taught materials that do not count: both ends of what is drawn must hang apart.

    A strip of 0.6 m stretches by density g L^2 / 2 E: 2.8 mm when soft and heavy, 0.1 mm when stiff and light.
    Tolerance: borders of the strip are stiffer than its inside, and it is hung by a clamped edge.
    """
    soft, stiff = (
        Material(density=density, stretch=RANGES["stretch"][end], shear=RANGES["shear"][end])
        for density, end in ((RANGES["density"][1], 0), (RANGES["density"][0], 1))
    )
    teacher = BlenderTeacher(LAYERED)
    hung = [hanging_strip(teacher, m, length=0.6, width=0.12, edge=0.03, settle=120) for m in (soft, stiff)]
    for result in hung:
        assert result.measured == pytest.approx(result.expected, rel=0.15), str(result)
    assert hung[0].measured > 20 * hung[1].measured
