"""If these failed, the add-on would simulate another scene than Blender shows, or Blender show another result.

Blender is another program. `python -m warpgarment.training.teachers.blender.environment` makes a Python with `bpy`
(4.5, NumPy 1) and says where; `$WARPGARMENT_BLENDER` names it. Where that is not set, these tests are skipped.
"""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.scenes import network, simulator

import warpgarment as wg
from warpgarment.nn import checkpoint

NAMED = os.environ.get("WARPGARMENT_BLENDER", "")
PYTHON = next((p for p in (Path(NAMED) / "bin" / "python", Path(NAMED)) if NAMED and p.is_file()), None)
needs_blender = pytest.mark.skipif(PYTHON is None, reason="$WARPGARMENT_BLENDER names no Python with bpy")
ADDON = Path(__file__).resolve().parents[2] / "integrations" / "blender" / "warpgarment_blender"

SCENE = """
import json, math, shutil, sys, time
from pathlib import Path

import bpy
import numpy as np

told = json.loads(sys.argv[1])
sys.path.insert(0, told["folder"])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module="warpgarment_blender")
bpy.context.preferences.addons["warpgarment_blender"].preferences.python = told["python"]
scene = bpy.context.scene
scene.frame_start, scene.frame_end, scene.render.fps = 11, 16, 24
scene.unit_settings.scale_length = 0.1  # a unit is a decimetre

def mesh(name, points, faces):
    data = bpy.data.meshes.new(name)
    data.from_pydata(points, [], faces)
    made = bpy.data.objects.new(name, data)
    scene.collection.objects.link(made)
    return made

around, rings = 16, 9
ball = [(1.5 * math.sin(a) * math.cos(b), 1.5 * math.sin(a) * math.sin(b), 3 * math.cos(a))
        for a in np.linspace(0.2, math.pi - 0.2, rings) for b in np.linspace(0, 2 * math.pi, around, endpoint=False)]
quads = [(r * around + k, (r + 1) * around + k, (r + 1) * around + (k + 1) % around, r * around + (k + 1) % around)
         for r in range(rings - 1) for k in range(around)]
caps = [tuple(range(around)), tuple(reversed(range((rings - 1) * around, rings * around)))]
body = mesh("body", ball, quads + caps)

rig = bpy.data.objects.new("rig", bpy.data.armatures.new("rig"))
scene.collection.objects.link(rig)
bpy.context.view_layer.objects.active = rig
bpy.ops.object.mode_set(mode="EDIT")
bone = rig.data.edit_bones.new("bone")
bone.head, bone.tail = (0, 0, 0), (0, 0, 1)
bpy.ops.object.mode_set(mode="OBJECT")
pose = rig.pose.bones["bone"]
pose.rotation_mode = "QUATERNION"
for frame, angle in ((11, 0.0), (16, 0.5)):
    pose.rotation_quaternion = (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)  # about the rig's X
    pose.keyframe_insert("rotation_quaternion", frame=frame)
group = body.vertex_groups.new(name="bone")
group.add(range(len(ball)), 1.0, "REPLACE")
modifier = body.modifiers.new("armature", "ARMATURE")
modifier.object = rig

tube = [(2.0 * math.cos(b), 2.0 * math.sin(b), z) for z in np.linspace(1.2, -1.2, 5)
        for b in np.linspace(0, 2 * math.pi, around, endpoint=False)]
ring = [(r * around + k, (r + 1) * around + k, (r + 1) * around + (k + 1) % around, r * around + (k + 1) % around)
        for r in range(4) for k in range(around)]
shrunk = [(4 * x + 8, 4 * y, 4 * z) for x, y, z in tube]  # the object's own coordinates, see its transform below
garment = mesh("tube", shrunk, ring)
garment.scale, garment.location = (0.25, 0.25, 0.25), (-2.0, 0.0, 0.0)
garment.keyframe_insert("location", frame=11)
garment.location = (-2.0, 0.0, 0.3)
garment.keyframe_insert("location", frame=16)
shift = garment.modifiers.new("shift", "CAST")
shift.factor = 0.0
lift = garment.modifiers.new("lift", "DISPLACE")
lift.strength, lift.direction, lift.mid_level = told.get("lift", 0.0), "Z", 0.0
garment.modifiers.new("smooth", "SUBSURF").levels = 1
top = garment.vertex_groups.new(name="top")
top.add(range(around), 1.0, "REPLACE")
settings = scene.warpgarment
settings.pins, settings.network, settings.device, settings.path = "top", told["network"], "cpu", told["cache"]
for held in scene.objects:
    held.select_set(held in (garment, body))
bpy.context.view_layer.objects.active = garment
"""

RUN = """
from warpgarment_blender import task as tasks, ui

longest, words, tasks.BUDGET = [], [], 0.0  # a frame for each step
step = tasks.Task.step
def timed(self):
    if self._process is not None and self._process.poll() is not None:
        folder = Path(told["kept"])
        for name in ("job.npz", "job.json", "result.npz"):
            if (self._folder / name).exists():
                shutil.copy(self._folder / name, folder / name)
    began = time.process_time()
    waiting = self._process is not None and self._process.poll() is None
    try:
        step(self)
    finally:
        if waiting:
            longest.append(time.process_time() - began)
        words.append(self.words)
tasks.Task.step = timed
try:
    said = sorted(bpy.ops.warpgarment.simulate())
except RuntimeError as error:  # a script is told of a reported error so
    said = ["ERROR", str(error)]
frames, shown = [], []
garment.modifiers["smooth"].show_viewport = False
for frame in range(11, 17):
    scene.frame_set(frame)
    held = garment.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.array([held.matrix_world @ v.co for v in held.data.vertices])
    frames.append(points)
np.savez(told["out"], frames=frames)
after = {m.name: m.show_viewport for m in garment.modifiers}
bpy.ops.warpgarment.remove()
removed = {m.name: m.show_viewport for m in garment.modifiers}
print(json.dumps({"said": said, "words": words, "longest": max(longest, default=0.0), "after": after,
                  "removed": removed, "status": settings.words, "running": settings.running}))
"""


def _blender(tmp_path: Path, script: str = RUN, **told) -> dict:
    """What a script says that runs in Blender after `SCENE`."""
    told = {"folder": str(ADDON.parent), "python": sys.executable, "cache": str(tmp_path / "tube.pc2"),
            "kept": str(tmp_path), "out": str(tmp_path / "shown.npz"), "network": str(tmp_path / "n.safetensors"),
            **told}  # fmt: skip
    ran = subprocess.run(
        [str(PYTHON), "-c", SCENE + script, json.dumps(told)], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout.strip().splitlines()[-1])


@pytest.fixture
def trained(tmp_path) -> Path:
    """A folder with a small network."""
    checkpoint.save(network(), tmp_path / "n.safetensors")
    return tmp_path


@needs_blender
def test_blender_shows_what_was_simulated(trained: Path) -> None:
    """The garment in Blender would be elsewhere, in other units, or another frame's.

    The job is the scene: the body is turned by its armature about X, by 0.5 in the last frame, to 1e-5 m; the garment
    begins in the first. The result is `rollout` of that job, bit by bit, and Blender shows it, to 1e-5 of a unit.
    """
    said = _blender(trained)
    assert said["said"] == ["FINISHED"], said
    with np.load(trained / "job.npz") as data:
        job = dict(data)
    assert job["fps"] == 24.0
    assert job["start"] == pytest.approx(11 / 24)
    still = job["body"][0].astype(np.float64)
    for k, posed in enumerate(job["body"]):  # Bezier keys: only the ends are known
        if k in (0, 5):
            np.testing.assert_allclose(posed, Rotation.from_rotvec([0.5 * k / 5, 0, 0]).apply(still), atol=1e-5)
    assert len(np.unique(job["body"].reshape(6, -1), axis=0)) == 6, "frames that are the same"
    radius = np.hypot(job["first"][:, 0], job["first"][:, 2])
    np.testing.assert_allclose(radius, 0.2, atol=1e-6)  # 2 units of a decimetre, about Y
    np.testing.assert_array_equal(job["pins"], np.arange(16))
    garment = wg.Garment(job["rest"], job["faces"], pins=job["pins"], name="tube")
    body = wg.BodyMotion(job["body"], job["body_faces"], 24.0, start=11 / 24)
    assert np.einsum("fi,fi->f", garment.face_frames[:, :, 2], garment.vertices[garment.faces].mean(1)).mean() > 0
    made = simulator(checkpoint.load(trained / "n.safetensors"))
    wanted = made.rollout(garment, body, first_vertices=job["first"], out_fps="body")
    with np.load(trained / "result.npz") as data:
        np.testing.assert_array_equal(data["vertices"], wanted.vertices)
    with np.load(trained / "shown.npz") as data:
        x, y, z = np.moveaxis(data["frames"], 2, 0)
    np.testing.assert_allclose(np.stack([x, z, -y], 2), 10.0 * wanted.vertices.astype(np.float64), atol=1e-5)
    assert np.abs(wanted.vertices[-1] - wanted.vertices[0]).max() > 1e-3, "it moves"


@needs_blender
def test_modifiers_progress_and_the_frame(trained: Path) -> None:
    """Modifiers would be applied twice, or stay off; Blender would freeze, or say nothing of how far it is.

    While the subprocess works, a step takes less than 0.2 s of a processor (it only looks at a file).
    """
    said = _blender(trained, lift=2.0)
    assert said["after"] == {"warpgarment": True, "shift": False, "lift": False, "smooth": False}
    assert said["removed"] == {"shift": True, "lift": True, "smooth": False}
    assert said["longest"] < 0.2
    assert any(word.startswith("reading frame") for word in said["words"])
    assert any(word.startswith("frame ") for word in said["words"]), said["words"][-5:]
    assert said["status"] == "6 frames in tube.pc2"
    assert not said["running"]
    with np.load(trained / "job.npz") as data:  # 2 units of the object, a quarter of a unit each, in decimetres
        np.testing.assert_allclose(
            data["first"] - data["rest"], np.broadcast_to([0, 0.05, 0], data["rest"].shape), atol=1e-6
        )


@needs_blender
@pytest.mark.parametrize(
    ("told", "before", "message"),
    [
        ({"network": "nowhere"}, "", "CheckpointError"),
        ({"python": "/nowhere/python"}, "", "There is no Python at /nowhere/python"),
        ({"python": ""}, "", "Name a Python that has warpgarment"),
        ({}, "settings.pins = 'waist'", "has no vertex group 'waist'"),
        ({}, "body.select_set(False)", "0 meshes are selected besides the garment"),
        ({}, "garment.modifiers.move(2, 0)", ""),
        ({"python": str(PYTHON)}, "", "has no warpgarment. Install it there"),
    ],
)
def test_errors_are_told_in_blender(trained: Path, told: dict, before: str, message: str) -> None:
    """An error would be seen in a terminal alone, or an old result be shown as a new one."""
    said = _blender(trained, f"{before}\n{RUN}", **told)
    if not message:  # the garment's own vertices are taken before the modifier that adds some
        assert said["said"] == ["FINISHED"], said
        return
    assert said["said"][0] == "ERROR", said
    assert message in said["said"][1]
    assert message in said["status"]
    assert not said["running"]
    assert "warpgarment" not in said["after"]
    assert not (trained / "tube.pc2").exists()


MODAL = """
from types import SimpleNamespace

from warpgarment_blender import ui

class Window:  # bpy as a module has none
    timers = handlers = 0
    def event_timer_add(self, every, window):
        self.timers += 1
        return "timer"
    def event_timer_remove(self, timer):
        self.timers -= 1
    def modal_handler_add(self, operator):
        self.handlers += 1

kind = ui.WARPGARMENT_OT_simulate
report = lambda kind, text: told.setdefault("report", []).append(text)
operator = SimpleNamespace(_task=None, _timer=None, _frame=0, report=report)
for name in ("_begin", "_step", "_end"):
    setattr(operator, name, getattr(kind, name).__get__(operator))
window = Window()
context = SimpleNamespace(scene=scene, view_layer=bpy.context.view_layer, preferences=bpy.context.preferences,
                          window_manager=window, window=None, screen=None)
scene.frame_set(13)
said = [sorted(kind.invoke(operator, context, None))]
running = settings.running
said.append(sorted(kind.modal(operator, context, SimpleNamespace(type="MOUSEMOVE"))))
longest, steps = 0.0, 0
while True:
    began = time.process_time()
    result = kind.modal(operator, context, SimpleNamespace(type="TIMER"))
    longest, steps = max(longest, time.process_time() - began), steps + 1
    if result != {"PASS_THROUGH"}:
        break
    time.sleep(0.02)
print(json.dumps({"said": [*said, sorted(result)], "running": [running, settings.running], "longest": longest,
                  "steps": steps, "timers": window.timers, "handlers": window.handlers, "report": told["report"],
                  "frame": scene.frame_current}))
"""


@needs_blender
def test_blender_is_not_held_up(trained: Path) -> None:
    """Blender would freeze while it waits, swallow clicks, keep a timer, or be left in another frame.

    No ring of the timer takes more than 0.3 s of a processor; the simulation alone takes longer than all of them.
    """
    said = _blender(trained, MODAL)
    assert said["said"] == [["RUNNING_MODAL"], ["PASS_THROUGH"], ["FINISHED"]]
    assert said["running"] == [True, False]
    assert (said["timers"], said["handlers"]) == (0, 1)
    assert said["steps"] > 5
    assert said["longest"] < 0.3
    assert said["frame"] == 13
    assert said["report"][-1] == "warpgarment: 6 frames in tube.pc2"


STOP = """
from warpgarment_blender import ui

task = ui.started(bpy.context)
while task._process is None:
    task.step()
process, folder = task._process, task._folder
task.close()
print(json.dumps({"ended": process.poll() is not None, "folder": folder.exists(), "finished": task.finished}))
"""


@needs_blender
def test_stopping_leaves_nothing_behind(trained: Path) -> None:
    """A stopped simulation would go on in the background, or leave its files."""
    assert _blender(trained, STOP) == {"ended": True, "folder": False, "finished": True}


def test_the_library_and_blender_do_not_meet() -> None:
    """Blender's licence would come into this library, or the add-on need it in Blender's own Python."""
    for file in ADDON.glob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        top = [n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)]
        names = {alias.name.partition(".")[0] for n in top if isinstance(n, ast.Import) for alias in n.names}
        names |= {str(n.module).partition(".")[0] for n in top if isinstance(n, ast.ImportFrom) and not n.level}
        assert names - set(sys.stdlib_module_names) <= {"bpy", "numpy"}
    assert "bpy" not in (ADDON / "worker.py").read_text(encoding="utf-8")
    assert "bpy" not in sys.modules
