"""Blender's cloth as a teacher: a subprocess with `bpy`, in an environment of its own, that sends its frames back.

All cloths of a scene become one mesh, so that layers collide as a cloth does with itself; D-LAYERS was made that way.
The SI quantities of a scene are converted to Blender's numbers in `units.py`, whose docstring also lists what Blender
cannot express.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np

from warpgarment.io.npz import write_npz
from warpgarment.io.pc2 import write_pc2_to
from warpgarment.training.teachers import ClothScene, TeacherError
from warpgarment.training.teachers.scenes import check_scenes, used_body

from .environment import find_environment, version_of
from .units import LAYERED, BlenderSettings, blender_numbers, pin_path, to_y_up, to_z_up

SCRIPT = Path(__file__).with_name("script.py")
MAGIC = b"warpgarment-frames 1\n"
LAST_WORDS = 2000  # number of characters of Blender's last output that an error quotes


class BlenderTeacher:
    """Simulates cloth with Blender.

    Args:
        settings: Settings of the simulation; None for the defaults.
        environment: Virtual environment with bpy, or its Python; None for the result of
            :func:`.environment.find_environment`.
        script: Script that Blender's Python runs.

    Raises:
        TeacherError: There is no such Python; the message names the command that makes one.
    """

    name = "blender"

    def __init__(
        self,
        settings: BlenderSettings | None = None,
        environment: str | Path | None = None,
        *,
        script: str | Path = SCRIPT,
    ):
        self._settings = settings or BlenderSettings()
        self._python = find_environment(environment)
        self._script = Path(script)

    def settings(self) -> dict[str, Any]:
        """Settings and version, for a manifest."""
        return {"teacher": self.name, "bpy": version_of(self._python), **asdict(self._settings)}

    def simulate(self, scene: ClothScene) -> Iterator[np.ndarray]:
        """Yields T frames [m], float32 [V, 3], Y up; see :class:`.Teacher`. Leaving the loop ends Blender."""
        with self._running(scene) as frames:
            yield from frames

    def simulate_many(self, scenes: list[ClothScene]) -> Iterator[list[np.ndarray | None]]:
        """Several scenes at the same time, each in a process of its own; see :class:`.Teacher`."""
        with contextlib.ExitStack() as stack:
            running = [stack.enter_context(self._running(scene)) for scene in scenes]
            for _ in range(max(map(len, scenes), default=0)):
                yield [next(frames, None) for frames in running]

    @contextlib.contextmanager
    def _running(self, scene: ClothScene) -> Iterator[Iterator[np.ndarray]]:
        """Context with the frames of a scene; at its end, Blender is stopped and its files are removed."""
        check_scenes([scene])
        if scene.goes_on:
            raise TeacherError("Blender cannot go on from given velocities. Take another teacher.")
        with tempfile.TemporaryDirectory(prefix="warpgarment-blender-") as name:
            folder = Path(name)
            write_scene(folder, scene, self._settings)
            with open(folder / "errors.txt", "w+b") as errors:
                command = [str(self._python), "-I", str(self._script), str(folder)]
                child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors)
                try:
                    yield self._frames(scene, child, errors)
                finally:
                    child.kill()
                    child.communicate()

    def _frames(self, scene: ClothScene, child: subprocess.Popen, errors: IO[bytes]) -> Iterator[np.ndarray]:
        pipe, size = child.stdout, 12 * int(scene.starts[-1])
        assert pipe is not None
        if pipe.read(len(MAGIC)) != MAGIC:
            raise _failed(child, errors, "did not begin")
        for number in range(len(scene)):
            if pipe.read(4) != size.to_bytes(4, "little") or len(block := pipe.read(size)) != size:
                raise _failed(child, errors, f"ended before frame {number} of {len(scene):,}")
            vertices = np.frombuffer(block, dtype="<f4").reshape(-1, 3)
            yield (to_y_up(vertices) / np.float32(self._settings.scale)).astype(np.float32)


def write_scene(folder: Path, scene: ClothScene, settings: BlenderSettings) -> None:
    """Writes the files that the script reads: scene.json, scene.npz, body.pc2 and pins.pc2; see `script.py`.

    Args:
        folder: Folder of the files.
        scene: Scene to simulate.
        settings: Settings of the simulation.
    """
    numbers, arrays = blender_numbers(scene, settings)
    first = np.concatenate([cloth.first for cloth in scene.cloths])
    body, body_faces = used_body(scene)

    def placed(points: np.ndarray) -> np.ndarray:
        return (to_z_up(points.astype(np.float64)) * settings.scale).astype(np.float32)

    def write_path(name: str, frames: np.ndarray) -> None:  # the first frame is held while the cloth settles
        held = np.repeat(frames[:1], scene.settle + 1, axis=0)
        write_pc2_to(folder / name, np.concatenate([held, frames]), start=1.0)

    ends = list(zip(scene.cloths, scene.starts, strict=False))
    arrays["faces"] = np.concatenate([cloth.garment.faces + at for cloth, at in ends])
    arrays["pins"] = pins = np.concatenate([cloth.garment.pins + at for cloth, at in ends]).astype(np.int64)
    arrays["rest"] = placed(np.concatenate([cloth.garment.vertices for cloth in scene.cloths]))
    arrays["start"] = placed(first)
    if len(body_faces):
        arrays |= {"body_faces": body_faces, "body_first": placed(body[0])}
        write_path("body.pc2", placed(body))
    if len(pins) and len(body_faces):
        path = np.repeat(arrays["start"][None], len(scene), axis=0)
        path[:, pins] = placed(pin_path(first[pins], body, body_faces))
        write_path("pins.pc2", path)
    write_npz(folder / "scene.npz", arrays)
    (folder / "scene.json").write_text(json.dumps(numbers))


def _failed(child: subprocess.Popen, errors: IO[bytes], what: str) -> TeacherError:
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(timeout=5)
    errors.seek(0)
    said = errors.read().decode(errors="replace").strip()[-LAST_WORDS:]
    status = "is still running" if child.returncode is None else f"left with status {child.returncode}"
    return TeacherError(f"Blender {what} and {status}. Its last words:\n{said or '(none)'}")


def make(device: str | None) -> BlenderTeacher:
    """The teacher as `generate` uses it; see `teachers.make_teacher`. Blender's cloth runs on the CPU in any case."""
    return BlenderTeacher(LAYERED)
