"""What has been done: fingerprints of jobs, and the outcome of each in a file beside the list.

The file holds a line of JSON for each job. A job is left out of a later run where a line says that it is done, with the
same fingerprint, and its outputs are as they were written (size and time). A record is needed for that: of an output
alone it cannot be seen of which garment, body and options it came.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import warpgarment
from warpgarment.errors import MeshError, UsageError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.plain import open_plain, read_plain

from .entries import Job, shape_file, written_by

LARGEST = 1 << 30  # bytes of a record
_PIECE = 1 << 20
_COMPANIONS = {  # files of the same name that are read with one
    ".pc2": (".obj", ".OBJ", ".ply", ".PLY", ".mtl"),
    ".mdd": (".obj", ".OBJ", ".ply", ".PLY", ".mtl"),
    ".obj": (".mtl",),
    ".gltf": (".bin",),
}


class Digests:
    """SHA-256 of files, each read once."""

    def __init__(self) -> None:
        self._known: dict[str, str] = {}

    def of(self, path: Path) -> str:
        """Digest of a file with those that are read with it, or of a folder with the files in it."""
        key = os.path.realpath(path)
        if key not in self._known:
            total = hashlib.sha256()
            for file in _files(Path(key)):
                total.update(f"{file.suffix} {self._file(file)}\n".encode())
            self._known[key] = total.hexdigest()
        return self._known[key]

    def _file(self, path: Path) -> str:
        total = hashlib.sha256()
        with open_plain(path) as file:
            while piece := file.read(_PIECE):
                total.update(piece)
        return total.hexdigest()


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(item for item in path.iterdir() if item.is_file())
    beside = [path.with_suffix(suffix) for suffix in _COMPANIONS.get(path.suffix.lower(), ())]
    return [path, *(file for file in beside if file.is_file())]


def fingerprint(job: Job, network: str, digests: Digests) -> str:
    """What a result depends on, as one number: options, the bytes of all inputs, the network and the version.

    Not the device, nor what other jobs there are. Files that a file names (textures, sublayers of USD) do not count.

    Args:
        job: The job.
        network: Digest of the network.
        digests: Digests of files.

    Raises:
        MeshError, OSError: An input cannot be read.
    """
    shot = job.known.shot
    inputs = [digests.of(file) for file in shot.files]
    more = [digests.of(file) for file in (shot.fit_rest, shot.wind_file, shape_file(shot)) if file is not None]
    materials = [None if material is None else material.as_dict() for material in job.known.materials]
    told = {name: value for name, value in job.told.items() if name not in ("name", "material")}
    held = [told, materials, inputs, more, network, warpgarment.__version__]
    return hashlib.sha256(json.dumps(held, sort_keys=True, ensure_ascii=True).encode()).hexdigest()


def outputs_of(job: Job) -> list[dict[str, Any]]:
    """Path, size and time of what a job has written; empty where something of it is not there."""
    found = []
    for path in written_by(job.known):
        try:
            parts = [item.stat() for item in path.iterdir()] if path.is_dir() else [path.stat()]
        except OSError:
            return []
        if not parts:
            return []
        size, time = sum(part.st_size for part in parts), max(part.st_mtime_ns for part in parts)
        found.append({"path": str(path), "files": len(parts), "bytes": size, "modified": time})
    return found


class Record:
    """The outcome of jobs, kept in a file that is written anew whenever it changes.

    Args:
        path: The file, which may be there from an earlier run.

    Attributes:
        broken: Number of lines of it that could not be read.

    Raises:
        UsageError: The file is something else.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.broken = path, 0
        self._earlier: dict[str, dict[str, Any]] = {}
        self._entries: dict[int, dict[str, Any]] = {}
        if not path.exists():
            return
        try:
            rows = [row for row in read_plain(path, LARGEST).decode().split("\n") if row.strip()]
        except (MeshError, UnicodeDecodeError):
            rows = [""]
        found = [_entry(row) for row in rows]
        if rows and not any(found):
            raise UsageError(f"{path} is no record of jobs, and would be written over. Choose another with --results.")
        self.broken = found.count(None)
        self._earlier = {entry["fingerprint"]: entry for entry in found if entry is not None}

    def done(self, job: Job, mark: str) -> dict[str, Any] | None:
        """The entry of a job that an earlier run did, and whose outputs are as it left them; None: it is to be run."""
        entry = self._earlier.get(mark)
        if entry is None or entry.get("state") != "done":
            return None
        present = outputs_of(job)
        return entry if present and present == entry.get("outputs") else None

    def add(self, entries: Iterable[Mapping[str, Any]]) -> None:
        """Takes down outcomes, which have "line", "fingerprint" and "state", and writes the file.

        Entries of earlier runs stay until their job has a new one, so that a run that is stopped loses none.

        Raises:
            OutputError: The file cannot be written.
        """
        for entry in entries:
            self._entries[entry["line"]] = dict(entry)
        marks = {entry["fingerprint"] for entry in self._entries.values()}
        waiting = [entry for mark, entry in self._earlier.items() if mark not in marks]
        rows = [self._entries[line] for line in sorted(self._entries)] + (waiting if self._open else [])
        with atomic_file(self.path) as temporary:
            temporary.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")

    _open = True

    def close(self) -> None:
        """Drops what earlier runs left of jobs that are in the list no more, and writes the file."""
        self._open = False
        self.add(())


def _entry(row: str) -> dict[str, Any] | None:
    try:
        found = json.loads(row)
    except (ValueError, RecursionError):
        return None
    known = isinstance(found, dict) and isinstance(found.get("fingerprint"), str) and "state" in found
    return found if known else None
