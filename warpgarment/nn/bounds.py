"""Bounds on the metadata of a checkpoint, checked before any memory is allocated."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from warpgarment.errors import CheckpointError

LONGEST = 16 << 20  # most characters of a JSON text
DEEPEST = 64  # most nested objects and arrays
LARGEST = {  # largest values of integer settings; the paper's network has 512, 512, 8, 8, 2 and 10
    "embedding": 16_384,
    "feed_forward": 65_536,
    "layers": 512,
    "heads": 512,
    "manifold_heads": 512,
    "history": 1_000,
    "face_embedding": 16_384,
    "face_feed_forward": 65_536,
    "face_layers": 512,
    "decoder": 65_536,
    "world_heads": 512,
    "patch_neighbours": 4_096,
}
LARGEST_OTHER = 1_000_000_000  # largest value of any other number


def checked_json(path: object, what: str, text: str) -> dict[str, Any]:
    """A JSON object from a text of bounded length and depth.

    Args:
        path: The checkpoint, for messages.
        what: Name of the text, for messages.
        text: The text itself.

    Raises:
        CheckpointError: The text is longer or more deeply nested than the bounds, or is not a JSON object.
    """
    if len(text) > LONGEST:
        raise CheckpointError(f"{path}: {what} has {len(text):,} characters, more than {LONGEST:,}; do not use it")
    try:
        value = json.loads(text)
    except RecursionError:
        raise CheckpointError(f"{path}: {what} is nested more than {DEEPEST} deep; do not use it") from None
    except ValueError as error:
        raise CheckpointError(f"{path}: {what} is missing or not JSON ({str(error)[:100]})") from None
    if not isinstance(value, dict):
        raise CheckpointError(f"{path}: {what} is not a JSON object")
    level: list[Any] = [value]
    for _ in range(DEEPEST):
        level = [part for item in level for part in (item.values() if isinstance(item, dict) else item)]
        level = [part for part in level if isinstance(part, (dict, list))]
        if not level:
            return value
    raise CheckpointError(f"{path}: {what} is nested more than {DEEPEST} deep; do not use it")


def check_settings(path: object, settings: Mapping[str, Any], tensors: int) -> None:
    """Checks that settings of a network are within the bounds, and that its layers can be in so few tensors.

    Args:
        path: The checkpoint, for messages.
        settings: Settings by name; those that are not numbers are not checked.
        tensors: Number of tensors in the checkpoint.

    Raises:
        CheckpointError: A number is outside the bounds; the error names it and the bound.
    """
    for name, value in settings.items():
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            continue
        largest = LARGEST.get(name, LARGEST_OTHER)
        if not -LARGEST_OTHER <= value <= largest:  # also refuses NaN
            shown = f"{value:,}" if abs(value) < 10**18 else "a number of more than 18 digits"
            raise CheckpointError(f"{path}: setting {name} must be at most {largest:,}, got {shown}; do not use it")
    if isinstance(layers := settings.get("layers"), int) and layers > tensors:
        raise CheckpointError(f"{path}: its config says {layers:,} layers, but it holds {tensors:,} tensors")
