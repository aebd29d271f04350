#!/usr/bin/env bash
# Alembic for Python: ISampleSelector(3) asks for the third second, getValue(3) for the third sample
#
# Expected: a selector made from the integer 3 requests sample 3: the C++ library has an overload for indices, the
#           binding lists one that takes an int "requested index", and getValue(3) does just that.
# Seen:     the overload for times wins: the selector holds time 3.0 and no index, and a cache at 24 frames a second
#           answers with the sample nearest below 3 s. Past the end it answers with the last sample, so a short test
#           clip gives a still pose rather than an error.
# Versions: alembic3d 1.8.12.1 (the C++ library's own Python binding, Alembic 1.8.12).
# So:       pass the plain integer to getValue, or a selector from the sample's time plus half a frame.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check alembic3d==1.8.12.1
cat >"$work/show.py" <<'PY'
import gc
import sys

import imath
from alembic3d import Abc, AbcCoreAbstract, AbcGeom


def points(z):
    array = imath.V3fArray(3)
    for i, (x, y) in enumerate(((0, 0), (1, 0), (0, 1))):
        array[i] = imath.V3f(x, y, z)
    return array


def integers(values):
    array = imath.IntArray(len(values))
    for i, value in enumerate(values):
        array[i] = value
    return array


def write(path, count):
    """A triangle whose height is the number of the sample, at 24 samples a second from time 0."""
    archive = Abc.OArchive(path)
    schema = AbcGeom.OPolyMesh(archive.getTop(), "cloth").getSchema()
    schema.setTimeSampling(archive.addTimeSampling(AbcCoreAbstract.TimeSampling(1 / 24, 0.0)))
    for k in range(count):
        schema.set(AbcGeom.OPolyMeshSchemaSample(points(k), integers([0, 1, 2]), integers([3])))


def read(path, selector):
    schema = AbcGeom.IPolyMesh(Abc.IArchive(path).getTop(), "cloth").getSchema()
    return round(schema.getValue(selector).getPositions()[0].z)


write("long.abc", 200)
write("short.abc", 10)
gc.collect()  # closes the files
selector = Abc.ISampleSelector(3)
print(Abc.GetLibraryVersion())
print("expected: sample 3 from getValue(3) and from getValue(ISampleSelector(3))")
answers = read("long.abc", 3), read("long.abc", selector), read("short.abc", selector)
print(f"seen:     sample {answers[0]} and sample {answers[1]} (in a file of 10 samples: {answers[2]})")
print(f"          the selector holds index {selector.getRequestedIndex()}, time {selector.getRequestedTime()}")
still = answers[0] == 3 and answers[1] in (71, 72) and answers[2] == 9 and selector.getRequestedTime() == 3.0
sys.exit(0 if still else "no longer so: an integer selects a sample")
PY
cd "$work"
"$work/venv/bin/python" show.py
