"""Tables in Markdown, and text of others that is to be shown as text."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from typing import Any

_SPECIAL = re.compile(r"[\\`*{}~|$#]|!(?=\[)|\](?=[(\[:])|(?<![^\W_])_|_(?![^\W_])")


def escape(text: object) -> str:
    """Text of someone else as Markdown that shows it as it is: no tag, link, picture, emphasis or cell comes of it.

    Args:
        text: What to show, converted by `str`. Line breaks and other control characters become spaces.
    """
    plain = " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
    plain = plain.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    plain = _SPECIAL.sub(lambda match: f"\\{match[0]}", plain)
    return plain.replace("://", "&#58;//").replace("www.", "www&#46;").replace("@", "&#64;")


def code(text: object) -> str:
    """Text of someone else as a code span, which shows it as it is, in one line, and in one cell of a table.

    A span between backticks would end a cell at a bar, and a backslash before it shows in a text: HTML does neither.

    Args:
        text: What to show, converted by `str`.
    """
    plain = " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
    if "|" in plain:
        return f"<code>{escape(plain).replace(chr(92) + '|', '&#124;')}</code>"
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", plain)), default=0))
    space = " " if plain.startswith("`") or plain.endswith("`") else ""
    return f"{fence}{space}{plain}{space}{fence}"


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
