"""What samples of one step and unrolled ones draw alike, and how the history of both begins.

Every sample of a batch has a stream of random numbers of its own, so that a part of a batch is the same part whoever
builds it.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeVar

import numpy as np
import torch

from .noise import NoiseConfig
from .recorded import SequenceData

Built = TypeVar("Built", covariant=True)


class Builder(Protocol[Built]):
    """What a loader needs of a builder of batches.

    Attributes:
        sequences: Training sequences.
        device: Device of the sequences, and of the batches.
        subsets: Whether the network may see some of a garment's faces; otherwise it is also shown whole garments.
    """

    sequences: list[SequenceData]
    device: torch.device
    subsets: bool

    def reaches(self, sequence: int, newest: int) -> bool:
        """Whether the recorded frames that a sample needs follow a frame."""

    def build(
        self,
        picks: list[tuple[int, int]],
        faces: int | None,
        rng: np.random.Generator,
        displacements: list[np.ndarray | None] | None = None,
        part: slice = slice(None),
    ) -> Built:
        """Builds one batch, or a part of it.

        Args:
            picks: Sequence index and newest frame of each sample.
            faces: Number of faces that the network sees at once; None: all.
            rng: Source of all randomness: sample b draws from the b-th stream it spawns.
            displacements: Per sample None or [K,V,3] metres, K <= history: an override of the newest K frames, relative
                to the recorded positions; noise comes on top.
            part: The samples to build.
        """


class Part(NamedTuple):
    """The samples of a batch that are built."""

    picks: list[tuple[int, int]]
    streams: list[np.random.Generator]
    displacements: list[np.ndarray | None]


def part_of(
    picks: list[tuple[int, int]],
    rng: np.random.Generator,
    displacements: list[np.ndarray | None] | None,
    part: slice,
) -> Part:
    """A part of a batch, each sample with the stream that it has in the whole; arguments as `Builder.build`."""
    streams = rng.spawn(len(picks))[part]
    picks = picks[part]
    return Part(picks, streams, displacements[part] if displacements else [None] * len(picks))


def displacement(
    sequence: SequenceData,
    history: int,
    noise: NoiseConfig,
    rng: np.random.Generator,
    override: np.ndarray | None,
) -> np.ndarray | None:
    """[history,V,3] metres: noise plus the override of the newest frames; None where there is neither."""
    delta = sequence.noise.displacement(history, noise, rng)
    if override is not None:
        if delta is None:
            delta = np.zeros((history, *override.shape[1:]), np.float32)
        delta[-len(override) :] += override
    return delta


class Past(NamedTuple):
    """Frames of a history; those before the first recorded one repeat it, as a cold start does."""

    frames: torch.Tensor  # int64 [H], oldest first
    early: int  # number of those before the first

    @classmethod
    def of(cls, newest: int, history: int, device: torch.device) -> Past:
        """The history that ends with a frame."""
        frames = torch.arange(newest - history + 1, newest + 1, device=device).clamp(min=0)
        return cls(frames, max(history - 1 - newest, 0))

    def held(self, delta: np.ndarray) -> np.ndarray:
        """A displacement [H,V,3] with early frames displaced as the first one is."""
        return delta[np.maximum(np.arange(len(self.frames)), self.early)]
