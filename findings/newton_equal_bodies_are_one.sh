#!/usr/bin/env bash
# Newton: two identical bodies are one mesh, and to move one is to move both
#
# Expected: two add_shape_mesh calls with two newton.Mesh objects give two meshes; writing the points of the first
#           body's and refitting it poses the first body.
# Seen:     meshes with equal vertices and faces are merged when the model is finalized: both shapes point to the same
#           wp.Mesh, and the second source has none (its .mesh is None). A change of one millimetre in one vertex is
#           enough to keep them apart.
# Versions: newton 1.8.0, warp-lang 1.19.0, numpy 2.4.6.
# So:       several dancers who start in the same rest pose share the pose of whoever was written last, in every world
#           of a replicated model. Make the rest meshes differ by less than matters, or check shape_source_ptr.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check newton==1.8.0 warp-lang==1.19.0 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys

import newton
import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.init()
wp.set_device("cpu")
corners = 0.2 * np.float32([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
faces = np.int32([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])


def two_bodies(difference):
    """Contacts of a particle resting on each of two bodies, after the first body was moved up by a metre."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    for k in range(2):
        vertices = corners.copy()
        vertices[0, 0] += k * difference
        place = wp.transform(wp.vec3(3.0 * k, 0.0, 0.0), wp.quat_identity())
        builder.add_shape_mesh(-1, xform=place, mesh=newton.Mesh(vertices, faces.ravel().copy()))
        builder.add_particle(pos=(3.0 * k, 0.0, 0.205), vel=(0, 0, 0), mass=0.01, radius=0.01)
    model = builder.finalize()
    moved = model.shape_source[0].mesh
    moved.points.assign(corners + np.float32([0, 0, 1]))
    moved.refit()
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    pipeline.collide(model.state(), contacts)
    count = int(contacts.soft_contact_count.numpy()[0])
    touched = set(contacts.soft_contact_shape.numpy()[:count].tolist())
    return len(set(model.shape_source_ptr.numpy().tolist())), model.shape_source[1].mesh is None, touched


equal, different = two_bodies(0.0), two_bodies(0.001)
print("newton", newton.__version__)
print("two bodies, a particle on each; the first body is moved away")
print("expected: two meshes, and the second particle still touches shape 1")
print(f"seen:     {equal[0]} mesh, second source without one: {equal[1]}, touched: {sorted(equal[2]) or 'nothing'}")
print(f"          with one vertex 1 mm apart: {different[0]} meshes, touched: {sorted(different[2]) or 'nothing'}")
still = equal == (1, True, set()) and different == (2, False, {1})
sys.exit(0 if still else "no longer so: equal meshes are kept apart now")
PY
cd "$work"
WARP_CACHE_PATH="$work/kernels" "$work/venv/bin/python" show.py
