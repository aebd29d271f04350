"""Progress bars of what takes longer than two seconds, on a terminal alone."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")


def counted(
    items: Iterable[Item], what: str, *, unit: str, total: int | None = None, shown: bool | None = None
) -> Iterator[Item]:
    """The items, with how many are done and the time left for the others; the bar goes when they are.

    Args:
        items: What is worked on, one after the other.
        what: What is done, such as "drawing".
        unit: What an item is, such as "frame".
        total: Number of items, where they have no length.
        shown: Whether there is a bar; None: where stderr is a terminal.
    """
    if not (sys.stderr.isatty() if shown is None else shown):
        yield from items
        return
    from tqdm import tqdm

    yield from tqdm(items, desc=what, unit=unit, total=total, leave=False)
