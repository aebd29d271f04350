"""Motion clips on their own skeletons, which readers return: checks, and resampling in time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError


@dataclass(frozen=True)
class Clip:
    """A motion on its own skeleton, Y up, in the file's units.

    Attributes:
        names: Joint names, root first.
        offsets: Offset of each joint from its parent in the zero pose, in the file's unit of length, shape [J, 3].
        rotations: World rotation of each joint, shape [T, J, 3, 3].
        root: Position of the root in the file's unit of length, shape [T, 3].
        fps: Frames per second.
        up: Axis that points up in the file, "y" or "z".
    """

    names: tuple[str, ...]
    offsets: np.ndarray
    rotations: np.ndarray
    root: np.ndarray
    fps: float
    up: str = "y"

    def __len__(self) -> int:
        return len(self.root)


def checked_finite(values: np.ndarray, file: str) -> None:
    """Refuses frames [T, ...] that hold NaN or infinity.

    Raises:
        MeshError: Some frames do; the error names their number and the first one.
    """
    bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    if bad.any():
        raise MeshError(
            f"{file}: {bad.sum():,} of {len(bad):,} frames hold NaN or infinity (first: frame {int(bad.argmax())}). "
            "Cut them out or repair what wrote them."
        )


def frame_rate(rate: float, file: str) -> float:
    """Frames per second of a file, rounded to a whole number if it is within a hundredth of a percent of it.

    BVH files write 120 fps as a frame time of 0.0083333.

    Raises:
        MeshError: The rate is not between 1 and 2,000.
    """
    if not 1.0 <= rate <= 2000.0:  # refuses NaN, too
        raise MeshError(f"{file}: {rate:g} frames per second is no frame rate. Repair the file's header.")
    return float(round(rate)) if abs(rate - round(rate)) < 1e-4 * rate else float(rate)


def resampled_length(frames: int, rate: float, fps: float) -> int:
    """Number of frames after :func:`resampled`; all of them lie within the clip."""
    return int((frames - 1) * fps / rate + 1e-6) + 1


def resampled(clip: Clip, fps: float) -> Clip:
    """The clip at another frame rate: between frames, rotations turn at constant speed and the root moves straight."""
    at = np.arange(resampled_length(len(clip), clip.fps, fps)) * (clip.fps / fps)
    before = np.minimum(np.round(at, 6).astype(int), len(clip) - 1)
    after = np.minimum(before + 1, len(clip) - 1)
    share = np.where(at - before < 1e-6, 0.0, at - before)
    root = clip.root[before] + share[:, None] * (clip.root[after] - clip.root[before])
    rotations = clip.rotations[before]
    between = np.flatnonzero(share)
    if len(between):
        step = rotations[between].transpose(0, 1, 3, 2) @ clip.rotations[after[between]]
        shape = step.shape
        vector = Rotation.from_matrix(step.reshape(-1, 3, 3)).as_rotvec().reshape(*shape[:2], 3)
        turn = Rotation.from_rotvec((share[between, None, None] * vector).reshape(-1, 3)).as_matrix()
        rotations[between] = rotations[between] @ turn.reshape(shape)
    return replace(clip, rotations=rotations, root=root, fps=fps)
