#!/usr/bin/env bash
# Warp: a winding-number sign query that counts no winding numbers, or wrong ones
#
# Expected: wp.mesh_query_point_sign_winding_number tells inside from outside by generalised winding numbers, for any
#           wp.Mesh; or it says why it cannot.
# Seen:     on a mesh built without support_winding_number=True it casts three rays instead, without a word. On two
#           overlapping spheres (an arm against the torso) one inside point in forty is called outside. On a mesh with
#           triangle groups, though the flag was given, every inside point of these spheres is called outside (on
#           another tessellation half of all points came out wrong, both ways): a single group is enough, and spheres
#           that do not touch. Distances stay right, so nothing shows.
# Versions: warp-lang 1.19.0, numpy 2.4.6, on the CPU.
# So:       give the flag, and one wp.Mesh per body with an array of ids rather than one mesh with groups. See
#           kernels/sdf/closest.py and kernels/sdf/bodies.py.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check warp-lang==1.19.0 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.init()
wp.set_device("cpu")


@wp.kernel
def sides(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), side: wp.array(dtype=float)):
    i = wp.tid()
    answer = wp.mesh_query_point_sign_winding_number(mesh, points[i], 100.0, 2.0, 0.5)
    side[i] = answer.sign


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


def wrong(apart, groups=None, flag=True):
    """Share of inside points that are called outside, and the other way, on two spheres with centres `apart`."""
    (v, f), (w, g) = sphere([0, 0, 0]), sphere([apart, 0, 0])
    vertices, faces = np.vstack([v, w]).astype(np.float32), np.vstack([f, g + len(v)]).astype(np.int32)
    labels = {None: None, "one": np.zeros(len(faces)), "two": np.repeat([0, 1], [len(f), len(g)])}[groups]
    labels = None if labels is None else wp.array(labels.astype(np.int32), dtype=int)
    mesh = wp.Mesh(
        wp.array(vertices, dtype=wp.vec3),
        wp.array(faces.ravel(), dtype=int),
        support_winding_number=flag,
        groups=labels,
    )
    points = (
        np.random.default_rng(0).uniform([-1.5, -1.5, -1.5], [apart + 1.5, 1.5, 1.5], (20000, 3)).astype(np.float32)
    )
    a, b = np.linalg.norm(points, axis=1), np.linalg.norm(points - [apart, 0, 0], axis=1)
    use = (np.abs(a - 1) > 0.05) & (np.abs(b - 1) > 0.05)  # away from the surface: no question of rounding
    points, inside = points[use], (np.minimum(a, b) < 1)[use]
    side = wp.zeros(len(points), dtype=float)
    wp.launch(sides, dim=len(points), inputs=[mesh.id, wp.array(points, dtype=wp.vec3), side])
    return float(np.mean(side.numpy()[inside] >= 0)), float(np.mean(side.numpy()[~inside] < 0))


near, apart = wrong(1.0), wrong(3.0)
no_flag, two, one = wrong(1.0, flag=False), wrong(3.0, "two"), wrong(3.0, "one")
print("warp", wp.config.version)
print("inside points called outside, outside points called inside")
print(
    f"expected: {near[0]:.1%} and {near[1]:.1%} overlapping, {apart[0]:.1%} and {apart[1]:.1%} apart (flag, no groups)"
)
print(f"seen:     {no_flag[0]:.1%} and {no_flag[1]:.1%} overlapping, without the flag")
print(f"          {two[0]:.1%} and {two[1]:.1%} apart, with two groups; {one[0]:.1%} and {one[1]:.1%} with one group")
still = max(near + apart) == 0 and max(no_flag) > 0.01 and max(two) > 0.05 and max(one) > 0.05
sys.exit(0 if still else "no longer so: the signs without the flag, or with groups, are right now")
PY
cd "$work"
WARP_CACHE_PATH="$work/kernels" "$work/venv/bin/python" show.py
