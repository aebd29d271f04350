#!/usr/bin/env bash
# Newton: contacts with a deforming body are culled against its first pose
#
# Expected: after the points of a body's mesh are written and refitted, particles touch the body where it is now.
# Seen:     a particle 5 mm above a body that rose by a metre gets no contact; at the first pose the same particle does.
#           The shape's own box (shape_collision_aabb_lower/upper) is computed once, when the model is finalized, and
#           refit() does not know of it. Once the box is enlarged the contact is there.
# Versions: newton 1.8.0, warp-lang 1.19.0, numpy 2.4.6.
# So:       cloth falls through whatever leaves the box of the rest pose: raised arms, a step forward. Enlarge both
#           arrays over the whole motion before the first step (training/teachers/newton/worlds.py).
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


def contacts_above(rise, box_grows_by=0.0):
    """Contacts of a particle of 1 cm, 5 mm above the tip of a body whose mesh rose by `rise` metres."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    builder.add_shape_mesh(-1, mesh=newton.Mesh(corners, faces.ravel()))
    builder.add_particle(pos=(0, 0, 0.205 + rise), vel=(0, 0, 0), mass=0.01, radius=0.01)
    model = builder.finalize()
    mesh = model.shape_source[0].mesh
    mesh.points.assign(corners + np.float32([0, 0, rise]))
    mesh.refit()
    for box, sign in ((model.shape_collision_aabb_lower, -1), (model.shape_collision_aabb_upper, 1)):
        box.assign(box.numpy() + np.float32(sign * box_grows_by))
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    pipeline.collide(model.state(), contacts)
    return int(contacts.soft_contact_count.numpy()[0])


first, moved, enlarged = contacts_above(0.0), contacts_above(1.0), contacts_above(1.0, box_grows_by=2.0)
print("newton", newton.__version__)
print(f"expected: {first} contact at the first pose, {first} after body and particle rose by 1 m")
print(f"seen:     {first} at the first pose, {moved} after the rise, {enlarged} with the box enlarged by hand")
sys.exit(0 if (first, moved, enlarged) == (1, 0, 1) else "no longer so: the box of a shape follows its mesh now")
PY
cd "$work"
WARP_CACHE_PATH="$work/kernels" "$work/venv/bin/python" show.py
