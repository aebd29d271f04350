"""Bodies that a data set describes by SMPL parameters.

The SMPL model has a licence of its own and does not come with this package, so the user makes the body's surface:
readers take `body=` as a `BodyMotion`, or as a function from these poses to vertices and faces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError
from warpgarment.io.npz import write_npz
from warpgarment.objects.body import BodyMotion

from .axes import y_up, z_up

BODY_JOINTS = 22  # number of joints that SMPL and SMPL-H share; SMPL adds two hands, SMPL-H thirty finger joints
AMASS_JOINTS = 52
LARGEST = 1e6  # of a rotation [rad] and a translation [m]


@dataclass(frozen=True, eq=False)
class SmplPoses:
    """SMPL parameters of a sequence, in the data set's axes.

    A vertex v of the shaped body with the pelvis at J goes to R (v - J) + trans if `centred`, otherwise to
    R (v - J) + J + trans, which is SMPL's own convention. R is the first rotation; the other joints are posed before.

    Attributes:
        rotations: Axis-angle of each joint relative to its parent [rad], that of the whole body first, shape
            [T, 24, 3].
        trans: Translation [m], shape [T, 3].
        betas: Shape coefficients, [S], or [T, S] if they change.
        gender: "female", "male" or "neutral".
        fps: Frames per second.
        up: "y" or "z".
        centred: Whether the pelvis is at `trans`; otherwise it is at `trans` plus its rest position.
        source: Name of the file, for messages.
    """

    rotations: np.ndarray
    trans: np.ndarray
    betas: np.ndarray
    gender: str = "neutral"
    fps: float = 30.0
    up: str = "z"
    centred: bool = False
    source: str = ""

    def __post_init__(self) -> None:
        frames, where = len(self.rotations), f"{self.source}: " if self.source else ""
        if self.rotations.ndim != 3 or self.rotations.shape[2] != 3 or self.trans.shape != (frames, 3):
            raise MeshError(
                f"{where}SMPL poses need rotations [T,J,3] and translations [T,3], got "
                f"{list(self.rotations.shape)} and {list(self.trans.shape)}."
            )
        for name, array in (("rotations", self.rotations), ("translations", self.trans)):
            bad = ~(np.abs(array.reshape(frames, -1)) <= LARGEST).all(axis=1)  # NaN is not
            if bad.any():
                raise MeshError(
                    f"{where}{bad.sum():,} of {frames:,} frames have SMPL {name} that are NaN, infinite or beyond "
                    f"{LARGEST:,.0f} (first: frame {int(np.argmax(bad))}). Leave this sample out."
                )

    def __len__(self) -> int:
        return len(self.rotations)

    def turned(self, turn: Rotation) -> SmplPoses:
        """The motion of a centred body, turned about the origin."""
        rotations = self.rotations.copy()
        rotations[:, 0] = (turn * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
        return replace(self, rotations=rotations, trans=turn.apply(self.trans))

    def save_amass(self, path: str | Path) -> None:
        """Writes the motion as an AMASS .npz (Z up), which `warpgarment.bodies.amass.read_amass` reads.

        The file has the 22 joints that SMPL and SMPL-H share, and straight fingers. The rest position of the pelvis is
        not known without the model, so translations may be off by a constant.
        """
        rotations, trans = self.rotations.astype(np.float64), self.trans.astype(np.float64)
        if self.up == "y":
            turn = Rotation.from_rotvec([np.pi / 2, 0, 0])
            trans, rotations = z_up(trans), rotations.copy()
            rotations[:, 0] = (turn * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
        poses = np.zeros((len(self), 3 * AMASS_JOINTS))
        count = 3 * min(BODY_JOINTS, rotations.shape[1])
        poses[:, :count] = rotations.reshape(len(self), -1)[:, :count]
        betas = np.asarray(self.betas, dtype=np.float64)
        arrays = {
            "poses": poses,
            "trans": trans,
            "betas": betas if betas.ndim == 1 else betas[0],
            "gender": np.array(self.gender),
            "mocap_framerate": np.array(float(self.fps)),
        }
        write_npz(Path(path), arrays)


BodySource = BodyMotion | str | Path | Callable[[SmplPoses], tuple[np.ndarray, np.ndarray]] | None


def body_from(body: BodySource, poses: SmplPoses | None) -> BodyMotion | None:
    """The body that a reader was given, or that a given function makes from the poses.

    Args:
        body: Motion (metres, Y up, in the place of the recording) or its file, or a function from poses to vertices
            [m], [T, U, 3], in the axes of the poses and faces, [F, 3]; None for no body.
        poses: Argument of the function; None if the files have no poses.

    Raises:
        MeshError: There are no poses for the function, or it did not return a body with the right number of frames.
    """
    if body is None or isinstance(body, BodyMotion):
        return body
    if isinstance(body, (str, Path)):
        return BodyMotion.load(body)
    if poses is None:
        raise MeshError("No SMPL poses in the files to make a body of. Give a BodyMotion as body=.")
    vertices, faces = body(poses)
    vertices = np.asarray(vertices)
    if vertices.ndim != 3 or len(vertices) != len(poses):
        raise MeshError(
            f"body(poses) returned vertices of shape {list(vertices.shape)} for {len(poses):,} frames. "
            "It must return vertices [T,U,3] and faces [F,3]."
        )
    if poses.up == "z":
        vertices = y_up(vertices)
    return BodyMotion(vertices, faces, poses.fps)
