"""The sequences of a run. Unusable ones are skipped, and the reasons kept, so that bad data never ends a run."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from warpgarment.errors import MeshError
from warpgarment.nn.architecture import architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.objects.body import BodyMotion
from warpgarment.training.data.sequence import Sequence, list_sequences, read_manifest
from warpgarment.training.distributed import Group
from warpgarment.training.rollouts import check_rate
from warpgarment.training.samples.interactions import UnusableSequence, cached, default_cache
from warpgarment.training.samples.outfits import OutfitData
from warpgarment.training.samples.recorded import SequenceData

from .config import TrainConfig

SAME_DATA = "All machines must see the same data folder; compare it with `warpgarment dataset verify`."


class NoTrainingData(ValueError):
    """No sequence can be trained on; the message gives the first reasons."""


def load_sequences(
    config: TrainConfig, network: NetworkConfig, skipped: dict[str, str], group: Group
) -> list[SequenceData] | list[OutfitData]:
    """Loads the training sequences, with their cached interactions if the network reads features of faces; adds
    unusable ones and the reasons to `skipped`. Of an outfit, such a network gets the garments one by one, as in
    simulations.

    Raises:
        NoTrainingData: No sequence can be used.
        GroupError: Processes found different sequences.
    """
    cache = Path(config.cache) if config.cache else default_cache(Path(config.data))
    folders = folders_of(Path(config.data), "train", skipped)[: config.max_sequences]
    positions = architecture(network.architecture).positions
    if group.size > 1 and not positions:  # each process fills a share of the cache, then all read it
        for folder in _watched(folders[group.rank :: group.size], group):
            try:
                cached(Sequence.load(folder), folder, cache, group.device)
            except Exception as error:
                reason_of(error)
        group.wait()
    sequences: list = []
    for folder in _watched(folders, group):
        try:
            loaded = Sequence.load(folder)
            check_rate(loaded.fps, network.fps)
            if positions:
                sequences.append(OutfitData(loaded, folder, network, group.device))
                continue
            if not loaded.manifest.get("recorded", True) and not config.cloth.physics:
                raise UnusableSequence("it has no recording; cloth.physics gives a loss to such sequences")
            count = len(loaded.layers)
            sequences += [
                SequenceData(loaded, folder, cache, network, group.device, number if count > 1 else None)
                for number in range(count)
            ]
        except Exception as error:
            skipped[folder.name] = reason_of(error)
    names = "\n".join(f"{s.name} {len(s.faces)} {s.count}" for s in sequences)
    group.agree("the checksum of the usable sequences", zlib.crc32(names.encode()), SAME_DATA)
    if not sequences:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3])
        found = f"{len(folders)} training sequences, none usable" if folders else "no training sequences"
        raise NoTrainingData(f"{config.data}: {found}{f' ({reasons})' if reasons else ''}")
    return sequences


def load_validation(
    config: TrainConfig, skipped: dict[str, str], fps: float = 30.0
) -> list[tuple[Sequence, BodyMotion, int]]:
    """A few validation sequences, evenly spread over the list: (sequence, body, number of frames to predict).

    Sequences whose frames per second are not `fps`, those of the network, are skipped.
    """
    folders = folders_of(Path(config.data), "validation", skipped)
    wanted = min(config.validate_sequences, len(folders))
    chosen = [folders[(i * len(folders)) // wanted] for i in range(wanted)]
    found = []
    for folder in chosen:
        try:
            sequence = Sequence.load(folder)
            body = sequence.body()
            check_rate(body.fps, fps)
            frames = min(len(sequence.vertices), body.frames, config.validate_frames + 1)
            if frames < 2 or not np.isfinite(np.asarray(sequence.vertices[:frames])).all():
                raise ValueError("too short, or not finite")
            found.append((sequence, body, frames - 1))
        except Exception as error:
            skipped[folder.name] = reason_of(error)
    return found


def folders_of(root: Path, split: str | None, skipped: dict[str, str]) -> list[Path]:
    """Folders of the good sequences of a split (None: of all splits), as from `list_sequences`. But if a manifest is
    missing or cannot be read, only its sequence is left out; `skipped` gets the reason.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    if not root.is_dir():
        return list_sequences(root)  # raises FileNotFoundError with a remedy
    found = []
    for folder in sorted(path for path in root.glob("[!.]*") if path.is_dir()):
        try:
            manifest = read_manifest(folder)
        except MeshError as error:
            if any(folder.glob("*.npy")):  # a folder without arrays is not a sequence
                skipped[folder.name] = str(error)
            continue
        if split in (None, manifest.get("split")) and manifest.get("status") == "good":
            found.append(folder)
    return found


def report(skipped: dict[str, str]) -> str:
    """Text with the number of skipped sequences and a line with the reason for each; empty without any."""
    if not skipped:
        return ""
    lines = [f"  {name}: {reason}" for name, reason in sorted(skipped.items())]
    return "\n".join([f"{len(skipped)} sequence{'s' if len(skipped) > 1 else ''} skipped:", *lines])


def reason_of(error: Exception) -> str:
    """The reason for skipping a sequence, as text.

    Raises:
        MemoryError, torch.OutOfMemoryError: The error itself is raised again, since the data are not the cause.
    """
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        raise error
    return f"{type(error).__name__}: {error}"


def _watched(folders: list[Path], group: Group) -> Iterable[Path]:
    return tqdm(folders, desc="sequences", unit="", leave=False, disable=not group.first)
