"""The garments of `simulate` and `dress`: which files and meshes they are, and where each is written."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from warpgarment.errors import UsageError
from warpgarment.io.disk.outputs import names_folder
from warpgarment.io.files import suffixes
from warpgarment.io.together import TOGETHER, write_together
from warpgarment.objects.motion import GarmentMotion

from .outputs import Folder, check_output

PATTERN = "{name}"


class Piece(NamedTuple):
    """One garment: its file, the name of the mesh in it if that was given, and its own name, which no other has."""

    file: Path
    mesh: str | None
    name: str


def pieces_of(files: Sequence[Path], meshes: Sequence[str], *, verb: str = "simulate") -> list[Piece]:
    """The garments of files and names of meshes: as many of each, or one file with several meshes.

    Args:
        files: Files of the garments.
        meshes: Names of meshes in them.
        verb: What was given them, for the message.

    Raises:
        UsageError: There is no file, or the numbers do not fit.
    """
    if not files:
        raise UsageError(f"{verb} was given one file. Name garments, innermost first, and then the body.")
    if len(meshes) > 1 and len(files) == 1:
        files = list(files) * len(meshes)
    if meshes and len(meshes) != len(files):
        raise UsageError(
            f"{len(files)} garments and {len(meshes)} of --garment-mesh. Give one for each garment, or one file with "
            "several."
        )
    found: list[Piece] = []
    for number, file in enumerate(files):
        mesh = meshes[number] if meshes else None
        name = file.stem if mesh in (None, "*") else str(mesh)
        name = plain = re.sub(r"[^\w.-]+", "_", name).strip(".") or "garment"
        for other in range(2, len(found) + 3):
            if all(name != piece.name for piece in found):
                break
            name = f"{plain}_{other}"
        found.append(Piece(file, mesh, name))
    return found


def outputs_of(
    out: Path,
    pieces: Sequence[Piece],
    inputs: Sequence[Path | None],
    *,
    writer: Literal["write_mesh", "write_motion"] = "write_motion",
) -> dict[str, Path]:
    """Where each garment is written, by its name; all in one file, or each in a file of its own.

    Args:
        out: As it was typed: a .usd or .abc for all garments, or with {name} for the name of each.
        pieces: The garments.
        inputs: Files that are read.
        writer: What writes them, see `io.files.suffixes`.

    Raises:
        UsageError: Several garments, and one file that cannot hold them.
        OutputError, FileExistsError, MissingExtra: As of `check_output`.
    """
    typed = str(out)
    if PATTERN in typed:
        folder = names_folder(out)
        paths = {piece.name: typed.replace(PATTERN, piece.name) for piece in pieces}
        found = {name: Folder(path) if folder else Path(path) for name, path in paths.items()}
    elif len(pieces) == 1 or out.suffix.lower() in TOGETHER:
        found = {piece.name: out for piece in pieces}
    else:
        raise UsageError(
            f"--out {typed}: {len(pieces)} garments do not go into one {out.suffix or 'folder of OBJ'}. Write them "
            f"into one .usd or .abc, or each into a file of its own: {PATTERN}{out.suffix or '/'} has their names."
        )
    for path in dict.fromkeys(found.values()):
        check_output(path, suffixes(writer), inputs)
    return found


def save(motions: Mapping[str, GarmentMotion], outputs: Mapping[str, Path]) -> None:
    """Writes each garment to its file, or all of them to the one that all are for."""
    if len(motions) == 1 or len(set(outputs.values())) > 1:
        for name, motion in motions.items():
            motion.save(outputs[name])
        return
    frames = min(motion.frames for motion in motions.values())  # one that failed ends earlier
    first = next(iter(motions.values()))
    meshes = [(name, motion.vertices[:frames], motion.faces) for name, motion in motions.items()]
    surfaces = [motion.surface for motion in motions.values()]
    write_together(next(iter(outputs.values())), meshes, first.fps, surfaces, start=first.clock.number)
