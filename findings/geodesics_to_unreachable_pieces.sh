#!/usr/bin/env bash
# Geodesics: how far is a piece of the mesh that cannot be reached? Zero, something plausible, or infinity
#
# Expected: on a mesh in two pieces (a shirt and its loose pocket) the distance from one to the other is infinite.
# Seen:     libigl's exact_geodesic says 0, as if every vertex over there were a source. The heat methods of potpourri3d
#           and libigl give a finite constant of the size of true distances, and not the same one. pygeodesic and
#           potpourri3d's fast marching say infinity. None warns.
# Versions: libigl 2.6.3, potpourri3d 1.4.0, pygeodesic 0.1.11, scipy 1.17.1, numpy 2.4.6.
# So:       a softmax or a nearest-neighbour rule over distances attends to other pieces more than to the own far side.
#           Label the connected pieces first and set the distance between them.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check \
  libigl==2.6.3 potpourri3d==1.4.0 pygeodesic==0.1.11 scipy==1.17.1 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys

import igl
import numpy as np
import potpourri3d
from pygeodesic.geodesic import PyGeodesicAlgorithmExact

n = 12
x, y = (g.ravel() for g in np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n)))
sheet = np.stack([x, y, 0.1 * np.sin(3 * x)], axis=1)
quads = np.array(
    [[i * n + j, i * n + j + 1, (i + 1) * n + j, (i + 1) * n + j + 1] for i in range(n - 1) for j in range(n - 1)]
)
faces = np.vstack([quads[:, [0, 1, 2]], quads[:, [1, 3, 2]]])
vertices = np.vstack([sheet, sheet + [5.0, 0, 0]])  # four metres of nothing between them
faces = np.vstack([faces, faces + n * n]).astype(np.int64)
nothing, source, everywhere = np.array([], dtype=np.int64), np.array([0]), np.arange(len(vertices))

heat = igl.HeatGeodesicsData()
igl.heat_geodesics_precompute(vertices, faces, heat)
marching = potpourri3d.MeshFastMarchingDistanceSolver(vertices, faces)
answers = {
    "libigl, exact": igl.exact_geodesic(vertices, faces, source, nothing, everywhere, nothing),
    "libigl, heat": igl.heat_geodesics_solve(heat, source),
    "potpourri3d, heat": potpourri3d.MeshHeatMethodDistanceSolver(vertices, faces).compute_distance(0),
    "potpourri3d, fast marching": marching.compute_distance([[(0, [])]]),
    "pygeodesic, exact": PyGeodesicAlgorithmExact(vertices, faces.astype(np.int32)).geodesicDistances(source, None)[0],
}
far = {}
for name, distance in answers.items():
    own, other = np.asarray(distance)[: n * n], np.asarray(distance)[n * n :]
    far[name] = other
    print(
        f"{name:28} own piece up to {own.max():.2f};",
        f"other piece: expected inf, seen {other.min():.2f} to {other.max():.2f}",
    )
own = np.asarray(answers["pygeodesic, exact"])[: n * n].max()
zero, one, two, *endless = far.values()
finite = (
    all(np.isfinite(h).all() and 0 < h.min() and h.max() < 2 * own for h in (one, two)) and abs(one[0] - two[0]) > 0.02
)
still = bool((zero == 0).all()) and finite and all(np.isinf(e).all() for e in endless)
sys.exit(0 if still else "no longer so: the libraries answer differently for pieces that cannot be reached")
PY
cd "$work"
"$work/venv/bin/python" show.py
