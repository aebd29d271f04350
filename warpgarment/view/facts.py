"""A table of what files hold, for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from warpgarment.objects.facts import Facts

from .report import table

MOST_NAMES = 4  # of objects in a cell


def facts_table(columns: Mapping[str, Facts]) -> str:
    """A table with a column for each mesh or motion, as text of several lines.

    Args:
        columns: Facts by the title of their column.
    """
    rows = [[name, *(cell(facts) for facts in columns.values())] for name, cell in _ROWS.items()]
    kept = [row for row in rows if any(cell not in ("", "-") for cell in row[1:])]
    return table(["", *columns], kept)


def _object(facts: Facts) -> str:
    if facts.source is None or not facts.source.names:
        return "-"
    names, chosen = facts.source.names, facts.source.mesh
    if len(names) == 1:
        return names[0]
    more = f", {len(names) - MOST_NAMES:,} more" if len(names) > MOST_NAMES else ""
    held = f"{len(names):,}: {', '.join(names[:MOST_NAMES])}{more}"
    return f"{chosen} of {held}" if chosen not in (None, "*") else f"all {held}"


def _pieces(facts: Facts) -> str:
    return f"{facts.pieces:,}" + (f" ({facts.riding:,} small and loose)" if facts.riding else "")


def _seams(facts: Facts) -> str:
    if facts.open_seams:
        return f"{facts.open_seams:,} vertices at the same place, not joined"
    return f"{facts.joined:,} vertices joined" if facts.joined else "-"


def _unit(facts: Facts) -> str:
    return f"{facts.source.unit}, {facts.source.metres_from}" if facts.source else "-"


def _up(facts: Facts) -> str:
    return f"{facts.source.up.upper()}, {facts.source.up_from}" if facts.source else "-"


def _rate(facts: Facts) -> str:
    if facts.fps is None or facts.frames < 2:
        return "-"
    return f"{facts.fps:g}" + (f", {facts.source.fps_from}" if facts.source else "")


_ROWS: dict[str, Callable[[Facts], str]] = {
    "file": lambda facts: facts.source.path.name if facts.source else "-",
    "object": _object,
    "pieces": _pieces,
    "vertices": lambda facts: f"{facts.vertices:,}",
    "faces": lambda facts: f"{facts.faces:,}",
    "seams": _seams,
    "size x, y, z [m]": lambda facts: " x ".join(f"{side:.3g}" for side in facts.size),
    "unit": _unit,
    "up": _up,
    "rate [fps]": _rate,
    "frames": lambda facts: f"{facts.frames:,}" if facts.fps is not None else "-",
    "duration [s]": lambda facts: f"{facts.seconds:.3g}" if facts.frames > 1 else "-",
}
