"""Bodies for tests only, unlike any that a network is trained on: a wooden mannequin and a creature.

Each is wrapped in one closed surface of about 6,000 even faces: its inside (a winding number, or a formula) is sampled
on a grid, contoured by marching cubes and remeshed. A vertex follows the bone of its part; near joints the weights are
mixed by diffusion over the surface. Bones have Anny's names and arms hang at 45 degrees, so that garments, motions and
teachers work unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import igl
import numpy as np

from warpgarment.bodies.anny import TEMPLATE_FACES, smoothed
from warpgarment.bodies.rest import RestBody
from warpgarment.errors import MissingExtra
from warpgarment.geometry.cutting import averaging, largest_piece, remeshed

_CELL = 0.012  # cell of the grids on which surfaces are contoured [m]
_ROUNDS = 25  # rounds of diffusion of the weights: some 7 cm at edges of 25 mm

# SMPL-X's names of the mannequin's joints, and ours.
_FROM_SMPLX = {
    "Pelvis": "Hips", "Spine1": "LowerBack", "Spine2": "Spine", "Spine3": "Spine1", "Neck": "Neck", "Head": "Head",
    "L_Hip": "LeftUpLeg", "L_Knee": "LeftLeg", "L_Ankle": "LeftFoot", "L_Foot": "LeftToeBase",
    "R_Hip": "RightUpLeg", "R_Knee": "RightLeg", "R_Ankle": "RightFoot", "R_Foot": "RightToeBase",
    "L_Collar": "LeftShoulder", "L_Shoulder": "LeftArm", "L_Elbow": "LeftForeArm", "L_Wrist": "LeftHand",
    "R_Collar": "RightShoulder", "R_Shoulder": "RightArm", "R_Elbow": "RightForeArm", "R_Wrist": "RightHand",
}  # fmt: skip

_TREE: dict[str, str | None] = {
    "Hips": None,
    "LeftUpLeg": "Hips", "LeftLeg": "LeftUpLeg", "LeftFoot": "LeftLeg", "LeftToeBase": "LeftFoot",
    "RightUpLeg": "Hips", "RightLeg": "RightUpLeg", "RightFoot": "RightLeg", "RightToeBase": "RightFoot",
    "LowerBack": "Hips", "Spine": "LowerBack", "Spine1": "Spine", "Neck": "Spine1", "Head": "Neck",
    "LeftShoulder": "Spine1", "LeftArm": "LeftShoulder", "LeftForeArm": "LeftArm", "LeftHand": "LeftForeArm",
    "RightShoulder": "Spine1", "RightArm": "RightShoulder", "RightForeArm": "RightArm", "RightHand": "RightForeArm",
}  # fmt: skip


def wrapped(
    vertices: np.ndarray, faces: np.ndarray, closing: float = 0.012, cell: float = _CELL, wanted: int = TEMPLATE_FACES
) -> tuple[np.ndarray, np.ndarray]:
    """One closed surface around closed parts that may overlap or have gaps between them.

    Args:
        vertices: Positions of all parts [m], shape [V, 3].
        faces: Vertex indices, counter-clockwise seen from outside, shape [F, 3].
        closing: Radius to which creases are rounded [m]; gaps narrower than twice this are filled.
        cell: Cell of the grid [m]; thinner parts are lost.
        wanted: Approximate number of faces of the result.

    Returns:
        Vertices [m] and faces of the largest connected piece.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    low, high = vertices.min(0) - closing, vertices.max(0) + closing
    swollen = _contour(lambda points: _signed_distance(points, vertices, faces) - closing, low, high, cell)
    return contoured(lambda points: _signed_distance(points, *swollen) + closing, low, high, cell, wanted)


def contoured(
    distance: Callable[[np.ndarray], np.ndarray],
    low: Sequence[float] | np.ndarray,
    high: Sequence[float] | np.ndarray,
    cell: float = _CELL,
    wanted: int = TEMPLATE_FACES,
) -> tuple[np.ndarray, np.ndarray]:
    """The surface where a signed distance is zero, evenly triangulated and without edges.

    Args:
        distance: Function from points [m], [N, 3], to signed distances [m], [N], negative inside.
        low, high: Corners of a box that holds the inside [m].
        cell: Cell of the grid [m]; thinner parts are lost.
        wanted: Approximate number of faces of the result.

    Returns:
        Vertices [m] and faces, counter-clockwise seen from outside, of the largest connected piece.
    """
    vertices, faces = largest_piece(*_contour(distance, low, high, cell))
    vertices, faces, _ = remeshed(vertices, faces, wanted)
    return smoothed(vertices, faces), faces.astype(np.int32)


def _contour(
    distance: Callable[[np.ndarray], np.ndarray],
    low: Sequence[float] | np.ndarray,
    high: Sequence[float] | np.ndarray,
    cell: float,
) -> tuple[np.ndarray, np.ndarray]:
    axes = [np.arange(a - 2 * cell, b + 3 * cell, cell) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], axis=3).reshape(-1, 3)  # x runs fastest
    vertices, faces, *_ = igl.marching_cubes(distance(grid), grid, *(len(axis) for axis in axes), 0.0)
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    corners = vertices[faces]
    if np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]
    return vertices, faces


def _signed_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    sign = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER  # correct even where parts overlap
    return igl.signed_distance(points, vertices, np.ascontiguousarray(faces, dtype=np.int64), sign_type=sign)[0]


def rigged(
    vertices: np.ndarray,
    faces: np.ndarray,
    parts: np.ndarray,
    joints: dict[str, np.ndarray],
    tree: dict[str, str | None],
) -> RestBody:
    """A body whose vertices follow the bones of their parts, mixed near joints.

    Args:
        vertices: Positions of the surface [m], shape [U, 3]; the body is moved onto the floor.
        faces: Vertex indices, shape [G, 3].
        parts: Name of the bone to whose part each vertex belongs, shape [U].
        joints: Rest position of each bone's head by name [m].
        tree: Parent of each bone by name, None for the root; parents come first.
    """
    names = tuple(tree)
    weights = (np.asarray(parts)[:, None] == np.array(names)[None]).astype(np.float64)
    mean = averaging(faces, len(vertices))
    for _ in range(_ROUNDS):
        weights = 0.5 * weights + 0.5 * (mean @ weights)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    kept = np.take_along_axis(weights, order, axis=1)
    lift = -np.array([0.0, vertices[:, 1].min(), 0.0])
    return RestBody(
        vertices=vertices + lift,
        faces=faces,
        joints=np.stack([joints[name] for name in names]) + lift,
        bone_names=names,
        bone_parents=tuple(-1 if tree[name] is None else names.index(tree[name]) for name in names),
        bone_indices=order.astype(np.uint8),
        bone_weights=(kept / kept.sum(1, keepdims=True)).astype(np.float32),
        phenotype={},
    )


@lru_cache(maxsize=1)
def mannequin_body() -> RestBody:
    """The wooden mannequin of mannequin-x: 29 rounded parts in one skin.

    Raises:
        MissingExtra: mannequin-x is not installed.
    """
    try:
        from mannequin import Mannequin
    except ImportError as error:
        raise MissingExtra("bodies", "The mannequin") from error
    model = Mannequin("wooden")
    faces = np.asarray(model.faces)
    pose = model.rest_pose()
    turnable = [name for name in model.joint_names if name in _FROM_SMPLX and name != "Pelvis"]
    for side, turn in (("L", -1.0), ("R", 1.0)):  # from the T-pose
        pose["body_pose"][turnable.index(f"{side}_Shoulder"), 2] = turn * np.pi / 4
    vertices = np.asarray(model.vertices(pose), dtype=np.float64)
    part = np.full(len(vertices), "Hips", dtype="U16")
    for row, name in enumerate(turnable):  # a vertex belongs to the last joint that moves it
        probe = {key: np.array(value) for key, value in pose.items()}
        probe["body_pose"][row, 0] += 0.3
        part[np.abs(np.asarray(model.vertices(probe)) - vertices).max(1) > 1e-4] = _FROM_SMPLX[name]
    places = np.asarray(model.joint_transforms(pose), dtype=np.float64)[:, :3, 3]
    placed = {_FROM_SMPLX[n]: places[i] for i, n in enumerate(model.joint_names) if n in _FROM_SMPLX}
    surface, triangles = wrapped(vertices, faces)
    _, nearest, _ = igl.point_mesh_squared_distance(surface, vertices, faces.astype(np.int64))
    return rigged(surface, triangles, part[faces[nearest, 0]], _symmetric(placed), _TREE)


def _symmetric(joints: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Joints averaged with the mirror image of the other side."""
    flip = np.array([-1.0, 1.0, 1.0])

    def twin(name: str) -> str:
        return name.replace("Left", "*").replace("Right", "Left").replace("*", "Right")

    return {name: 0.5 * (place + flip * joints[twin(name)]) for name, place in joints.items()}


# A creature's shapes by bone: a capsule from a to b with radii at both ends, or an ellipsoid around a with half axes b.
_CREATURE: dict[str, list[tuple[Any, ...]]] = {
    "Hips": [("ellipsoid", (0.0, 0.66, -0.01), (0.165, 0.13, 0.15))],
    "LowerBack": [("ellipsoid", (0.0, 0.78, 0.02), (0.17, 0.13, 0.16))],
    "Spine": [("ellipsoid", (0.0, 0.91, 0.01), (0.18, 0.13, 0.15))],
    "Spine1": [("ellipsoid", (0.0, 1.03, -0.01), (0.19, 0.12, 0.13))],
    "Neck": [("capsule", (0.0, 1.14, 0.0), (0.0, 1.24, 0.03), 0.065, 0.065)],
    "Head": [
        ("ellipsoid", (0.0, 1.40, 0.05), (0.18, 0.19, 0.19)),
        ("ellipsoid", (0.0, 1.33, 0.22), (0.11, 0.075, 0.12)),
        ("capsule", (0.10, 1.54, 0.0), (0.21, 1.70, -0.05), 0.05, 0.025),
        ("capsule", (-0.10, 1.54, 0.0), (-0.21, 1.70, -0.05), 0.05, 0.025),
    ],
    "LeftShoulder": [("capsule", (0.06, 1.09, -0.01), (0.17, 1.09, -0.01), 0.06, 0.06)],
    "LeftArm": [("capsule", (0.18, 1.09, -0.01), (0.44, 0.83, -0.01), 0.06, 0.045)],
    "LeftForeArm": [("capsule", (0.44, 0.83, -0.01), (0.68, 0.59, 0.05), 0.045, 0.04)],
    "LeftHand": [("capsule", (0.68, 0.59, 0.05), (0.76, 0.51, 0.08), 0.05, 0.04)],
    "LeftUpLeg": [("capsule", (0.10, 0.62, 0.0), (0.15, 0.36, 0.10), 0.085, 0.065)],
    "LeftLeg": [("capsule", (0.15, 0.36, 0.10), (0.17, 0.09, -0.04), 0.062, 0.05)],
    "LeftFoot": [("capsule", (0.17, 0.055, -0.05), (0.18, 0.05, 0.08), 0.055, 0.055)],
    "LeftToeBase": [("capsule", (0.18, 0.05, 0.08), (0.19, 0.045, 0.17), 0.055, 0.045)],
    "Tail": [("capsule", (0.0, 0.56, -0.10), (0.0, 0.55, -0.25), 0.055, 0.045)],
}
_HEADS = {  # heads of the bones that do not begin where their shape does [m]
    "Hips": (0.0, 0.66, 0.0), "LowerBack": (0.0, 0.72, -0.01), "Spine": (0.0, 0.85, 0.0), "Spine1": (0.0, 0.97, 0.0),
    "Head": (0.0, 1.24, 0.03),
}  # fmt: skip
_BLEND = 0.02  # distance over which shapes blend into each other [m]


@lru_cache(maxsize=1)
def creature_body() -> RestBody:
    """An invented creature, 1.7 m tall, with long arms, short bent legs, a big head with ears, and a short tail."""
    flip = np.array([-1.0, 1.0, 1.0])
    shapes = []
    for bone, own in _CREATURE.items():
        for kind, a, b, *radii in own:
            shapes.append((bone, kind, np.array(a), np.array(b), radii))
            if bone.startswith("Left"):
                far = np.array(b) * (flip if kind == "capsule" else 1.0)
                shapes.append((bone.replace("Left", "Right"), kind, np.array(a) * flip, far, radii))

    def distances(points: np.ndarray) -> np.ndarray:
        return np.stack([_shape_distance(points, *shape[1:]) for shape in shapes])

    def melted(points: np.ndarray) -> np.ndarray:
        return -_BLEND * np.log(np.exp(-distances(points) / _BLEND).sum(0))

    vertices, faces = contoured(melted, (-0.85, -0.02, -0.35), (0.85, 1.80, 0.45), cell=0.016)
    parts = np.array([shape[0] for shape in shapes])[distances(vertices).argmin(0)]
    joints = {bone: np.array(_HEADS.get(bone, a)) for bone, kind, a, *_ in reversed(shapes)}
    tree = _TREE | {"Tail": "Hips"}
    return rigged(vertices, faces, parts, joints, tree)


def _shape_distance(points: np.ndarray, kind: str, a: np.ndarray, b: np.ndarray, radii: Sequence[float]) -> np.ndarray:
    """Distance [N] to a tapered capsule or, to first order, to an ellipsoid [m]."""
    if kind == "ellipsoid":
        scaled = (points - a) / b
        size = np.sqrt(np.einsum("nc,nc->n", scaled, scaled))
        scaled /= b
        return size * (size - 1.0) / np.maximum(np.sqrt(np.einsum("nc,nc->n", scaled, scaled)), 1e-9)
    share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    across = points - a - share[:, None] * (b - a)
    return np.sqrt(np.einsum("nc,nc->n", across, across)) - (radii[0] + share * (radii[1] - radii[0]))
