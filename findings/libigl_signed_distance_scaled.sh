#!/usr/bin/env bash
# libigl: winding numbers change the size of a signed distance, not only its sign
#
# Expected: signed_distance is plus or minus the distance to the surface, whatever decides the sign.
# Seen:     with winding numbers, libigl's default, the distance is multiplied by 1 - 2w: where two parts of a body
#           overlap (w = 2) it is three times too deep. With the fast approximation w is not an integer, and distances
#           outside, too, are off (0.03 % two radii away). point-cloud-utils, which builds on libigl, does the same;
#           gpytoolbox, which builds on it too, and libigl's pseudo-normals do not.
# Versions: libigl 2.6.3, point-cloud-utils 0.34.0, gpytoolbox 0.3.8, numpy 2.4.6.
# So:       posed limbs overlap, and a depth of 5 mm in an armpit is reported as 15. Take the sign from one call and the
#           length from point_mesh_squared_distance. As a reference in tests, compare away from overlaps or do the same.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check \
  libigl==2.6.3 point-cloud-utils==0.34.0 gpytoolbox==0.3.8 scipy==1.17.1 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys

import gpytoolbox
import igl
import numpy as np
import point_cloud_utils


def sphere(centre, rings=24):
    """A closed sphere of radius 1: vertices and faces, outward."""
    polar, around = np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(2 * rings) / (2 * rings)
    grid = [[np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)] for p in polar for a in around]
    vertices = np.array([[0, 0, 1], *grid, [0, 0, -1]]) + centre
    n, faces, last = 2 * rings, [], len(vertices) - 1
    for k in range(n):
        after = (k + 1) % n
        faces += [[0, 1 + k, 1 + after], [last, last - n + after, last - n + k]]
        for r in range(rings - 2):
            a, b, c, d = (1 + n * r + k, 1 + n * r + after, 1 + n * (r + 1) + k, 1 + n * (r + 1) + after)
            faces += [[a, c, b], [b, c, d]]
    return vertices, np.array(faces)


(v, f), (w, g) = sphere([0, 0, 0]), sphere([1, 0, 0])
vertices, faces = np.vstack([v, w]), np.vstack([f, g + len(v)]).astype(np.int64)
points = np.array([[0.5, 0.1, 0.0], [-0.5, 0.1, 0.0], [3.0, 0.1, 0.0]])  # in both spheres, in one, outside
plain = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0])
kind = lambda name: igl.signed_distance(
    points, vertices, faces, sign_type=getattr(igl, "SIGNED_DISTANCE_TYPE_" + name)
)[0]
answers = {
    "libigl, winding numbers": kind("WINDING_NUMBER"),
    "libigl, by default": igl.signed_distance(points, vertices, faces)[0],
    "libigl, fast winding numbers": kind("FAST_WINDING_NUMBER"),
    "point-cloud-utils": point_cloud_utils.signed_distance_to_mesh(points, vertices, faces.astype(np.int32))[0],
    "libigl, pseudo-normals": kind("PSEUDONORMAL"),
    "gpytoolbox": gpytoolbox.signed_distance(points, vertices, faces)[0],
}
print("in two spheres, in one, outside; the distances are", np.round(plain, 4))
print(f"{'expected:':36}", np.round(plain * [-1, -1, 1], 4))
for name, answer in answers.items():
    print(f"seen: {name:30}", np.round(answer, 4))
ratio = {name: answer / plain for name, answer in answers.items()}
still = all(np.allclose(ratio[n], [-3, -1, 1], atol=1e-6) for n in list(answers)[:2])
still &= all(np.allclose(ratio[n], [-3, -1, 1], atol=0.02) and abs(ratio[n][2] - 1) > 1e-5 for n in list(answers)[2:4])
still &= all(np.allclose(ratio[n], [-1, -1, 1], atol=1e-6) for n in list(answers)[4:])
sys.exit(0 if still else "no longer so: the size of the distance is that of the surface, or the peers changed")
PY
cd "$work"
"$work/venv/bin/python" show.py
