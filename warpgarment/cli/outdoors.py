"""Materials and wind, as they are given on the command line."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError, UsageError
from warpgarment.io.disk.plain import read_json, read_plain
from warpgarment.io.npz import read_npz
from warpgarment.objects.material import Material
from warpgarment.objects.wind import Wind

LARGEST = 16 << 20  # bytes of a table of wind
NONE = "none"  # a garment without a material


def materials_of(words: Sequence[Any], count: int) -> list[Material | None]:
    """A material, or None, for each garment; an empty list if none is given.

    Args:
        words: Of each garment, or once for all: the name of a preset ("cotton"), assignments ("density=0.3,bend=1e-3"),
            a preset and assignments ("cotton,bend=0.01"), "none", or a .json file with an object of assignments, or a
            list of objects, names and nulls. In lists of jobs also an object of assignments, or None for "none".
        count: Number of garments.

    Raises:
        UsageError: Another number of materials, a name or a field that does not exist, or a number that cannot be.
    """
    found: list[Material | None] = []
    for word in words:
        if isinstance(word, str):
            found += _from_file(Path(word)) if word.lower().endswith(".json") else [_from_word(word)]
        else:
            found.append(_from_item("--material", word))
    if len(found) == 1:
        return found * count
    if found and len(found) != count:
        raise UsageError(
            f"--material: {len(found)} materials and {count} garment{'s' if count > 1 else ''}. Give one for each "
            f"({NONE} for a garment without), or a single one for all."
        )
    return found


def _from_word(word: str) -> Material | None:
    if word == NONE:
        return None
    first, *rest = word.split(",")
    named, assigned = (first, rest) if "=" not in first else ("", [first, *rest])
    values: dict[str, Any] = {}
    for part in assigned:
        name, equals, value = part.partition("=")
        try:
            values[name.strip()] = float(value)
        except ValueError:
            raise UsageError(f"--material {word}: {part!r} is no assignment of a number, such as bend=0.001.") from None
        if not equals:
            raise UsageError(f"--material {word}: {part!r} is no assignment of a number, such as bend=0.001.")
    return _material(f"--material {word}", named, values)


def _from_file(path: Path) -> list[Material | None]:
    try:
        held = read_json(path)
    except MeshError as error:
        raise UsageError(f"--material: {error}") from None
    found: list[Material | None] = []
    for item in held if isinstance(held, list) else [held]:
        found.append(_from_item(f"--material {path}", item))
    if not found:
        raise UsageError(f"--material {path}: an empty list. Give a material for each garment.")
    return found


def _from_item(where: str, item: Any) -> Material | None:
    """The material of a value of JSON."""
    if item is None or isinstance(item, str):
        return None if item is None else _from_word(item)
    numbers = isinstance(item, dict) and all(
        isinstance(value, (int, float)) and not isinstance(value, bool) for value in item.values()
    )
    if not numbers:
        raise UsageError(f"{where}: {str(item)[:60]} is no object of numbers, such as {{'density': 0.3}}.")
    return _material(where, "", item)


def _material(where: str, named: str, values: dict[str, Any]) -> Material:
    known = [field.name for field in fields(Material)]
    unknown = [name for name in values if name not in known]
    if unknown:
        raise UsageError(f"{where}: materials have no {unknown[0]!r}. They have {', '.join(known)}.")
    try:
        base = Material.preset(named) if named else Material()
        return Material(**(base.as_dict() | values))
    except UsageError as error:
        raise UsageError(f"{where}: {error}.") from None


def wind_of(velocity: Sequence[float] | None, path: Path | None, fps: float | None, rate: float) -> Wind | None:
    """The wind, or None.

    Args:
        velocity: Velocity of steady air [m/s], three numbers.
        path: A .npz with `velocity` [T,3], or `direction` and `speed`, and maybe `fps`; or a .csv with columns x, y, z
            [m/s], one row after another.
        fps: Rows a second of the file, where it does not say or says something else.
        rate: Rows a second where nobody says: those of the body.

    Raises:
        UsageError: Both are given; it is no wind; or the file is another one.
        FileNotFoundError: There is no such file.
    """
    if path is None:
        if fps is not None:
            raise UsageError("--wind-fps without --wind-file: it is the rate of that file's rows.")
        if velocity is None:
            return None
        return _wind("--wind", {"velocity": np.array(velocity)}, None)
    if velocity is not None:
        raise UsageError("--wind and --wind-file: give one of them.")
    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    where = f"--wind-file {path}"
    try:
        if path.suffix.lower() == ".npz":
            arrays = read_npz(path, wanted=lambda name: name in ("velocity", "direction", "speed", "fps"))
        elif path.suffix.lower() == ".csv":
            arrays = {"velocity": _table(path)}
        else:
            raise UsageError(f"{where}: wind is read from .npz or .csv.")
    except MeshError as error:
        raise UsageError(f"{where}: {error}") from None
    known = arrays.pop("fps", None)
    if fps is None and known is not None:
        if known.size != 1 or known.dtype.kind not in "iuf":
            raise UsageError(f"{where}: fps is not one number. Give it with --wind-fps.")
        fps = float(known.reshape(()))
    return _wind(where, arrays, rate if fps is None else fps)


def _wind(where: str, arrays: dict[str, np.ndarray], fps: float | None) -> Wind:
    """Wind of `velocity`, or of `direction` and `speed`."""
    try:
        if "velocity" in arrays:
            return Wind.of_velocities(arrays["velocity"], fps=fps)
        if {"direction", "speed"} <= arrays.keys():
            return Wind(arrays["direction"], arrays["speed"], fps=fps)
    except UsageError as error:
        raise UsageError(f"{where}: {error}.") from None
    raise UsageError(f"{where}: it holds no array named velocity, nor direction and speed.")


def _table(path: Path) -> np.ndarray:
    """Rows of three numbers; the first row may be a title."""
    try:
        text = read_plain(path, LARGEST, text=True).decode("utf-8-sig")
        rows = [row for row in csv.reader(io.StringIO(text)) if any(cell.strip() for cell in row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise MeshError(f"{path} is no table of text: {error}") from None
    found = []
    for number, row in enumerate(rows):
        try:
            x, y, z = (float(cell) for cell in row)
        except ValueError:
            if number == 0:
                continue
            raise MeshError(f"row {number + 1} is not x, y, z: {','.join(row)[:60]!r}") from None
        if not math.isfinite(x + y + z):
            raise MeshError(f"row {number + 1} holds NaN or infinity")
        found.append((x, y, z))
    if not found:
        raise MeshError("no rows of x, y, z")
    return np.array(found)


def check_read(reads: Collection[str], weights: str, given: dict[str, bool]) -> None:
    """Refuses what a network does not read.

    Args:
        reads: Names of its inputs.
        weights: What the user calls it.
        given: Whether an option ("--wind") was given, by the name of the input that it is.

    Raises:
        UsageError: One was that is not read.
    """
    from warpgarment.nn import checkpoint

    for name, is_given in given.items():
        if is_given and name not in reads:
            option = "--wind" if name == "wind" else "--material"
            ships = [known for known, inputs in checkpoint.shipped_reads().items() if name in inputs]
            such = f", such as {ships[0]}" if ships else ""
            raise UsageError(
                f"{option}: the network {weights!r} reads no {name}, so it would change nothing. Leave it out, or give "
                f"one that reads it with --weights{such}."
            )
