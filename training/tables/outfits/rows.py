"""The rows of tables 4 and 5: what is measured, and how it moves an outfit."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from warpgarment.nn import checkpoint
from warpgarment.objects.body import BodyMotion
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.rollouts import predict, rigid, skinned

from .static import StaticGarment

APART = ", garments apart"


@dataclass(frozen=True)
class Start:
    """A start of rollouts.

    Attributes:
        name: "window" or "whole".
        newest: Newest recorded frame that is an input.
        steps: Most frames predicted; None for all that there are.
        cold: Whether that frame is the only one that is an input.
    """

    name: str
    newest: int
    steps: int | None
    cold: bool


WINDOW = Start("window", 60, 35, False)
WHOLE = Start("whole", 0, None, True)


class Missing(ValueError):
    """A named network was not given, or two cannot be told apart."""


@dataclass(frozen=True)
class Row:
    """A row.

    Attributes:
        name: Its name in the table.
        kind: "recording", "skinned", "rigid", "static" or "network".
        file: Checkpoint of a network.
        contact: Whether garments are kept from crossing each other and themselves.
        apart: Whether each garment is alone on its body.
        device: Device of a network.
    """

    name: str
    kind: str
    file: Path | None = None
    contact: bool = False
    apart: bool = False
    device: str | None = None

    @property
    def stem(self) -> str:
        """Name of its file, without suffix: letters and digits of its name."""
        return re.sub(r"[^a-z0-9]+", "_", self.name.lower()).strip("_")

    @cached_property
    def checksum(self) -> str | None:
        """sha256 of the checkpoint."""
        if self.file is None:
            return None
        files = sorted(self.file.glob("*.safetensors")) if self.file.is_dir() else [self.file]
        return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()

    def mover(self) -> Callable[[Sequence, BodyMotion, Start, int], np.ndarray]:
        """A function that moves the outfit of a sequence.

        Its arguments are the sequence, its body, the start, and a number of frames; it returns the frames after
        `start.newest` [m], float32 [T,V,3].

        Raises:
            CheckpointError: The network cannot be read.
        """
        if self.kind == "network":
            assert self.file is not None
            simulator = Simulator(checkpoint.load(self.file), self.device)

            def simulated(sequence: Sequence, body: BodyMotion, start: Start, steps: int) -> np.ndarray:
                return predict(
                    simulator, sequence, start.newest, steps, cold=start.cold, body=body,
                    layers=self.contact, apart=self.apart,
                )  # fmt: skip

            return simulated
        if self.kind == "static":
            assert self.file is not None
            network = StaticGarment.load(self.file)

            def posed(sequence: Sequence, body: BodyMotion, start: Start, steps: int) -> np.ndarray:
                part = slice(start.newest + 1, start.newest + 1 + steps)
                return network.posed(sequence, body, np.asarray(body.vertices[part]))

            return posed
        return self._without_network

    def _without_network(self, sequence: Sequence, body: BodyMotion, start: Start, steps: int) -> np.ndarray:
        newest = start.newest
        if self.kind == "recording":
            return np.array(sequence.vertices[newest + 1 : newest + 1 + steps], np.float32)
        first = np.array(sequence.vertices[newest], np.float32)
        part = BodyMotion(body.vertices[newest : newest + steps + 1], body.faces, body.fps)
        return {"skinned": skinned, "rigid": rigid}[self.kind](sequence.garment, first, part)[1:]


def rows_of(
    networks: dict[str, str], *, contact: bool, apart: tuple[str, ...], static: Path | None, device: str | None
) -> list[Row]:
    """The rows of a table, in its order.

    Args:
        networks: Name -> checkpoint file, folder, or name of a network that ships.
        contact: Whether each network also has a row with contact between garments.
        apart: Names of networks that also have a row with garments apart.
        static: Checkpoint of the static baseline.
        device: Device of the networks.

    Raises:
        Missing: A name in `apart` is no network, or two rows would have one file.
        CheckpointError: There is no such network.
    """
    unknown = [name for name in apart if name not in networks]
    if unknown:
        raise Missing(f"--apart {unknown[0]}: there is no --network {unknown[0]}=CHECKPOINT")
    rows = [Row("recording", "recording")]
    for name, place in networks.items():
        row = Row(name, "network", checkpoint.find(place, device=device), device=device)
        rows.append(row)
        if contact:
            rows.append(replace(row, name=f"{name}, contact", contact=True))
        if name in apart:
            rows.append(replace(row, name=name + APART, apart=True))
    if static is not None:
        rows.append(Row("static (DeePSD-like)", "static", Path(static)))
    rows += [Row("skinned", "skinned"), Row("rigid", "rigid")]
    first: dict[str, str] = {}
    for row in rows:
        if first.setdefault(row.stem, row.name) != row.name:
            raise Missing(
                f"the rows {first[row.stem]!r} and {row.name!r} would share the file {row.stem}.json; the letters and "
                "digits of names must differ"
            )
    return rows
