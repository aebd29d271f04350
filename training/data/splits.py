"""Which split a sequence and a motion clip belong to: by number and by name, so that they never change."""

from __future__ import annotations

import re

SPLITS = ("train", "validation", "test")


def split_of_number(number: int) -> str:
    """Which split a sequence belongs to: of 24, three are for testing and one for validation (200 : 10 : 30 of 240)."""
    return "test" if number % 8 == 3 else "validation" if number % 24 == 5 else "train"


def clip_group(name: str) -> str:
    """Clips of the same performance share a group: the two partners of a salsa are numbered 01-15 and 16-30."""
    salsa = re.search(r"salsa_(\d+)", name)
    return f"salsa_{(int(salsa.group(1)) - 1) % 15 + 1:02d}" if salsa else name


def split_of_clips(names: list[str]) -> dict[str, str]:
    """Splits clips by performance: every sixth group is for testing, every twelfth for validation."""
    groups = sorted({clip_group(n) for n in names})
    held = {g: "test" if i % 6 == 2 else "validation" if i % 12 == 5 else "train" for i, g in enumerate(groups)}
    return {n: held[clip_group(n)] for n in names}
