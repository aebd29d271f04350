"""Lists of jobs: a line of JSON for each, checked as a whole before anything runs."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from warpgarment.cli.outputs import Folder
from warpgarment.cli.shot import Checked, Shot, checked
from warpgarment.errors import MeshError, MissingExtra, UsageError
from warpgarment.io.data import UNITS
from warpgarment.io.disk.outputs import names_folder
from warpgarment.io.disk.plain import read_plain
from warpgarment.io.files import CACHES, listed, suffixes

from . import checks
from .checks import in_short, key_of, object_of

LARGEST = 256 << 20  # bytes of a list
MOST_PINS = 1 << 24  # vertex indices stay below this


class Job(NamedTuple):
    """A line of a list.

    Attributes:
        line: Number of the line, from 1.
        name: Name of the job, for people.
        known: The shot.
        told: What the line says, with the options beside the list, as values of JSON: what a result depends on.
    """

    line: int
    name: str
    known: Checked
    told: dict[str, Any]


class Fault(NamedTuple):
    """A line that cannot run, and why."""

    line: int
    text: str


def read_jobs(path: Path, beside: Shot) -> tuple[list[Job], list[Fault]]:
    """The jobs of a list, and all of its faults.

    Paths in it start from the folder of the list. Empty lines are left out.

    Args:
        path: The list, JSON Lines in UTF-8.
        beside: Options of every job that says nothing else.

    Raises:
        UsageError: It is no text, is larger than 256 MB, or has no job.
        FileNotFoundError: There is no such file.
    """
    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    try:
        text = read_plain(path, LARGEST, text=True).decode("utf-8-sig")
    except (MeshError, UnicodeDecodeError) as error:
        raise UsageError(f"--jobs {path}: no list of jobs: {error}") from None
    jobs, faults = [], []
    for line, row in enumerate(text.split("\n"), 1):
        if not row.strip():
            continue
        try:
            jobs.append(_job(line, row, path.parent, beside))
        except (UsageError, OSError, MissingExtra, MeshError) as error:
            faults.append(Fault(line, _as_keys(" ".join(str(error).split()))))
    if not jobs and not faults:
        raise UsageError(f'--jobs {path}: it holds no job. Write a line such as {{"garment": "a.obj", "body": ...}}.')
    return jobs, sorted(faults + _meeting(jobs))


def _job(line: int, row: str, folder: Path, beside: Shot) -> Job:
    told = {key_of(name): value for name, value in object_of(row).items()}
    told = {name: value for name, value in told.items() if value is not None}
    unknown = [name for name in told if name not in _KEYS]
    if unknown:
        near = difflib.get_close_matches(unknown[0], _KEYS, 1)
        others = "".join(f", nor {name!r}" for name in unknown[1:])
        raise UsageError(
            f"a job has no {unknown[0]!r}{others}. "
            + (f"Is it {near[0]!r}?" if near else f"It has {', '.join(_KEYS)}.")
        )
    for short, long in (("garment", "garments"), ("material", "materials")):
        if short in told and long in told:
            raise UsageError(f"{short!r} and {long!r}: give one of them.")
        told = {short if name == long else name: value for name, value in told.items()}
    missing = [name for name in ("garment", "body", "out") if name not in told]
    if missing:
        raise UsageError(f"{' and '.join(map(repr, missing))} missing. A job has at least garment, body and out.")
    values = {name: _KEYS[name](name, value) for name, value in told.items()}
    shot = replace(beside, **_of_shot(values, folder, beside))
    materials = _materials(values["material"], folder) if "material" in values else None
    known = checked(shot, materials, _pins(values.get("pins"), len(shot.files) - 1, len(shot.garment_mesh)))
    _check_inputs(shot)
    given = {name: _plain(getattr(beside, name)) for name in _OPTIONS if getattr(beside, name) not in (None, (), False)}
    return Job(line, values.get("name") or Path(told["out"]).name or f"line {line}", known, given | told)


def _as_keys(text: str) -> str:
    """A message with keys of jobs in place of options of the command line."""
    return re.sub(r"--(?!weights|device)([a-z][a-z-]*)", lambda found: found[1].replace("-", "_"), text)


_KEYS: dict[str, Callable[[str, Any], Any]] = {
    "garment": checks.texts,
    "garments": checks.texts,
    "body": checks.text,
    "out": checks.text,
    "name": checks.text,
    "pins": checks.anything,
    "layers": checks.flag,
    "material": checks.anything,
    "materials": checks.anything,
    "wind": checks.three,
    "wind_file": checks.text,
    "wind_fps": checks.positive,
    "unit": checks.one_of(*UNITS),
    "body_unit": checks.one_of(*UNITS),
    "up": checks.one_of("y", "z"),
    "body_up": checks.one_of("y", "z"),
    "body_fps": checks.positive,
    "garment_mesh": checks.texts,
    "body_mesh": checks.text,
    "body_shape": checks.text,
    "clean": checks.flag,
    "fit_rest": checks.text,
    "dress": checks.flag,
    "frames": checks.count,
    "out_fps": checks.rate,
}
_PATHS = ("wind_file", "fit_rest")
_OPTIONS = [field.name for field in fields(Shot) if field.name not in ("files", "out")]


def _of_shot(values: dict[str, Any], folder: Path, beside: Shot) -> dict[str, Any]:
    """Fields of a shot from the values of a job."""
    found = {name: value for name, value in values.items() if name in _OPTIONS and name != "material"}
    for name in _PATHS:
        if name in found:
            found[name] = folder / found[name]
    if str(found.get("body_shape", "")).endswith(".npz"):
        found["body_shape"] = os.fspath(folder / found["body_shape"])
    if "wind" in found and "wind_file" not in found:
        found |= {"wind_file": None, "wind_fps": None}  # in place of those beside the list
    if "wind_file" in found and "wind" not in found:
        found["wind"] = None
    out = os.fspath(folder / values["out"])
    found["out"] = Folder(out) if names_folder(values["out"]) else Path(out)
    found["files"] = tuple(folder / file for file in (*values["garment"], values["body"]))
    return found


def _materials(value: Any, folder: Path) -> list[Any]:
    """Materials of a job, for `materials_of`."""
    items = value if isinstance(value, list) else [value]
    if not items:
        raise UsageError("'material' is an empty list.")
    is_file = [isinstance(item, str) and item.lower().endswith(".json") for item in items]
    return [os.fspath(folder / item) if file else item for item, file in zip(items, is_file, strict=True)]


def _pins(value: Any, files: int, meshes: int) -> list[Any]:
    """Pins of each garment."""
    if value is None:
        return []
    if not isinstance(value, list) or not value:
        raise UsageError(
            f"'pins' must be a list of numbers of vertices, or a list of such lists, got {in_short(value)}."
        )
    count = max(files, meshes)
    each = value if any(item is None or isinstance(item, list) for item in value) else [value]
    if len(each) != count:
        raise UsageError(f"{len(each)} lists of 'pins' for {count} garments. Give one for each, null for none.")
    for item in each:
        if item is not None and not (
            isinstance(item, list) and all(type(vertex) is int and 0 <= vertex < MOST_PINS for vertex in item)
        ):
            raise UsageError(f"'pins' must be numbers of vertices, counted from 0, got {in_short(item)}.")
    return each


def _check_inputs(shot: Shot) -> None:
    """Refuses files that are not there, or of no format that is read."""
    for file in (*shot.files, shot.fit_rest, shot.wind_file, shape_file(shot)):
        if file is not None and not file.exists():
            raise FileNotFoundError(f"no such file: {file}.")
    last = (shot.files[-1], *([] if shot.fit_rest is None else [shot.fit_rest]))
    for files, able in ((shot.files[:-1], suffixes("read_mesh")), (last, suffixes("read_motion"))):
        for file in files:
            if ("" if file.is_dir() else file.suffix.lower() or ".") not in able:
                raise UsageError(f"{file}: cannot read {file.suffix or 'this'}; use {listed(able)}.")


def shape_file(shot: Shot) -> Path | None:
    """The file of the body that a skeleton moves; None where it is no file."""
    name = shot.body_shape or ""
    return Path(name) if name.endswith(".npz") else None


def _meeting(jobs: Sequence[Job]) -> list[Fault]:
    """Faults of jobs of which one writes what another writes or reads."""
    writer: dict[str, int] = {}
    faults = []
    for job in jobs:
        for path in written_by(job.known):
            first = writer.setdefault(os.path.realpath(path), job.line)
            if first != job.line:
                faults.append(Fault(job.line, f"{path} is written by line {first} too. Give each job its own out."))
                break
    for job in jobs:
        shot = job.known.shot
        for file in (*shot.files, shot.fit_rest, shot.wind_file):
            line = None if file is None else writer.get(os.path.realpath(file))
            if line is not None:
                faults.append(
                    Fault(job.line, f"{file} is read, and line {line} writes it. Run one list after another.")
                )
                break
    return faults


def written_by(known: Checked) -> list[Path]:
    """Files and folders that a shot writes, and that make its result."""
    found: list[Path] = []
    for path in dict.fromkeys(map(str, known.outputs.values())):
        plain = Path(path)
        found += [plain, *([plain.with_suffix(".obj")] if plain.suffix.lower() in CACHES else [])]
    return found


def _plain(value: Any) -> Any:
    """A value of an option as one of JSON."""
    return (
        [_plain(item) for item in value]
        if isinstance(value, tuple)
        else str(value)
        if isinstance(value, Path)
        else value
    )
