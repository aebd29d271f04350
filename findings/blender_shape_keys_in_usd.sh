#!/usr/bin/env bash
# Blender to USD: a mesh animated by shape keys leaves without animated points
#
# Expected: export_animation=True writes what is seen, one sample of points a frame, as Blender's Alembic export does.
# Seen:     shape keys become UsdSkel blend shapes: points hold the basis shape, once, and a skeleton with one joint,
#           which the scene does not have, carries weights over time. Whoever reads points (most importers of geometry)
#           gets a still cloth. UsdSkel.BakeSkinning turns it into points again.
# Versions: bpy 4.5.15, usd-core 26.11, numpy 1.26.4.
# So:       export with export_shapekeys=False, or drive the mesh by a cache modifier instead. A reader that meets a
#           SkelBindingAPI should bake or refuse.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check bpy==4.5.15 usd-core==26.11 numpy==1.26.4
cat >"$work/show.py" <<'PY'
import json
import subprocess
import sys

FRAMES = 5


def export(path, shape_keys):
    """A triangle that is k metres up at frame k, by shape keys."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    mesh = bpy.data.meshes.new("cloth")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    cloth = bpy.data.objects.new("cloth", mesh)
    scene.collection.objects.link(cloth)
    cloth.shape_key_add(name="rest")
    for k in range(1, FRAMES + 1):
        key = cloth.shape_key_add(name=f"frame{k}")
        for corner in key.data:
            corner.co.z += k
        for frame, value in ((k - 1, 0.0), (k, 1.0), (k + 1, 0.0)):
            key.value = value
            key.keyframe_insert("value", frame=frame)
    bpy.ops.wm.usd_export(filepath=path, export_animation=True, **json.loads(shape_keys))


def read(path):
    """Times and heights of the points as they are, whether they are bound to a skeleton, and the same after baking."""
    from pxr import Gf, Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.Open(path)
    find = lambda: next(UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    heights = lambda a: [a.Get(t)[0][2] for t in range(1, FRAMES + 1)]
    points = find().GetPointsAttr()
    before, bound = [points.GetTimeSamples(), heights(points)], find().GetPrim().HasAPI(UsdSkel.BindingAPI)
    if bound:
        for root in [p for p in stage.Traverse() if p.IsA(UsdSkel.Root)]:
            UsdSkel.BakeSkinning(UsdSkel.Root(root), Gf.Interval(1, FRAMES))
    points = find().GetPointsAttr()
    print(json.dumps([*before, bound, heights(points)]))


if sys.argv[1:]:  # one library a process: Blender brings its own USD
    getattr(sys.modules[__name__], sys.argv[1])(*sys.argv[2:])
    sys.exit()
call = lambda *words: (
    subprocess.run([sys.executable, "show.py", *words], check=True, capture_output=True, text=True).stdout
)
seen = {}
for name, keys in (("usual", "{}"), ("without", '{"export_shapekeys": false}')):
    call("export", f"{name}.usda", keys)
    seen[name] = json.loads(call("read", f"{name}.usda").splitlines()[-1])
show = lambda row: f"points sampled at {row[0] or 'no time'}, heights {row[1]}, bound to a skeleton: {row[2]}"
print("expected:", show([[1.0, 2.0, 3.0, 4.0, 5.0], [1.0, 2.0, 3.0, 4.0, 5.0], False]))
print("seen:    ", show(seen["usual"]), "; baked:", seen["usual"][3])
print("with export_shapekeys=False:", show(seen["without"]))
rising = [float(k) for k in range(1, FRAMES + 1)]
still = seen["usual"] == [[], [0.0] * FRAMES, True, rising] and seen["without"][1:3] == [rising, False]
sys.exit(0 if still else "no longer so: shape keys leave as points")
PY
cd "$work"
"$work/venv/bin/python" show.py
