"""Simulates one scene with Blender's cloth: run by Blender's own Python, `python script.py FOLDER`.

The script needs bpy and numpy and nothing of this package, so that licences and versions stay separate. FOLDER holds

    scene.json   Blender's numbers, already converted (see `units.py`)
    scene.npz    faces, start, rest, structural, bending, pins; body_faces, body_first and wind if there are any
    body.pc2     the body, one sample for every Blender frame from 1 on
    pins.pc2     the path of the pinned vertices, in these frames

with Z up and in Blender's unit of length. The result on the standard output is binary: a line with the magic word, then
for each frame its size in bytes (4 bytes, little endian) and its vertices (float32), and at the end a size of zero. The
output of Blender itself goes to the standard error.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

MAGIC = b"warpgarment-frames 1\n"


def own_output() -> IO[bytes]:
    """A stream to the standard output, for frames alone; other output, also of C code, goes to the standard error."""
    own = os.dup(1)
    os.dup2(2, 1)
    return os.fdopen(own, "wb")


@contextlib.contextmanager
def few_processors(count: int) -> Iterator[None]:
    """Limits this process to a number of processors if the system can; 0 stands for all."""
    allowed = os.sched_getaffinity(0) if count and hasattr(os, "sched_setaffinity") else None
    if allowed:
        os.sched_setaffinity(0, sorted(allowed)[:count])
    try:
        yield
    finally:
        if allowed:
            os.sched_setaffinity(0, allowed)


def simulate(folder: Path, sink: IO[bytes]) -> None:
    """Builds the scene of a folder and writes its frames to a stream as they are simulated."""
    numbers = json.loads((folder / "scene.json").read_text())
    with few_processors(numbers["threads"]):
        import bpy  # counts the available processors once, at import
    import numpy as np

    with np.load(folder / "scene.npz", allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, numbers["last_frame"]
    scene.render.fps, scene.render.fps_base = numbers["fps"], numbers["fps_base"]
    scene.use_gravity, scene.gravity = True, numbers["gravity"]
    if "body_faces" in arrays:
        add_body(bpy, folder, arrays, numbers)
    if "wind" in arrays:
        add_wind(bpy, arrays["wind"])
    cloth = add_cloth(bpy, folder, arrays, numbers)

    sink.write(MAGIC)
    for frame in range(1, numbers["last_frame"] + 1):
        scene.frame_set(frame)
        if frame < numbers["first_frame"]:
            continue
        mesh = cloth.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        vertices = np.empty(3 * len(mesh.vertices), dtype="<f4")
        mesh.vertices.foreach_get("co", vertices)
        block = vertices.tobytes()
        sink.write(len(block).to_bytes(4, "little") + block)
        sink.flush()
    sink.write((0).to_bytes(4, "little"))
    sink.flush()


def add_mesh(bpy: Any, name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """Adds an object with a triangle mesh to the scene; vertices are [V, 3], faces [F, 3]."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    mesh.update()
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(thing)
    return thing


def follow(thing: Any, path: Path) -> None:
    """Makes a mesh take its vertices from a PC2 file whose first sample is frame 1."""
    cache = thing.modifiers.new("path", "MESH_CACHE")
    cache.cache_format, cache.filepath, cache.frame_start = "PC2", str(path), 1.0


def add_body(bpy: Any, folder: Path, arrays: dict[str, np.ndarray], numbers: dict[str, Any]) -> None:
    """Adds the body, a mesh that follows its path and with which cloth collides from outside only."""
    body = add_mesh(bpy, "body", arrays["body_first"], arrays["body_faces"])
    follow(body, folder / "body.pc2")
    body.modifiers.new("collision", "COLLISION")
    for name, value in numbers["collider"].items():
        setattr(body.collision, name, value)


def add_wind(bpy: Any, wind: np.ndarray) -> None:
    """Adds a wind along its own Z axis; each row [5] has a unit direction, strength and air flow, one row per frame."""
    from mathutils import Vector

    bpy.ops.object.effector_add(type="WIND")
    fan = bpy.context.object
    fan.rotation_mode = "QUATERNION"
    fan.field.shape, fan.field.wind_factor, fan.field.noise, fan.field.falloff_power = "PLANE", 1.0, 0.0, 0.0
    for frame, (x, y, z, strength, flow) in enumerate(wind.tolist(), start=1):
        fan.rotation_quaternion = Vector((0.0, 0.0, 1.0)).rotation_difference(Vector((x, y, z)))
        fan.field.strength, fan.field.flow = strength, flow
        for path in ("rotation_quaternion", "field.strength", "field.flow"):
            fan.keyframe_insert(path, frame=frame)


def add_cloth(bpy: Any, folder: Path, arrays: dict[str, np.ndarray], numbers: dict[str, Any]) -> Any:
    """Adds all garments as one cloth, so that they collide with each other as a cloth does with itself."""
    cloth = add_mesh(bpy, "cloth", arrays["start"], arrays["faces"])
    for name in ("structural", "bending"):
        group = cloth.vertex_groups.new(name=name)
        for weight in sorted(set(arrays[name].tolist())):
            group.add((arrays[name] == weight).nonzero()[0].tolist(), weight, "REPLACE")
    if len(arrays["pins"]):
        cloth.vertex_groups.new(name="pins").add(arrays["pins"].tolist(), 1.0, "REPLACE")
    cloth.shape_key_add(name="start", from_mix=False)
    rest = cloth.shape_key_add(name="rest", from_mix=False)
    rest.data.foreach_set("co", arrays["rest"].ravel())
    if (folder / "pins.pc2").exists():
        follow(cloth, folder / "pins.pc2")

    # splits nothing, but Blender 4.5 passes the rest shape on only behind a modifier that could change the mesh's faces
    split = cloth.modifiers.new("pass on the rest shape", "EDGE_SPLIT")
    split.use_edge_angle = split.use_edge_sharp = False

    modifier = cloth.modifiers.new("cloth", "CLOTH")
    for name, value in numbers["cloth"].items():
        setattr(modifier.settings, name, value)
    for name, value in numbers["collision"].items():
        setattr(modifier.collision_settings, name, value)
    settings = modifier.settings
    settings.bending_model = "ANGULAR"
    settings.vertex_group_structural_stiffness, settings.vertex_group_bending = "structural", "bending"
    settings.rest_shape_key = rest
    if len(arrays["pins"]):
        settings.vertex_group_mass = "pins"
    modifier.point_cache.frame_start, modifier.point_cache.frame_end = 1, numbers["last_frame"]
    return cloth


if __name__ == "__main__":
    with own_output() as output:
        simulate(Path(sys.argv[1]), output)
