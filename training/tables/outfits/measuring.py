"""Rolls outfits out row by row and keeps the figures of every rollout in a file of its row.

A rollout that was measured is used again if the row, the sequence, the number of frames and the code that moves and
measures are the same; so table 5 takes what table 4 has measured, and an interrupted table goes on.
"""

from __future__ import annotations

import functools
import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import warpgarment
from warpgarment import kernels
from warpgarment.geometry.orientation import turned_outward
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.objects.body import BodyMotion
from warpgarment.training import rollouts
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.tables.protocol import plain
from warpgarment.training.train.training_set import reason_of

from .crossings import crossing_pairs
from .figures import Outfit, rollout_figures
from .rows import Row, Start

MEASURING = ("collisions", "crossings", "figures", "measuring", "rows", "static")  # modules beside this one
Mover = Callable[[Sequence, BodyMotion, Start, int], np.ndarray]


@dataclass(frozen=True)
class Case:
    """A sequence to measure.

    Attributes:
        folder: Its folder.
        sequence: The sequence.
        body: The part of its body with which cloth collides.
        faces: Faces of the body, looking outwards, [G,3].
        outfit: Its outfit.
        data: Checksum of its files.
    """

    folder: Path
    sequence: Sequence
    body: BodyMotion
    faces: np.ndarray
    outfit: Outfit
    data: str

    @classmethod
    def of(cls, folder: Path) -> Case:
        """Reads a sequence.

        Raises:
            MeshError: It cannot be read.
            ValueError: A recorded position is not finite, or there is a single frame.
        """
        sequence = Sequence.load(folder)
        body = sequence.body()
        if len(sequence) < 2:
            raise ValueError("a single frame")
        if not np.isfinite(np.asarray(sequence.vertices)).all():
            raise ValueError("recorded garment positions are not finite")
        faces = turned_outward(np.asarray(body.vertices[0]), np.asarray(body.faces), "the body")
        data = hashlib.sha256(json.dumps(sequence.manifest.get("checksums"), sort_keys=True).encode()).hexdigest()
        return cls(folder, sequence, body, faces, Outfit.of(sequence, body), data)

    def steps(self, start: Start, frames: int | None) -> int:
        """Number of frames to predict; 0 if the sequence is too short for the start.

        Args:
            start: The start.
            frames: Most frames of a start that has no number of its own.
        """
        there = min(len(self.sequence), self.body.frames) - 1 - start.newest
        if start.steps is not None:
            return start.steps if there >= start.steps else 0
        return min(there, frames or there)

    def facts(self, start: Start, steps: int) -> dict[str, Any]:
        """What is the same for all rows."""
        outfit, vertices = self.outfit, np.asarray(self.sequence.vertices[start.newest])
        pairs = outfit.owner[crossing_pairs(vertices, outfit.faces, outfit.same)]
        layers = int((pairs[:, 0] != pairs[:, 1]).sum())
        return {
            "sequence": self.folder.name, "split": self.sequence.manifest.get("split"), "start": start.name,
            "frames": steps, "data": self.data, "cell": outfit.cell, "ease_m": outfit.ease, "wind_m_s": outfit.wind,
            "garments": list(outfit.categories), "crossings_at_start": [layers, len(pairs) - layers],
        }  # fmt: skip


def measure_row(row: Row, cases: list[Case], starts: list[Start], frames: int | None, folder: Path) -> list[dict]:
    """The figures of all rollouts of a row; those that are in its file already are not made again.

    Args:
        row: The row.
        cases: The sequences.
        starts: The starts.
        frames: Most frames of rollouts of whole sequences; None for all.
        folder: Folder of the rows' files.

    Returns:
        For each sequence and start that fit: `Case.facts`, `rollout_figures`, `seconds` of the rollout, and `reason`
        where it ended with an error. A rollout that ends with an error is not finite.
    """
    file = folder / f"{row.stem}.json"
    identity = {"row": row.name, "kind": row.kind, "contact": row.contact, "apart": row.apart}
    identity |= {"network": row.checksum, "device": row.device, "code": code_checksum()}
    known = _known(file, identity)
    kept: dict[str, dict[str, Any]] = {}
    mover: Mover | None = None
    for case in tqdm(cases, desc=row.name, unit="sequence"):
        for start in starts:
            steps = case.steps(start, frames)
            if not steps:
                continue
            key = f"{start.name}/{case.folder.name}"
            found = known.get(key)
            if found is None or found["data"] != case.data or found["frames"] != steps:
                mover = mover or row.mover()
                found = case.facts(start, steps) | measured(mover, case, start, steps)
                known[key] = plain(found)
                with atomic_file(file) as temporary:
                    temporary.write_text(json.dumps({"identity": identity, "rollouts": known}, indent=1), "utf-8")
            kept[key] = known[key]
    return list(kept.values())


def measured(mover: Mover, case: Case, start: Start, steps: int) -> dict[str, Any]:
    """The figures of one rollout, and its `seconds`."""
    part = slice(start.newest + 1, start.newest + 1 + steps)
    truth = np.array(case.sequence.vertices[part], np.float32)
    began, reason = time.perf_counter(), None
    try:
        vertices = np.asarray(mover(case.sequence, case.body, start, steps))
    except Exception as error:
        reason, vertices = reason_of(error), np.full_like(truth, np.nan)
    seconds = time.perf_counter() - began
    figures = rollout_figures(case.outfit, vertices, truth, np.asarray(case.body.vertices[part]), case.faces)
    return figures | {"seconds": seconds, "reason": reason}


@functools.cache
def code_checksum() -> str:
    """Checksum of the code that moves and measures."""
    folders = [Path(str(warpgarment.__file__)).parent, Path(str(kernels.__file__)).parent]
    files = [file for folder in folders for file in folder.rglob("*.py")] + [Path(rollouts.__file__)]
    files += [Path(__file__).with_name(f"{name}.py") for name in MEASURING]
    digest = hashlib.sha256()
    for file in sorted(set(files)):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _known(file: Path, identity: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The rollouts in the file of a row; none if there is no such file or it is of another row or code."""
    try:
        content = json.loads(file.read_text("utf-8"))
        return content["rollouts"] if content["identity"] == identity else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
