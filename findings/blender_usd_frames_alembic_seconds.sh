#!/usr/bin/env bash
# Blender: the same second of cloth takes 2.5 s from USD and 1 s from Alembic, and Alembic comes in inside out
#
# Expected: a cache of 61 samples at 60 a second, imported into a new scene (24 frames a second), plays for one second
#           from either format, faces outward.
# Seen:     the USD importer maps time codes to frame numbers and leaves the scene's rate alone: frames 0 to 60, 2.5 s,
#           though the stage says 60 codes a second. The Alembic importer maps seconds: frames 0 to 24. The Alembic
#           triangle, written counter-clockwise, has its normal on the other side: Alembic's order is clockwise, which
#           the file does not say. Nor does it say the axis: Y up is assumed.
# Versions: bpy 4.5.15, usd-core 26.11, alembic3d 1.8.12.1, numpy 1.26.4.
# So:       set the scene's rate to timeCodesPerSecond before or after a USD import. Reverse every polygon (and per-
#           corner data with it) when writing Alembic.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check \
  bpy==4.5.15 usd-core==26.11 alembic3d==1.8.12.1 numpy==1.26.4
cat >"$work/show.py" <<'PY'
import json
import math
import subprocess
import sys


def write_usd():
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew("cloth.usda")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(60)
    stage.SetFramesPerSecond(60)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(60)
    mesh = UsdGeom.Mesh.Define(stage, "/cloth")
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreateSubdivisionSchemeAttr("none")
    for k in range(61):
        mesh.GetPointsAttr().Set([Gf.Vec3f(0, 0, k / 60), Gf.Vec3f(1, 0, k / 60), Gf.Vec3f(0, 1, k / 60)], k)
    stage.SetDefaultPrim(mesh.GetPrim())
    stage.Save()


def write_alembic():
    import imath
    from alembic3d import Abc, AbcCoreAbstract, AbcGeom

    def filled(array, values):
        for i, value in enumerate(values):
            array[i] = value
        return array

    archive = Abc.OArchive("cloth.abc")
    schema = AbcGeom.OPolyMesh(archive.getTop(), "cloth").getSchema()
    schema.setTimeSampling(archive.addTimeSampling(AbcCoreAbstract.TimeSampling(1 / 60, 0.0)))
    for k in range(61):
        corners = [imath.V3f(x, y, k / 60) for x, y in ((0, 0), (1, 0), (0, 1))]
        face = filled(imath.IntArray(3), (0, 1, 2)), filled(imath.IntArray(1), (3,))
        schema.set(AbcGeom.OPolyMeshSchemaSample(filled(imath.V3fArray(3), corners), *face))


def play(path):
    """Range in frames, and the sample [s] and the world normal at frame 12, that is at half a second."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    (bpy.ops.wm.usd_import if path.endswith("usda") else bpy.ops.wm.alembic_import)(filepath=path, set_frame_range=True)
    cloth = next(o for o in scene.objects if o.type == "MESH")
    scene.frame_set(12)
    shown = cloth.evaluated_get(bpy.context.evaluated_depsgraph_get())
    a, b, c = (shown.matrix_world @ shown.data.vertices[i].co for i in shown.data.polygons[0].vertices)
    normal, first = (b - a).cross(c - a).normalized(), shown.matrix_world @ shown.data.vertices[0].co
    print(json.dumps([scene.render.fps, scene.frame_end - scene.frame_start, -first.y, [round(x) for x in normal]]))


if sys.argv[1:]:  # one library a process: Blender brings its own USD
    getattr(sys.modules[__name__], sys.argv[1])(*sys.argv[2:])
    sys.exit()
call = lambda *words: (
    subprocess.run([sys.executable, "show.py", *words], check=True, capture_output=True, text=True).stdout
)
call("write_usd")
call("write_alembic")
seen = {name: json.loads(call("play", f"cloth.{name}").splitlines()[-1]) for name in ("usda", "abc")}
print("expected: 1 s, at half of it the sample at 0.5 s, normal [0, -1, 0] (up, toward the viewer), from both")
for name, (rate, frames, height, normal) in seen.items():
    print(
        f"seen:     {name:4} {frames} frames at {rate} a second, {frames / rate:.1f} s;",
        f"at 0.5 s the sample at {height:.2f} s, normal {normal}",
    )
usd, abc = seen["usda"], seen["abc"]
still = usd[:2] == [24, 60] and math.isclose(usd[2], 0.2, abs_tol=1e-3) and usd[3] == [0, -1, 0]
still &= abc[:2] == [24, 24] and math.isclose(abc[2], 0.5, abs_tol=1e-3) and abc[3] == [0, 1, 0]
sys.exit(0 if still else "no longer so: both importers keep seconds, or sides")
PY
cd "$work"
"$work/venv/bin/python" show.py
