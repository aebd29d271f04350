"""Bodies of SMPL's family (SMPL, SMPL-H, SMPL-X), for users who have a model: it is not part of this package.

Loper et al., SMPL: A Skinned Multi-Person Linear Model, 2015. With shape coefficients β and rotations R_j of the joints
relative to their parents, joint 0 being the root:

    v(β)  = v_template + shapedirs β                            (their eq. 8)
    J(β)  = J_regressor v(β)                                    (eq. 10)
    v_p   = v(β) + posedirs vec(R_1 - I, ..., R_J - I)          (eq. 9)
    v'    = sum_j w_j (G_j (v_p - J_j) + place of joint j)      (eq. 2-4), G_j = G_parent R_j
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError
from warpgarment.io.npz import read_npz

from .amass import NAMES, Recorded
from .rest import RestBody

KEYS = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")
FAMILY = {24: "SMPL", 52: "SMPL-H", 55: "SMPL-X"}
BODY = len(NAMES)  # joints that all of them have in common, in one order
_HANDS = {52: 22, 55: 25}  # number of the first of thirty finger joints
_ACTIVE = 8  # bones that move a vertex of a `RestBody`


@dataclass(frozen=True, eq=False)
class SmplModel:
    """A model, Y up, facing +Z, in a T-pose, in metres.

    Attributes:
        vertices: Mean shape, shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        shapes: Displacement by each coefficient of shape, shape [V, 3, S].
        poses: Displacement by each entry of the rotations less identity, shape [V, 3, 9 (J - 1)]; None: there is none.
        regressor: Joints from vertices, shape [J, V].
        weights: Weight of each joint at each vertex, shape [V, J].
        parents: Parent of each joint, -1 for the root; parents come first.
    """

    vertices: np.ndarray
    faces: np.ndarray
    shapes: np.ndarray
    poses: np.ndarray | None
    regressor: np.ndarray
    weights: np.ndarray
    parents: tuple[int, ...]

    @classmethod
    def load(cls, path: str | Path) -> SmplModel:
        """Reads a model of plain arrays; other arrays of the file are not opened, and nothing is unpickled.

        Raises:
            MeshError: An array is missing, pickled, or does not fit the others.
        """
        data = read_npz(Path(path), KEYS, {*KEYS, "posedirs"}.__contains__)
        vertices, regressor, tree = data["v_template"], data["J_regressor"], data["kintree_table"]
        count, joints = len(vertices), len(regressor)
        poses = data.get("posedirs")
        fits = {
            "v_template": vertices.shape == (count, 3) and count > 0,
            "f": data["f"].ndim == 2 and data["f"].shape[1] == 3 and len(data["f"]) > 0,
            "J_regressor": regressor.shape == (joints, count) and joints in FAMILY,
            "weights": data["weights"].shape == (count, joints),
            "kintree_table": tree.shape == (2, joints) and tree.dtype.kind in "iu",
            "shapedirs": data["shapedirs"].ndim == 3 and data["shapedirs"].shape[:2] == (count, 3),
            "posedirs": poses is None or poses.shape == (count, 3, 9 * (joints - 1)),
        }
        fits |= {
            name: fits[name] and np.isfinite(array).all() for name, array in data.items() if array.dtype.kind == "f"
        }
        wrong = [name for name, sound in fits.items() if not sound]
        if wrong:
            shape = list(data[wrong[0]].shape)
            raise MeshError(f"{path}: {wrong[0]} {shape} does not fit a model of {', '.join(FAMILY.values())}.")
        parents = (-1, *(int(parent) for parent in tree[0, 1:]))
        faces = data["f"].astype(np.int64)
        if any(not 0 <= parent < joint for joint, parent in enumerate(parents) if joint) or faces.min() < 0:
            raise MeshError(f"{path}: kintree_table is no tree in which parents come first. It is damaged.")
        if faces.max() >= count:
            raise MeshError(f"{path}: f names vertices beyond the {count:,} of v_template. It is damaged.")
        return cls(
            vertices=vertices.astype(np.float64),
            faces=faces,
            shapes=data["shapedirs"].astype(np.float64),
            poses=None if poses is None else poses.astype(np.float64),
            regressor=regressor.astype(np.float64),
            weights=data["weights"].astype(np.float64),
            parents=parents,
        )

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.parents)

    def shaped(self, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V, 3] and joints [J, 3] at rest [m] of coefficients, of which those beyond the model's are left."""
        used = min(len(betas), self.shapes.shape[2])
        vertices = self.vertices + self.shapes[:, :, :used] @ betas[:used]
        return vertices, self.regressor @ vertices

    def rest(self, betas: np.ndarray | None = None) -> RestBody:
        """The body at rest, as one that bones move: without what `poses` adds."""
        vertices, joints = self.shaped(np.zeros(0) if betas is None else betas)
        lift = -np.array([0.0, vertices[:, 1].min(), 0.0])  # feet on the floor
        strongest = np.argsort(-self.weights, axis=1)[:, :_ACTIVE]
        kept = np.take_along_axis(self.weights, strongest, axis=1)
        return RestBody(
            vertices=vertices + lift,
            faces=self.faces.astype(np.int32),
            joints=joints + lift,
            bone_names=(*NAMES, *(f"joint {number}" for number in range(BODY, self.joints))),
            bone_parents=self.parents,
            bone_indices=strongest.astype(np.uint8),
            bone_weights=kept / kept.sum(1, keepdims=True),
            phenotype={},
        )

    def posed(self, recorded: Recorded, betas: np.ndarray) -> np.ndarray:
        """Vertices of a recorded motion in its own axes [m], float32 [T, V, 3].

        Args:
            recorded: Joint angles, of this model or another of the family.
            betas: Coefficients of shape.
        """
        vertices, joints = self.shaped(betas)
        turns = Rotation.from_rotvec(self._angles(recorded.poses).reshape(-1, 3)).as_matrix()
        turns = turns.reshape(len(recorded.poses), self.joints, 3, 3)
        found = np.empty((len(turns), len(vertices), 3), np.float32)
        block = max(1, 2_000_000 // (12 * len(vertices)))
        for start in range(0, len(turns), block):
            part = turns[start : start + block]
            moved = np.broadcast_to(vertices, (len(part), *vertices.shape))
            if self.poses is not None:
                bent = (part[:, 1:] - np.eye(3)).reshape(len(part), -1)
                moved = moved + (bent @ self.poses.reshape(-1, bent.shape[1]).T).reshape(len(part), -1, 3)
            world, places = part.copy(), np.empty((len(part), self.joints, 3))
            places[:, 0] = joints[0]
            for joint, parent in enumerate(self.parents[1:], start=1):
                world[:, joint] = world[:, parent] @ part[:, joint]
                places[:, joint] = places[:, parent] + world[:, parent] @ (joints[joint] - joints[parent])
            shift = places - np.einsum("tjab,jb->tja", world, joints)
            blended = np.einsum("vj,tjab->tvab", self.weights, world)
            moved = np.einsum("tvab,tvb->tva", blended, moved) + np.einsum("vj,tja->tva", self.weights, shift)
            found[start : start + block] = moved + recorded.trans[start : start + block, None]
        return found

    def _angles(self, poses: np.ndarray) -> np.ndarray:
        """Joint angles in the order of this model, [T, J, 3]; joints that the recording does not have are straight."""
        there = poses.shape[1]
        if there == self.joints:
            return poses
        angles = np.zeros((len(poses), self.joints, 3))
        angles[:, :BODY] = poses[:, :BODY]
        if there in _HANDS and self.joints in _HANDS:
            here, own = _HANDS[there], _HANDS[self.joints]
            angles[:, own : own + 30] = poses[:, here : here + 30]
        return angles
