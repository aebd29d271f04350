"""Whether the outcome of a case is right: a named error of this package, or something that can be in such a file."""

from __future__ import annotations

import contextlib
import functools
import re
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .case import Case, Made, make, sound
from .kinds import KINDS

Limits = Callable[[], contextlib.AbstractContextManager[None]]
REFUSED, RIGHT = "refused", "accepted and right"


def outcome(case: Case, folder: Path, limits: Limits = contextlib.nullcontext) -> tuple[str, str, float]:
    """Makes the files of a case, reads them and judges what comes.

    Args:
        case: The case.
        folder: An empty folder.
        limits: Of the reading.

    Returns:
        `REFUSED`, `RIGHT`, or what is wrong; what was done to the files; and the seconds of a processor that reading
        took.
    """
    made, kind = make(case, folder), KINDS[case.kind]
    facts: dict[str, Any] = {}
    verdict, began = "", time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with limits():
                facts = kind.read(made.path)
        except MemoryError:
            verdict = "asks for too much memory"
        except Exception as error:
            verdict = _refusal(error, case, made)
    seconds = time.process_time() - began
    return verdict or _judged(facts, case, made), made.story, seconds


def _refusal(error: Exception, case: Case, made: Made) -> str:
    own = type(error).__module__.split(".")[0] == "warpgarment"
    own |= isinstance(error, FileNotFoundError) and not made.path.exists()
    if not own:
        place = traceback.extract_tb(error.__traceback__)
        where = next((f for f in reversed(place) if not re.search("benchmarks|site-packages", f.filename)), None)
        line = f" ({Path(where.filename).name}:{where.lineno})" if where else ""
        return f"{type(error).__name__}{line}: {str(error)[:150]}"
    if made.harmless:
        return f"refused though nothing was changed: {str(error)[:150]}"
    if KINDS[case.kind].constant:
        return f"refused though it can be made again: {str(error)[:150]}"
    names = {made.path.name, made.path.parent.name, *(Path(name).name for name in made.changed)}
    names |= {Path(name).parent.name for name in made.changed}
    if not any(name in str(error) for name in names):
        return f"an error that names no file: {type(error).__name__}: {str(error)[:150]}"
    return REFUSED


def _judged(facts: dict[str, Any], case: Case, made: Made) -> str:
    kind = KINDS[case.kind]
    if made.harmless or kind.constant:
        different = _difference(facts, sound_facts(case.kind))
        return f"{different} differs though it may not" if different else RIGHT
    changed = [name for name in made.changed if Path(name).suffix in kind.noticed]
    if changed and not facts.get("problems"):
        return f"{changed[0]} is another, and nothing is told"
    return _impossible(facts) or RIGHT


def _impossible(facts: dict[str, Any]) -> str:
    """What cannot be: numbers that are not finite, indices of nothing, shapes that do not agree."""
    for name, value in facts.items():
        if name.startswith("not checked") or not isinstance(value, (np.ndarray, float)):
            continue
        array = np.asarray(value)
        if array.dtype.kind in "fc" and not np.isfinite(array).all():
            return f"{name} holds numbers that are not finite"
        if array.dtype.hasobject:
            return f"{name} holds objects"
    if "fps" in facts and not 0 < facts["fps"] < 1e6:
        return f"{facts['fps']} frames a second"
    for faces, vertices in (("faces", "vertices"), *((f"faces {k}", f"rest {k}") for k in range(4))):
        if faces in facts:
            index, count = np.asarray(facts[faces]), np.shape(facts[vertices])[-2]
            if index.ndim != 2 or index.shape[1] != 3 or not index.size or index.min() < 0 or index.max() >= count:
                return f"{faces} of shape {list(index.shape)} name other than {count} vertices"
    return ""


def _difference(one: dict[str, Any], other: dict[str, Any]) -> str:
    if one.keys() != other.keys():
        return f"{sorted(one.keys() ^ other.keys())}"
    for name, value in one.items():
        if isinstance(value, np.ndarray):
            same = value.dtype == other[name].dtype and np.array_equal(
                value, other[name], equal_nan=value.dtype.kind in "fc"
            )
        else:
            same = value == other[name]
        if not same:
            return name
    return ""


@functools.cache
def sound_facts(kind: str) -> dict[str, Any]:
    """What is read of the sound files of a kind."""
    path, files = sound(kind)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, data in files.items():
            (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(folder) / name).write_bytes(data)
        return KINDS[kind].read(Path(folder) / path)
