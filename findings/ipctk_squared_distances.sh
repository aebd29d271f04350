#!/usr/bin/env bash
# IPC Toolkit: the "minimum distance" is a squared one
#
# Expected: NormalCollisions.compute_minimum_distance of two triangles 1 cm apart is 0.01: its name and docstring speak
#           of a distance, and dhat, which build() of the same class takes, is one.
# Seen:     0.0001. point_triangle_distance is squared as well; dhat and the step of compute_collision_free_stepsize are
#           in plain lengths.
# Versions: ipctk 1.6.1, numpy 2.4.6.
# So:       a clearance logged in "metres" looks a hundred times better or worse than it is, and a comparison with dhat
#           passes when it must not: below 1 m squares are smaller. Take the root.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check ipctk==1.6.1 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys

import ipctk
import numpy as np

gap = 0.01
low = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
high = np.array([[0.3, 0.3, gap], [1.3, 0.3, 0.5], [0.3, 1.3, 0.5]])
vertices, faces = np.vstack([low, high]), np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32)
mesh = ipctk.CollisionMesh(vertices, ipctk.edges(faces), faces)
found = {}
for dhat in (0.9 * gap, 1.1 * gap):  # the range is a plain length: the pair is seen just above the gap
    collisions = ipctk.NormalCollisions()
    collisions.build(mesh, vertices, dhat)
    found[dhat] = len(collisions)
least = collisions.compute_minimum_distance(mesh, vertices)
element = ipctk.point_triangle_distance(high[0], *low)
pushed = vertices.copy()
pushed[3:, 2] -= 2.0
step = ipctk.compute_collision_free_stepsize(mesh, vertices, pushed)
print("ipctk", ipctk.__version__)
print(f"two triangles {gap} apart; pairs within dhat: {list(found.values())} at 0.9 and 1.1 of that")
print(f"expected: minimum distance {gap}")
print(f"seen:     minimum distance {least:.6f}, point_triangle_distance {element:.6f}; free step {2 * step:.4f} of 2 m")
still = (
    list(found.values()) == [0, 1]
    and np.isclose(least, gap**2)
    and np.isclose(element, gap**2)
    and 0.009 < 2 * step <= gap
)
sys.exit(0 if still else "no longer so: distances are plain lengths now")
PY
cd "$work"
"$work/venv/bin/python" show.py
