"""Splits of sequences and motion clips. They follow from number and name alone, so that they never change."""

from __future__ import annotations

import re
from pathlib import Path


def split_of_number(number: int) -> str:
    """The split of a sequence: of 24, three are for testing and one is for validation (200 : 10 : 30 of 240)."""
    return "test" if number % 8 == 3 else "validation" if number % 24 == 5 else "train"


def clip_group(name: str) -> str:
    """The performance of a clip, whose clips share a group: two partners of a salsa are numbered 01-15 and 16-30."""
    salsa = re.search(r"salsa_(\d+)", name)
    return f"salsa_{(int(salsa.group(1)) - 1) % 15 + 1:02d}" if salsa else name


def split_of_clips(names: list[str]) -> dict[str, str]:
    """Splits clips by performance: every sixth group is for testing, every twelfth for validation."""
    groups = sorted({clip_group(n) for n in names})
    held = {g: "test" if i % 6 == 2 else "validation" if i % 12 == 5 else "train" for i, g in enumerate(groups)}
    return {n: held[clip_group(n)] for n in names}


def evenly(folders: list[Path], most: int | None) -> list[Path]:
    """At most a number of the folders, evenly spread over the list; all of them for None."""
    if most is None or len(folders) <= most:
        return folders
    return [folders[(i * len(folders)) // most] for i in range(most)]
