"""Where the samples of a sequence are: all over it, or in pieces that a teacher went on from a network's states.

A sequence in pieces is many short ones end to end (`training/generate/on_policy.py`). Its manifest says

    "pieces": {"frames": 18, "known": 10}

so each piece has 18 frames, of which the first 10 are the network's and only the last 8 are targets.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from warpgarment.errors import MeshError


class Pieces(NamedTuple):
    """Pieces of equal length, end to end.

    Attributes:
        total: Number of frames of the sequence.
        frames: Number of frames of a piece; all of them, if the sequence is one recording.
        known: Number of frames at the start of each that are no targets.
    """

    total: int
    frames: int
    known: int

    @classmethod
    def of(cls, name: str, manifest: Mapping[str, Any], total: int) -> Pieces:
        """The pieces of a sequence.

        Args:
            name: Its name, for the error.
            manifest: Its manifest, checked by `schema`.
            total: Its number of frames.

        Raises:
            MeshError: Its frames are not a number of whole pieces.
        """
        found = manifest.get("pieces")
        if found is None:
            return cls(total, total, 1)
        if total % found["frames"]:
            raise MeshError(f"{name}: {total:,} frames are no whole number of pieces of {found['frames']:,} frames.")
        return cls(total, found["frames"], found["known"])

    @property
    def whole(self) -> bool:
        """Whether the sequence is one recording."""
        return self.frames == self.total and self.known == 1

    def newest(self, steps: int) -> np.ndarray:
        """Frames after which so many recorded ones follow in the same piece, int [N], ascending."""
        inside = np.arange(self.known - 1, self.frames - steps)
        return (np.arange(0, self.total, self.frames)[:, None] + inside).ravel()

    def reaches(self, newest: int, steps: int) -> bool:
        """Whether `newest` is one of these frames."""
        return self.known - 1 <= newest % self.frames < self.frames - steps and newest < self.total
