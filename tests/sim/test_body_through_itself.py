"""A body whose hands go through its thighs while it walks, with cloth in between."""

from dataclasses import replace

import igl
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import warpgarment as wg
from warpgarment.bodies.rest import RestBody, bundled_body
from warpgarment.bodies.skeleton import PoseSequence, posed
from warpgarment.training.garments.make import make_garment
from warpgarment.training.garments.pattern import sampled_pattern
from warpgarment.training.motions.procedural import procedural


def coarse_body(faces: int = 1604) -> RestBody:
    """The bundled body with fewer faces."""
    body = bundled_body()
    vertices, triangles, _, _ = igl.qslim(body.vertices, body.faces.astype(np.int64), faces)
    near = cKDTree(body.vertices).query(vertices)[1]
    return replace(
        body,
        vertices=vertices,
        faces=triangles.astype(np.int32),
        bone_indices=body.bone_indices[near],
        bone_weights=body.bone_weights[near],
    )


def with_arms_turned_in(body: RestBody, poses: PoseSequence, degrees: float) -> PoseSequence:
    rotations = poses.rotations.copy()
    for side, sign in (("Left", -1), ("Right", 1)):
        turn = Rotation.from_euler("z", sign * degrees, degrees=True).as_matrix()
        arm = body.chain(f"{side}Arm")
        about_root = rotations[:, :1] @ turn @ rotations[:, :1].swapaxes(2, 3)
        rotations[:, arm] = about_root @ rotations[:, arm]
    return PoseSequence(rotations, poses.root, poses.fps)


@pytest.mark.parametrize("degrees", [16.0, 20.0])
def test_no_vertex_stays_in_a_body_that_goes_through_itself(degrees):
    """Vertices of trousers would be pushed from a hand into the thigh and back again, and stay centimetres deep.

    Depths are distances of libigl where its winding number is over a half, not the engine's; libigl's signed distances
    would be three times too deep where parts overlap. 5 mm is the limit from which a frame counts as
    penetrating. The garment is put on a body with its arms out, so that the first frames, in which they come in, are
    left out.
    """
    full, body = bundled_body(), coarse_body()
    trousers, _ = make_garment(full, sampled_pattern("trousers", np.random.default_rng(0), 700))
    vertices, _ = posed(body, with_arms_turned_in(body, procedural(body, "walk", 60, seed=0), degrees))
    motion = wg.BodyMotion(vertices.astype(np.float32), body.faces, 30.0)
    faces = motion.faces.astype(np.int64)
    hands = np.flatnonzero(body.weight_of("LeftForeArm", "RightForeArm") > 0.9)
    rest = faces[(body.weight_of("LeftArm", "RightArm")[faces] < 0.5).all(1)]

    def depth(points: np.ndarray, frame: int, triangles: np.ndarray) -> float:
        at, points = motion.vertices[frame].astype(np.float64), points.astype(np.float64)
        inside = igl.winding_number(at, triangles, points) > 0.5
        return float(np.sqrt(igl.point_mesh_squared_distance(points, at, triangles)[0])[inside].max(initial=0.0))

    result = wg.Simulator.from_pretrained("fast", device="cpu").rollout(trousers, motion)
    frames = range(5, 60)
    assert max(depth(motion.vertices[k][hands], k, rest) for k in frames) > 0.005  # hands are in the thighs
    assert max(depth(result.vertices[k], k, faces) for k in frames) < 0.005
