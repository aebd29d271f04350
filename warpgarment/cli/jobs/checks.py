"""Values of a line of JSON, each checked by its key: a number, a text, one of several words."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from typing import Any

from warpgarment.errors import UsageError
from warpgarment.io.disk.plain import JSON_DEEPEST

LONGEST_LINE = 1 << 20  # characters of a job


def object_of(row: str) -> dict[str, Any]:
    """The object of a line, in which no key is there twice."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [key_of(name) for name, _ in pairs]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise UsageError(f"{twice[0]!r} is there twice.")
        return dict(pairs)

    def refused(word: str) -> Any:
        raise UsageError(f"{word} is no number of JSON.")

    depth = deepest = 0
    for bracket in re.findall(r"[\[{\]}]", re.sub(r'"(?:\\.|[^"\\])*"', "", row[:LONGEST_LINE])):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    if len(row) > LONGEST_LINE or deepest > JSON_DEEPEST:
        raise UsageError("too long or too deep for a job.")
    try:
        found = json.loads(row, object_pairs_hook=once, parse_constant=refused)
    except (json.JSONDecodeError, RecursionError) as error:
        raise UsageError(f"no JSON: {error}. A job is one line, keys and texts in double quotes.") from None
    except UsageError:
        raise
    except ValueError as error:  # a number of thousands of digits
        raise UsageError(f"no JSON: {error}.") from None
    if not isinstance(found, dict):
        raise UsageError('no object. A job is a line such as {"garment": "a.obj", "body": "b.npz", "out": "c.usd"}.')
    return found


def key_of(name: str) -> str:
    """A key, in the spelling of Python or of the command line."""
    return name.lstrip("-").replace("-", "_")


def number(name: str, value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UsageError(f"{name!r} must be a number, got {in_short(value)}.")
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise UsageError(f"{name!r} must be a finite number, got {in_short(value)}.")
    return found


def positive(name: str, value: Any) -> float:
    """A number above 0."""
    if number(name, value) <= 0:
        raise UsageError(f"{name!r} must be positive, got {in_short(value)}.")
    return float(value)


def count(name: str, value: Any) -> int:
    """A whole number of at least 1."""
    if number(name, value) < 1 or value != int(value):
        raise UsageError(f"{name!r} must be a whole number of at least 1, got {in_short(value)}.")
    return int(value)


def text(name: str, value: Any) -> str:
    """A text that is not empty."""
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise UsageError(f"{name!r} must be a text, got {in_short(value)}.")
    return value


def texts(name: str, value: Any) -> tuple[str, ...]:
    """A text, or a list of them."""
    values = value if isinstance(value, list) else [value]
    if not values:
        raise UsageError(f"{name!r} is an empty list.")
    return tuple(text(name, item) for item in values)


def flag(name: str, value: Any) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise UsageError(f"{name!r} must be true or false, got {in_short(value)}.")
    return value


def one_of(*choices: str) -> Callable[[str, Any], str]:
    """A function that takes one of some words."""

    def check(name: str, value: Any) -> str:
        if value not in choices:
            raise UsageError(f"{name!r} must be one of {', '.join(choices)}, got {in_short(value)}.")
        return str(value)

    return check


def three(name: str, value: Any) -> tuple[float, ...]:
    """Three numbers."""
    if not isinstance(value, list) or len(value) != 3:
        raise UsageError(f"{name!r} must be three numbers [x, y, z] in m/s, got {in_short(value)}.")
    return tuple(number(name, item) for item in value)


def rate(name: str, value: Any) -> Any:
    """A rate, or a word for one."""
    return value if value in ("body", "network") else positive(name, value)


def anything(name: str, value: Any) -> Any:
    """A value that is checked elsewhere."""
    return value


def in_short(value: Any) -> str:
    """A value as text, cut to a line."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
