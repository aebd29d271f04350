"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any


def table(header: Sequence[Any], rows: Iterable[Sequence[Any]], text: int | Collection[str] = 1) -> list[str]:
    """Lines of a Markdown table in which columns of numbers are aligned to the right.

    Args:
        header: Headings of the columns.
        rows: Cells of each row, one per heading; they are converted by `str`.
        text: Columns of text, which are aligned to the left: the number of leading columns, or their headings.

    Raises:
        ValueError: A row has another number of cells than the header.
    """
    if isinstance(text, int):
        left = [i < text for i in range(len(header))]
    else:
        left = [name in text for name in header]
    lines = [header, ["---" if of_text else "---:" for of_text in left], *rows]
    for line in lines:
        if len(line) != len(header):
            raise ValueError(f"a row of {len(line)} cells in a table of {len(header)} columns: {list(line)}")
    return ["| " + " | ".join(map(str, line)) + " |" for line in lines]
