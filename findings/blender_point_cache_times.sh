#!/usr/bin/env bash
# Blender: point caches are played by counting frames; their own times are ignored, or divided where they should
# multiply
#
# Expected: the Mesh Cache modifier reads what a PC2 header says (start frame, sampling rate in frames) and what an MDD
#           file says (the time of every sample), at the latest when its time mode is "Time".
# Seen:     in the usual frame mode sample k is shown at frame k, whatever the header says. In time mode an MDD file is
#           right at last, but a PC2 file nearly stands still: after one second it is at sample 1/24 where 24 is meant,
#           and with half a frame of sampling at 1/12 where 48 is. A start frame of 10 gives sample 0 for a very long
#           time.
# Versions: bpy 4.5.15, numpy 1.26.4.
# So:       write one sample a frame from frame 0, at the rate of the scene, into PC2 and MDD, or shift and scale with
#           the modifier's frame_start and frame_scale. Do not use time mode for PC2.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check bpy==4.5.15 numpy==1.26.4
cat >"$work/show.py" <<'PY'
import os
import struct
import sys

import bpy
import numpy as np

SAMPLES = 100
corners = [np.array([[0, 0, k], [1, 0, k], [0, 1, k]]) for k in range(SAMPLES)]


def pc2(path, start, sampling):
    with open(path, "wb") as file:
        file.write(struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 3, start, sampling, SAMPLES))
        file.writelines(c.astype("<f4").tobytes() for c in corners)


def mdd(path, step):
    with open(path, "wb") as file:
        file.write(struct.pack(">ii", SAMPLES, 3))
        file.write((step * np.arange(SAMPLES)).astype(">f4").tobytes())
        file.writelines(c.astype(">f4").tobytes() for c in corners)


def sample_at(path, kind, mode):
    """The (fractional) sample that is shown at frame 24 of a scene at 24 frames a second, that is after one second."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    mesh = bpy.data.meshes.new("cloth")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    cloth = bpy.data.objects.new("cloth", mesh)
    scene.collection.objects.link(cloth)
    cache = cloth.modifiers.new("cache", "MESH_CACHE")
    cache.cache_format, cache.filepath, cache.time_mode = kind, os.path.abspath(path), mode
    cache.forward_axis, cache.up_axis = "POS_Y", "POS_Z"
    scene.frame_set(24)
    return cloth.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.vertices[0].co.z


pc2("plain.pc2", 0.0, 1.0)
pc2("late.pc2", 10.0, 1.0)
pc2("dense.pc2", 0.0, 0.5)
mdd("fast.mdd", 1 / 60)
mdd("slow.mdd", 1 / 12)
print("bpy", bpy.app.version_string, "- samples at frame 24, one second")
rows = (("plain.pc2", 24), ("late.pc2", 14), ("dense.pc2", 48), ("fast.mdd", 60), ("slow.mdd", 12))
still = True
for path, expected in rows:
    by_frame, by_time = (sample_at(path, path[-3:].upper(), mode) for mode in ("FRAME", "TIME"))
    print(f"{path:10} expected {expected:3}; seen {by_frame:6.2f} in frame mode, {by_time:6.3f} in time mode")
    still &= abs(by_frame - 24) < 1e-3
    still &= abs(by_time - expected) < 0.1 if path.endswith("mdd") else by_time < 0.2
sys.exit(0 if still else "no longer so: the times in point caches are read")
PY
cd "$work"
"$work/venv/bin/python" show.py
