#!/usr/bin/env bash
# USD: a sublayer's frames are converted to the shot's rate, its metres, axis and range are not
#
# Expected: a cloth cache in metres, Z up, 30 codes a second, used as a sublayer or a reference of a new shot, either
#           comes over as it was meant or as it was written.
# Seen:     half of each. Sample times are rescaled from 30 to 24 codes a second (30 becomes 24), silently;
#           metersPerUnit falls back to 0.01 and upAxis to Y, with the points untouched, so the cloth is a hundredth of
#           its size and lies on its back; start and end are 0. metersPerUnit and upAxis are never composed, only read
#           at the root.
# Versions: usd-core 26.11.
# So:       write the same metres, axis, rate and range into the shot as in the cache, and compare them when a stage is
#           put together. A reader that multiplies by the stage's metersPerUnit is wrong for anything below the root.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check usd-core==26.11
cat >"$work/show.py" <<'PY'
import sys

from pxr import Gf, Usd, UsdGeom

cache = Usd.Stage.CreateNew("cloth.usda")
UsdGeom.SetStageUpAxis(cache, UsdGeom.Tokens.z)
UsdGeom.SetStageMetersPerUnit(cache, 1.0)
cache.SetTimeCodesPerSecond(30)
cache.SetStartTimeCode(0)
cache.SetEndTimeCode(60)
cloth = UsdGeom.Mesh.Define(cache, "/cloth")
for second in range(3):
    cloth.GetPointsAttr().Set([Gf.Vec3f(0, 0, second)], 30 * second)
cache.SetDefaultPrim(cloth.GetPrim())
cache.Save()


def shot(kind):
    stage = Usd.Stage.CreateNew(f"{kind}.usda")
    if kind == "sublayer":
        stage.GetRootLayer().subLayerPaths.append("cloth.usda")
    else:
        stage.DefinePrim("/cloth").GetReferences().AddReference("cloth.usda")
    stage.Save()
    return Usd.Stage.Open(f"{kind}.usda")


def facts(stage):
    points = UsdGeom.Mesh.Get(stage, "/cloth").GetPointsAttr()
    times = points.GetTimeSamples()
    length = UsdGeom.GetStageMetersPerUnit(stage)
    return (times, points.Get(times[-1])[0][2], length, str(UsdGeom.GetStageUpAxis(stage)), stage.GetEndTimeCode())


row = "{:10} samples {}, height {:.0f} units of {} m, {} up, ends at {:.0f}"
written = facts(Usd.Stage.Open("cloth.usda"))
print("expected:", row.format("cache", *written))
used = {kind: facts(shot(kind)) for kind in ("sublayer", "reference")}
for kind, answer in used.items():
    print("seen:    ", row.format(kind, *answer))
still = written == ([0.0, 30.0, 60.0], 2.0, 1.0, "Z", 60.0)
still &= all(answer == ([0.0, 24.0, 48.0], 2.0, 0.01, "Y", 0.0) for answer in used.values())
sys.exit(0 if still else "no longer so: times, units, axis and range are treated alike")
PY
cd "$work"
"$work/venv/bin/python" show.py
