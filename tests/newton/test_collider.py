"""Newton's shapes as closed meshes."""

from __future__ import annotations

import newton
import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError
from warpgarment.newton.axes import from_y_up, to_y_up
from warpgarment.newton.collider import ShapeCollider
from warpgarment.newton.primitives import PRIMITIVES

SCALE = {
    "SPHERE": (0.3, 0.0, 0.0), "CAPSULE": (0.1, 0.25, 0.0), "ELLIPSOID": (0.1, 0.2, 0.3), "CYLINDER": (0.1, 0.25, 0.0),
    "BOX": (0.1, 0.2, 0.3), "CONE": (0.1, 0.25, 0.0),
}  # fmt: skip
VOLUME = {  # m^3
    "SPHERE": 4 / 3 * np.pi * 0.3**3,
    "CAPSULE": np.pi * 0.1**2 * 0.5 + 4 / 3 * np.pi * 0.1**3,
    "ELLIPSOID": 4 / 3 * np.pi * 0.1 * 0.2 * 0.3,
    "CYLINDER": np.pi * 0.1**2 * 0.5,
    "BOX": 8 * 0.1 * 0.2 * 0.3,
    "CONE": np.pi * 0.1**2 * 0.5 / 3,
}


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_primitives_are_closed_and_as_large_as_the_shape(kind):
    """A shape would have a hole, be inside out, or be larger than Newton's: volumes by formula, from inscribed meshes
    at most 5 % too small; Newton's own meshes of these shapes have the same bounds, to 0.1 mm."""
    vertices, faces = PRIMITIVES[kind](np.array(SCALE[kind]))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert 0.95 * VOLUME[kind] <= mesh.volume <= VOLUME[kind] * (1 + 1e-9)
    make = getattr(newton.Mesh, f"create_{kind.lower()}")
    arguments = {"SPHERE": 1, "CAPSULE": 2, "ELLIPSOID": 3, "CYLINDER": 2, "BOX": 3, "CONE": 2}[kind]
    upright = {"up_axis": newton.Axis.Z} if kind in ("CAPSULE", "CYLINDER", "CONE") else {}
    theirs = np.asarray(make(*SCALE[kind][:arguments], compute_inertia=False, **upright).vertices)
    np.testing.assert_allclose(mesh.bounds, [theirs.min(0), theirs.max(0)], atol=1e-4 if kind != "ELLIPSOID" else 2e-3)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axes_are_turned_and_not_mirrored(axis):
    """A model's left would become right, or up something else."""
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(from_y_up(to_y_up(points, axis), axis), points)
    assert np.linalg.det(to_y_up(np.eye(3), axis)) == pytest.approx(1.0)
    np.testing.assert_allclose(to_y_up(np.eye(3)[axis], axis), [0, 1, 0])


def test_shapes_follow_their_bodies():
    """A limb would stay behind, or turn about another point. Every vertex has the distance of 0 to the capsule that
    SciPy turns and moves, and the ground is no body."""
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform_identity())
    local = Rotation.from_rotvec([0.4, -0.3, 0.2])
    place = wp.transform((0.1, 0.2, 0.3), wp.quat(*map(float, local.as_quat())))
    builder.add_shape_capsule(body, xform=place, radius=0.1, half_height=0.25)
    builder.add_ground_plane()
    model = builder.finalize(device="cpu")
    state = model.state()
    world = Rotation.from_rotvec([1.0, 0.5, -2.0])
    state.body_q.assign(np.array([[1.0, 2.0, 3.0, *world.as_quat()]], dtype=np.float32))
    collider = ShapeCollider(model)
    x, y, z = collider.at(state).numpy().T
    points = np.stack([x, -z, y], 1)
    ends = [world.apply(local.apply([0, 0, s]) + [0.1, 0.2, 0.3]) + [1, 2, 3] for s in (-0.25, 0.25)]
    along = np.clip((points - ends[0]) @ (ends[1] - ends[0]) / 0.25, 0, 1)[:, None]
    distance = np.linalg.norm(points - ends[0] - along * (ends[1] - ends[0]), axis=1)
    np.testing.assert_allclose(distance, 0.1, atol=1e-5)
    assert collider.counts == [len(points)]
    with pytest.raises(MeshError, match=r"shape 1 .* is a plane, which has no inside"):
        ShapeCollider(model, [1])
