"""The kinds of values that entries of `manifest.json` and `set.json` may have, and the check of a manifest."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from .layout import SPLITS

MOST_FRAMES = 10_000_000
MOST_PLANNED = 1_000_000  # most sequences of a set
_LARGEST = 1 << 63
_FILE = re.compile(r"\w[\w.-]{0,120}", re.ASCII)


class Kind(NamedTuple):
    """Kind of an entry: `fits` decides whether a value is of this kind, `what` describes it in an error."""

    what: str
    fits: Callable[[Any], bool]


def is_finite(value: Any) -> bool:
    """Whether a value is a finite number that fits a float."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < _LARGEST if isinstance(value, int) else math.isfinite(value)


def _number(value: Any) -> bool:
    return isinstance(value, float) or is_finite(value)


def _whole(least: int, most: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _scalar(value: Any) -> bool:
    return value is None or isinstance(value, (str, bool)) or _number(value)


def _versions(value: Any) -> bool:
    return isinstance(value, dict) and all(v is None or isinstance(v, str) for v in value.values())


def _garment(value: Any) -> bool:
    if not isinstance(value, dict) or not all(isinstance(value.get(key) or "", str) for key in ("name", "category")):
        return False
    material = value.get("material")
    return material is None or (isinstance(material, dict) and all(map(_scalar, material.values())))


def _attempts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(v, dict) and not faults(v, ATTEMPT) for v in value)


def _planned(value: Any) -> bool:
    if not isinstance(value, list):
        return False
    number = _whole(0, _LARGEST)
    if not all(isinstance(r, list) and len(r) == 2 and all(map(number, r)) and r[0] <= r[1] for r in value):
        return False
    return sum(last - first + 1 for first, last in value) <= MOST_PLANNED


def _configuration(value: Any) -> bool:
    if not isinstance(value, dict):
        return False
    words = all(value.get(key) is None or isinstance(value[key], str) for key in ("recipe", "teacher"))
    seed = value.get("seed") is None or _SEED.fits(value["seed"])
    held_out = value.get("held_out") or []
    return words and seed and isinstance(held_out, list) and all(isinstance(name, str) for name in held_out)


def _pieces(value: Any) -> bool:
    if not isinstance(value, dict) or not all(_whole(1, MOST_FRAMES)(value.get(name)) for name in ("frames", "known")):
        return False
    return value["known"] < value["frames"]


_TEXT = Kind("a text", lambda v: isinstance(v, str))
_MAYBE_TEXT = Kind("a text or null", lambda v: v is None or isinstance(v, str))
_SEED = Kind("a whole number", _whole(-_LARGEST, _LARGEST))
_OBJECT = Kind("an object", lambda v: isinstance(v, dict))
_VERSIONS = Kind("an object of texts", _versions)

ATTEMPT: Mapping[str, Kind] = {  # entries of a rejected attempt, which every manifest may have
    "status": Kind('"good" or "rejected"', lambda v: v in ("good", "rejected")),
    "reason": _MAYBE_TEXT,
    "split": Kind(f"one of {', '.join(SPLITS)}", lambda v: isinstance(v, str) and v in SPLITS),
    "motion": _TEXT,
    "garment": _TEXT,
    "category": _MAYBE_TEXT,
    "body": Kind(
        "a text, or an object of texts and numbers",
        lambda v: v is None or isinstance(v, str) or (isinstance(v, dict) and all(map(_scalar, v.values()))),
    ),
    "seed": Kind("a whole number or null", lambda v: v is None or _SEED.fits(v)),
    "number": _SEED,
    "fps": Kind("a number above 0, 10,000 at most", lambda v: is_finite(v) and 0 < v <= 10_000),
    "frames": Kind(f"a whole number from 0 to {MOST_FRAMES:,}", _whole(0, MOST_FRAMES)),
    "figures": Kind(
        "an object of numbers",
        lambda v: isinstance(v, dict) and all(isinstance(x, bool) or _number(x) for x in v.values()),
    ),
    "versions": _VERSIONS,
    "garments": Kind(
        "a list of objects with a name, a category and a material of numbers",
        lambda v: v is None or (isinstance(v, list) and all(map(_garment, v))),
    ),
}
SEQUENCE: Mapping[str, Kind] = {
    **ATTEMPT,
    "recorded": Kind("true or false", lambda v: isinstance(v, bool)),
    "pieces": Kind('an object with whole numbers "frames" and "known", of which the latter is less', _pieces),
    "rejected_attempts": Kind("a list of the manifests of attempts", _attempts),
    "checksums": Kind(
        "an object of the names of files in the folder and their SHA-256",
        lambda v: isinstance(v, dict) and all(_FILE.fullmatch(k) and isinstance(x, str) for k, x in v.items()),
    ),
}
SET: Mapping[str, Kind] = {
    "configuration": Kind("an object with texts for recipe and teacher, a seed, a list held_out", _configuration),
    "teacher": _OBJECT,
    "versions": _VERSIONS,
    "command": _TEXT,
    "numbers": Kind(f"a list of [first, last], of {MOST_PLANNED:,} sequences together at most", _planned),
}


def faults(manifest: Mapping[str, Any], kinds: Mapping[str, Kind]) -> dict[str, str]:
    """Entries that are not of their kind: name -> description of the fault. A missing entry is not a fault."""
    return {
        key: f"says {shown(manifest[key])} for {key}, which must be {kind.what}"
        for key, kind in kinds.items()
        if key in manifest and not kind.fits(manifest[key])
    }


def shown(value: Any) -> str:
    """A value as it is written in an error, 60 characters at most."""
    if isinstance(value, int) and abs(value) >= _LARGEST:
        return "a whole number of more than 18 digits"
    if isinstance(value, (dict, list)):
        value = dict(list(value.items())[:8]) if isinstance(value, dict) else value[:8]
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
