#!/usr/bin/env bash
# Newton: a mesh of a USD file in centimetres is in metres or a hundred times as large, by how it is asked for
#
# Expected: newton.usd.get_mesh(source, apply_stage_units=True), the default, gives metres for every kind of source.
# Seen:     of a stage or a path it does, of the mesh's own prim, which is what Newton's examples pass, it gives the
#           file's numbers. Where the file has no metersPerUnit, whose fallback in USD is 0.01, a stage is taken for
#           metres, too: unisex_shirt.usd, which ships with Newton, is 65 m wide either way. Nothing is said.
# Versions: newton 1.8.0, warp-lang 1.19.0, usd-core 26.11, numpy 2.4.6.
# So:       multiply by UsdGeom.GetStageMetersPerUnit yourself where you pass a prim, and look at the size of what came.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check newton==1.8.0 warp-lang==1.19.0 usd-core==26.11 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys

import newton
import newton.examples
import newton.usd
import numpy as np
import warp as wp
from pxr import Usd, UsdGeom

wp.config.log_level = wp.LOG_ERROR


def width(source, **options):
    return float(np.ptp(newton.usd.get_mesh(source, **options).vertices[:, 0]))


def square(authored):
    """A square of 50 cm, and its prim."""
    stage = Usd.Stage.CreateInMemory()
    if authored:
        UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    mesh = UsdGeom.Mesh.Define(stage, "/square")
    mesh.CreatePointsAttr([(0, 0, 0), (50, 0, 0), (50, 50, 0), (0, 50, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    return stage, mesh.GetPrim()


print("newton", newton.__version__, "usd", Usd.GetVersion())
stage, prim = square(True)
found = [width(stage), width(prim, apply_stage_units=True)]
print(f"metersPerUnit = 0.01 in the file: expected 0.5 and 0.5; seen {found[0]:g} of the stage, {found[1]:g} of the prim")
stage, prim = square(False)
bare = [UsdGeom.GetStageMetersPerUnit(stage), width(stage), width(prim)]
print(f"none in the file: USD says {bare[0]:g}; seen {bare[1]:g} of the stage, {bare[2]:g} of the prim")
shirt = width(str(newton.examples.get_asset("unisex_shirt.usd")))
print(f"unisex_shirt.usd: {shirt:.1f}")
same = np.allclose(found, [0.5, 50.0]) and np.allclose(bare, [0.01, 50.0, 50.0]) and 60.0 < shirt < 70.0
sys.exit(0 if same else "this has changed")
PY
"$work/venv/bin/python" "$work/show.py"
