"""The input of the network from earlier frames: features of H frames and the H-1 velocities between them (Algorithm 1).

A history is never changed. Each frame makes a new one, so old states of a simulation stay usable. This is cheap: the
only array written per frame is the stack that the network reads, and the next history is a view of it. On a CPU, stacks
of following frames overlap in one array (`Stacks`), so that a frame writes its own features only:

    stack at t    |0 1 2 3 4 5|6 . . . . . . . . .        columns of frames; dots are not written yet
    stack at t+1    |1 2 3 4 5 6|

Such an array of a large batch would take too much memory. There each frame is a tensor of its own, and a history is H-1
of them: what the network reads is put together for the garments that it reads at a time. Networks of patches read the
frames where they are, in any batch.
"""

from __future__ import annotations

import dataclasses

import torch

from warpgarment.kernels.features.channels import FACE, FEATURES
from warpgarment.nn.inputs import Frames


@dataclasses.dataclass(frozen=True)
class History:
    """Features of frames t-H+1 ... t-1 and velocities up to frame t, oldest first.

    Frame t itself is missing from the features because they need the body at t+1.
    """

    features: torch.Tensor | Frames  # [F,H-1,34]
    velocities: torch.Tensor  # [C,H-1,3] centroid of each component at frame k minus that at k-1, metres per frame

    @classmethod
    def cold(cls, features: torch.Tensor, components: int, frames: int) -> History:
        """A history that repeats the first frame at rest: body deformations are the identity, all velocities zero.

        Args:
            features: Features of the first frame, shape [F,34]; those of the body's motion are replaced.
            components: Number of connected components C.
            frames: Number of frames H.
        """
        repeated = FACE.still(features)[:, None].expand(-1, frames - 1, -1)
        return cls(repeated, features.new_zeros((components, frames - 1, 3)))

    def stacked(self, newest: torch.Tensor) -> torch.Tensor:
        """Features of all H frames, shape [F,H,34]; `newest` are those of frame t, shape [F,34]."""
        past = self.features.whole() if isinstance(self.features, Frames) else self.features
        return torch.cat([past, newest[:, None]], dim=1)

    def followed(self, stacked: torch.Tensor | Frames, velocity: torch.Tensor) -> History:
        """The history one frame later.

        Args:
            stacked: The result of `stacked` or of `Stacks`.
            velocity: Velocity of each component from frame t to t+1 [m/frame], shape [C,3].
        """
        later = Frames(stacked.frames[1:]) if isinstance(stacked, Frames) else stacked[:, 1:]
        return History(later, torch.cat([self.velocities[:, 1:], velocity[:, None]], dim=1))


STACKS = 2
"""Number of stacks for which an array has room, if they did not overlap."""
MOST_BYTES = 2**26
"""Largest array of stacks; larger ones would take more memory than time is worth."""


def overlapping(faces: int, frames: int) -> bool:
    """Whether the stacks of so many faces and frames overlap on a CPU."""
    return 4 * STACKS * frames * FEATURES * faces <= MOST_BYTES


def copies(faces: int, frames: int, *, separate: bool, apart: bool) -> float:
    """How many stacks of so many faces and frames a CPU holds while a frame is computed, about; as for `Stacks`."""
    if overlapping(faces, frames) and not apart:
        return 1 + STACKS
    return 1 + 1 / frames if separate else 2


class Stacks:
    """Makes the stacks of one simulation. Histories are views of them, as those of `History.stacked`.

    Args:
        separate: Whether the network takes frames as tensors of their own, `Frames`.
        apart: Whether it is given them of small batches, too: see `Architecture.apart`.
    """

    def __init__(self, *, separate: bool = False, apart: bool = False) -> None:
        self._separate, self._apart = separate, separate and apart
        self._array: torch.Tensor | None = None  # [F,STACKS*H,34]
        self._end = 0  # frames that are written

    def __call__(self, history: History, newest: torch.Tensor) -> torch.Tensor | Frames:
        """The same as `history.stacked(newest)`, maybe as rows [H,34] that are not next to each other in memory, or as
        frames."""
        past = history.features
        if newest.device.type != "cpu" or newest.requires_grad:
            return history.stacked(newest)
        if isinstance(past, Frames):
            return Frames((*past.frames, newest))
        frames = past.shape[1]
        if past.requires_grad:
            return history.stacked(newest)
        if self._apart or not overlapping(len(past), frames + 1):
            return Frames((*past.unbind(1), newest)) if self._separate else history.stacked(newest)
        array, end = self._array, self._end
        if array is None or end == array.shape[1] or not _same(past, array[:, end - frames : end]):
            array, end = newest.new_empty((len(past), STACKS * (frames + 1), newest.shape[1])), frames
            array[:, :frames] = past
        array[:, end] = newest
        self._array, self._end = array, end + 1
        return array[:, end - frames : end + 1]


def _same(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether two tensors are the same memory."""
    return one.data_ptr() == other.data_ptr() and one.stride() == other.stride() and one.shape == other.shape
