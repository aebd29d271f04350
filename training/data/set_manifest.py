"""`set.json`: the options common to all sequences of a data set, so that two sets are never mixed in one folder."""

from __future__ import annotations

import importlib.metadata
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from warpgarment.errors import MeshError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.plain import read_json
from warpgarment.training.teachers import TEACHERS

from .schema import SET, Kind, faults

SET_MANIFEST = "set.json"
_SIMULATE = dict.fromkeys(package for teacher in TEACHERS.values() for package in teacher.packages)
PACKAGES = ("warpgarment", *_SIMULATE, "anny", "numpy", "scipy", "libigl", "gpytoolbox")


class DatasetMismatch(ValueError):
    """The folder holds a data set made with other options."""


def write_set_manifest(
    root: str | Path,
    configuration: Mapping[str, Any],
    teacher: Mapping[str, Any],
    *,
    numbers: Iterable[int] = (),
    command: str = "",
    versions: Mapping[str, str | None] | None = None,
) -> dict[str, Any]:
    """Writes the options common to all sequences of a set, or checks that they agree with an existing `set.json`.

    Args:
        root: Folder of the data set; it is made if it is missing.
        configuration: Options that determine the sequences, as plain values; `verify` and `card` read `recipe`, `seed`
            and `held_out` (categories that are only tested on).
        teacher: Settings of the teacher, as plain values.
        numbers: Numbers of the planned sequences; they are added to those that were planned before.
        command: Command that makes the set again.
        versions: Versions of packages by name; None for the installed versions of those that data are made with.

    Returns:
        The manifest as it is in the folder.

    Raises:
        DatasetMismatch: The set in the folder has another configuration or teacher; the error names the fields.
        MeshError: The manifest in the folder is damaged.
    """
    content = {
        "configuration": dict(configuration),
        "teacher": dict(teacher),
        "versions": package_versions() if versions is None else dict(versions),
        "command": command,
    }
    new: dict[str, Any] = json.loads(json.dumps(content))  # in the types of the file, where tuples are lists
    planned = set(numbers)
    old = read_set_manifest(root)
    if old is not None:
        _check_same(Path(root), old, new)
        planned |= set(planned_numbers(old))
        new |= {key: old[key] for key in ("versions", "command") if old.get(key)}
    new["numbers"] = _ranges(planned)
    with atomic_file(Path(root) / SET_MANIFEST) as temporary:
        temporary.write_text(json.dumps(new, indent=1), "utf-8")
    return new


def _check_same(root: Path, old: dict[str, Any], new: dict[str, Any]) -> None:
    different = []
    for part in ("configuration", "teacher"):
        before, now = old.get(part, {}), new[part]
        for key in sorted({*before, *now}):
            if before.get(key) != now.get(key):
                different.append(f"{key} was {_short(before.get(key))}, is {_short(now.get(key))}")
    if different:
        raise DatasetMismatch(
            f"{root} holds a set made with other options: {'; '.join(different)}. Choose another folder or the same "
            "options."
        )


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def read_set_manifest(root: str | Path) -> dict[str, Any] | None:
    """The manifest that `write_set_manifest` wrote; None if the folder has none.

    Raises:
        MeshError: The manifest is damaged.
    """
    path = Path(root) / SET_MANIFEST
    return read_checked(path, SET) if os.path.lexists(path) else None


def read_checked(path: Path, kinds: Mapping[str, Kind] | None) -> dict[str, Any]:
    """A manifest from a file.

    Args:
        path: The file.
        kinds: Kinds of the entries, from `schema`; None leaves them unchecked.

    Raises:
        MeshError: The file is missing, is not a plain file, is larger or more deeply nested than `io.disk.plain`
            allows, or is not a JSON object; or an entry is of another kind, which the message names.
    """
    try:
        content = read_json(path)
    except OSError as error:
        raise MeshError(f"{path.parent} holds no readable {path.name} ({error.strerror}).") from error
    except MeshError as error:
        raise MeshError(f"{path.parent} holds no readable {path.name} ({error})") from None
    if not isinstance(content, dict):
        raise MeshError(f"{path.parent} holds no readable {path.name} (not a JSON object).")
    wrong = faults(content, kinds or {})
    if wrong:
        raise MeshError(f"{path}: {next(iter(wrong.values()))}. It is damaged: write it again.")
    return content


def planned_numbers(manifest: Mapping[str, Any]) -> list[int]:
    """Numbers of all sequences planned so far."""
    return [n for first, last in manifest.get("numbers", []) for n in range(first, last + 1)]


def _ranges(numbers: Iterable[int]) -> list[list[int]]:
    """{0, 1, 2, 5} -> [[0, 2], [5, 5]]."""
    ranges: list[list[int]] = []
    for n in sorted(numbers):
        if ranges and n == ranges[-1][1] + 1:
            ranges[-1][1] = n
        else:
            ranges.append([n, n])
    return ranges


def package_versions(names: Iterable[str] = PACKAGES) -> dict[str, str | None]:
    """Installed versions of packages by name, None for a package that is not installed."""
    return {name: _version(name) for name in names}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
