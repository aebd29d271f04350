"""The random draws and the histories that single-step and unrolled samples have in common.

Every sample of a batch has its own stream of random numbers, so a part of a batch does not depend on the process that
builds it.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import torch

from .noise import NoiseBasis, NoiseConfig

Built = TypeVar("Built", covariant=True)


class Noised(Protocol):
    """A training sequence whose history can be displaced."""

    @property
    def noise(self) -> NoiseBasis:
        """Smooth random fields of its garments."""


class Builder(Protocol[Built]):
    """The interface of a builder of batches for a loader.

    Attributes:
        sequences: Training sequences, `SequenceData` or `OutfitData`.
        device: Device of the sequences, and of the batches.
        subsets: Whether the network can always be trained on some of a garment's faces. If not, whole garments are
            built once garments are no longer split.
    """

    sequences: list[Any]
    device: torch.device
    subsets: bool

    def reaches(self, sequence: int, newest: int) -> bool:
        """Whether enough recorded frames follow the frame `newest` of a sequence for a sample."""

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
            faces: Number of faces that the network sees at once; None for all.
            rng: Source of all randomness: sample b draws from the b-th stream that it spawns.
            displacements: For each sample None, or displacements of the newest K frames from the recorded positions
                [m], shape [K,V,3] with K <= history; noise is added to them.
            part: Slice of the samples to build.
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
    """A part of a batch, each sample with its stream in the whole batch; the arguments are those of `Builder.build`."""
    streams = rng.spawn(len(picks))[part]
    picks = picks[part]
    return Part(picks, streams, displacements[part] if displacements else [None] * len(picks))


def displacement(
    sequence: Noised,
    history: int,
    noise: NoiseConfig,
    rng: np.random.Generator,
    override: np.ndarray | None,
) -> np.ndarray | None:
    """Displacement of a history [m], shape [history,V,3]: noise plus `override` of the newest frames; or None."""
    delta = sequence.noise.displacement(history, noise, rng)
    if override is not None:
        if delta is None:
            delta = np.zeros((history, *override.shape[1:]), np.float32)
        newest = override[-history:]
        delta[-len(newest) :] += newest
    return delta


class Past(NamedTuple):
    """Frames of a history. Frames before the first recorded one repeat it, as in a cold start."""

    frames: torch.Tensor  # int64 [H], oldest first
    early: int  # number of frames before the first recorded one

    @classmethod
    def of(cls, newest: int, history: int, device: torch.device) -> Past:
        """The history that ends with a frame."""
        frames = torch.arange(newest - history + 1, newest + 1, device=device).clamp(min=0)
        return cls(frames, max(history - 1 - newest, 0))

    def held(self, delta: np.ndarray) -> np.ndarray:
        """A displacement [H,V,3] in which the early frames have that of the first recorded one."""
        return delta[np.maximum(np.arange(len(self.frames)), self.early)]
