"""If these failed, Blender would show other cloth than was simulated: each frame of its caches, as Blender has it.

Blender is another program (`$WARPGARMENT_BLENDER` names its Python, which has `bpy`); where it is not set, these tests
are skipped.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.scenes import skirt

import warpgarment as wg

NAMED = os.environ.get("WARPGARMENT_BLENDER", "")
PYTHON = next((p for p in (Path(NAMED) / "bin" / "python", Path(NAMED)) if NAMED and p.is_file()), None)
pytestmark = pytest.mark.skipif(PYTHON is None, reason="$WARPGARMENT_BLENDER names no Python with bpy")

SCRIPT = """
import sys

import bpy
import numpy as np

path, mesh, out, first, count = *sys.argv[1:4], int(sys.argv[4]), int(sys.argv[5])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = 24
if path.endswith(".abc"):
    bpy.ops.wm.alembic_import(filepath=path, set_frame_range=True)
    first, count = scene.frame_start, scene.frame_end - scene.frame_start + 1
    cloth = next(o for o in scene.objects if o.type == "MESH")
else:
    with np.load(mesh) as held:
        data = bpy.data.meshes.new("cloth")
        data.from_pydata(held["vertices"].tolist(), [], held["faces"].tolist())
    cloth = bpy.data.objects.new("cloth", data)
    scene.collection.objects.link(cloth)
    cache = cloth.modifiers.new("cache", "MESH_CACHE")
    cache.cache_format, cache.filepath, cache.frame_start, cache.interpolation = path[-3:].upper(), path, first, "NONE"
frames = []
for frame in range(first, first + count):
    scene.frame_set(frame)
    shown = cloth.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.empty(3 * len(shown.data.vertices), np.float32)
    shown.data.vertices.foreach_get("co", points)
    world = np.array(shown.matrix_world, np.float64)
    frames.append(points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
normals = np.empty(3 * len(shown.data.polygons), np.float32)
shown.data.polygons.foreach_get("normal", normals)
normals = normals.reshape(-1, 3) @ world[:3, :3].T
np.savez(out, frames=frames, normals=normals, first=first)
"""


@pytest.mark.parametrize("name", ["m.abc", "m.mdd", "m.pc2"])
def test_blender_shows_every_frame(tmp_path, name):
    """To 1e-6 m, at the frames of the shot (Alembic: 1001 to 1007 at 24 a second, Z up), and with the same outside."""
    garment = skirt()
    noise = np.random.default_rng(0).normal(0, 0.01, (7, *garment.vertices.shape))
    frames = (garment.vertices + noise).astype(np.float32)
    wg.GarmentMotion(frames, garment.faces, 24, start=1001 / 24).save(tmp_path / name)
    np.savez(tmp_path / "mesh.npz", vertices=frames[0], faces=garment.faces)
    (tmp_path / "show.py").write_text(SCRIPT)
    words = [tmp_path / name, tmp_path / "mesh.npz", tmp_path / "out.npz", 1001, 7]
    ran = subprocess.run([PYTHON, tmp_path / "show.py", *map(str, words)], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr[-2000:]
    with np.load(tmp_path / "out.npz") as found:
        shown, normals, first = found["frames"], found["normals"], int(found["first"])
    if name == "m.abc":  # Blender's importer turns Y up into Z up
        shown, normals = (np.stack([a[..., 0], a[..., 2], -a[..., 1]], axis=-1) for a in (shown, normals))
    assert (first, len(shown)) == (1001, 7)
    np.testing.assert_allclose(shown, frames, atol=1e-6)
    a, b, c = (frames[-1][garment.faces[:, k]].astype(float) for k in range(3))
    expected = np.cross(b - a, c - a)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", normals, expected).min() > 0.999
