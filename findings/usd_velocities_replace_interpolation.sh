#!/usr/bin/env bash
# USD: once a cache has velocities, points between its samples are no longer between its points
#
# Expected: velocities are for motion blur. Halfway between two samples UsdGeom.PointBased.ComputePointsAtTime gives the
#           mean of the two, as reading the points attribute does.
# Seen:     it takes the sample before and moves it along its velocity, in units a second, and never looks at the sample
#           after: with velocities per frame instead of per second the cloth stands still and then jumps; with right
#           ones it still jumps at every sample of a motion that is not straight. Points.Get interpolates on: two
#           positions of one mesh at one time, depending on who asks. Past the last sample the cloth flies on.
# Versions: usd-core 26.11.
# So:       leave velocities out of garment caches that are played between frames, or write them per second, at the same
#           times as the points (else they are ignored with a warning), and export every frame that is rendered.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check usd-core==26.11
cat >"$work/show.py" <<'PY'
import math
import sys

from pxr import Gf, Usd, UsdGeom


def cloth(velocity=None, offset=0):
    """One point that swings, sampled at 24 codes a second every 12; velocity [units/s] as a function of seconds."""
    stage = Usd.Stage.CreateInMemory()
    stage.SetTimeCodesPerSecond(24)
    mesh = UsdGeom.Mesh.Define(stage, "/cloth")
    for code in range(0, 49, 12):
        mesh.GetPointsAttr().Set([Gf.Vec3f(0, 0, math.sin(code / 24))], code)
        if velocity:
            mesh.GetVelocitiesAttr().Set([Gf.Vec3f(0, 0, velocity(code / 24))], code + offset)
    return stage, mesh


def heights(velocity=None, offset=0):
    stage, mesh = cloth(velocity, offset)
    at = (0.0, 6.0, 11.99, 12.0, 60.0)
    computed = [mesh.ComputePointsAtTime(t, t)[0][2] for t in at]
    read = [mesh.GetPointsAttr().Get(t)[0][2] for t in at]
    return computed, read


show = lambda values: " ".join(f"{v:7.4f}" for v in values)
rows = {
    "no velocities": heights(),
    "velocities per second": heights(math.cos),
    "velocities per frame": heights(lambda s: math.cos(s) / 24),
    "per second, at other times": heights(math.cos, offset=1),
}
print("heights at codes            0       6   11.99      12      60 (samples at 0, 12, ... 48)")
print(f"expected:               {show(rows['no velocities'][1])}")
for name, (computed, read) in rows.items():
    print(f"seen: {name:26}{show(computed)}   points.Get: {show(read)}")
plain = rows["no velocities"][1]
near = lambda a, b: all(abs(x - y) < 1e-5 for x, y in zip(a, b, strict=True))
jumps = {name: abs(computed[3] - computed[2]) for name, (computed, _) in rows.items()}
still = all(near(read, plain) for _, read in rows.values()) and near(rows["no velocities"][0], plain)
still &= jumps["velocities per second"] > 0.01 and jumps["velocities per frame"] > 0.4 and jumps["no velocities"] < 1e-3
still &= abs(rows["velocities per second"][0][4] - plain[4]) > 0.1 and near(
    rows["per second, at other times"][0], plain
)
sys.exit(0 if still else "no longer so: points are interpolated whether or not there are velocities")
PY
cd "$work"
"$work/venv/bin/python" show.py
