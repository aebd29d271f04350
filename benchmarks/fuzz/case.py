"""One hostile file: sound files of a kind, damaged in steps that follow from the kind's name and a seed alone."""

from __future__ import annotations

import functools
import os
import shutil
import tempfile
from pathlib import Path
from random import Random
from typing import NamedTuple

from . import damage, structure
from .kinds import KINDS, TEXTS

MOST_STEPS = 3


class Case(NamedTuple):
    """What is tried; `steps` are the numbers of those that are done, None: all."""

    kind: str
    seed: int
    steps: tuple[int, ...] | None = None

    def __str__(self) -> str:
        steps = "" if self.steps is None else f":{','.join(map(str, self.steps))}"
        return f"{self.kind}:{self.seed}{steps}"

    @classmethod
    def of(cls, text: str) -> Case:
        """The case of a text such as `obj:17` or `obj:17:0,2`."""
        kind, seed, *steps = text.split(":")
        return cls(kind, int(seed), tuple(map(int, steps[0].split(","))) if steps else None)


class Made(NamedTuple):
    """Damaged files.

    Attributes:
        path: What is read.
        harmless: Whether the damage changes nothing of what the files say.
        changed: Names of the files that are others.
        story: What was done to them.
    """

    path: Path
    harmless: bool
    changed: tuple[str, ...]
    story: str


@functools.cache
def sound(kind: str) -> tuple[str, dict[str, bytes]]:
    """The path that is read, relative to the folder, and the sound files of a kind."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        place = Path(folder) / kind
        if KINDS[kind].write.__name__ != "add_sequence":
            place.mkdir()
        path = KINDS[kind].write(place)
        files = {str(f.relative_to(folder)): f.read_bytes() for f in sorted(place.rglob("*")) if f.is_file()}
        return str(path.relative_to(folder)), files


def steps_of(case: Case) -> int:
    """Number of the steps that the seed has."""
    rng = Random(f"{case.kind}:{case.seed}")
    return next((k for k in range(1, MOST_STEPS) if rng.random() < 0.65), MOST_STEPS)


def make(case: Case, folder: Path) -> Made:
    """Writes the damaged files below a folder."""
    entry, whole = sound(case.kind)
    files = dict(whole)
    rng = Random(f"{case.kind}:{case.seed}:harmless")
    story: list[str] = []
    harmless = rng.random() < 0.08 and case.steps is None and _harmless(case.kind, files, rng, story)
    if not harmless:
        for step in range(steps_of(case)):
            if case.steps is None or step in case.steps:
                _step(case.kind, files, Random(f"{case.kind}:{case.seed}:{step}"), story)
    for name, data in files.items():
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(data)
    changed = tuple(name for name in whole if files.get(name) != whole[name])
    return Made(folder / entry, harmless, changed, "; ".join(story))


def _victims(kind: str, files: dict[str, bytes]) -> list[str]:
    pattern = KINDS[kind].files
    found = sorted(f for f in files if Path(f).match(f"{kind}/{pattern}") or Path(f).match(pattern))
    return found or sorted(files)


def _is_text(kind: str, name: str) -> bool:
    return KINDS[kind].text or Path(name).suffix in TEXTS


def _harmless(kind: str, files: dict[str, bytes], rng: Random, story: list[str]) -> bool:
    name = rng.choice(_victims(kind, files))
    changes = list(damage.HARMLESS) if _is_text(kind, name) else []
    if Path(name).suffix in structure.HARMLESS:
        changes.append(structure.HARMLESS[Path(name).suffix])
    if not changes:
        return False
    change = rng.choice(changes)
    data = change(files[name], rng)
    if data is None:
        return False
    files[name] = data
    story.append(f"{name}: {change.__name__}, which changes nothing")
    return True


def _step(kind: str, files: dict[str, bytes], rng: Random, story: list[str]) -> None:
    """One kind of damage to one of the files."""
    name = rng.choice(_victims(kind, files))
    chance = rng.random()
    if chance < 0.02 and len(files) > 1:
        del files[name]
        story.append(f"{name}: removed")
        return
    if chance < 0.07:
        other = rng.choice(sorted(KINDS))
        content = sound(other)[1]
        source = rng.choice(sorted(content))
        files[name] = content[source]
        story.append(f"{name}: holds {source}")
        return
    basic = damage.COPIES if KINDS[kind].outside else damage.BYTES
    changes = list(basic)
    if _is_text(kind, name):
        changes += damage.TEXT * 2
    special = structure.STRUCTURE.get(Path(name).suffix)
    if special and rng.random() < 0.6:
        changes = list(special)
    for _ in range(10):
        change = rng.choice(changes)
        data = change(files[name], rng) if files.get(name) else None
        if data is not None and data != files[name]:
            files[name] = data
            story.append(f"{name}: {change.__name__}")
            return
        changes = list(basic)


def clear(folder: Path) -> None:
    """Empties a folder."""
    for entry in os.scandir(folder):
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path, ignore_errors=True)
        else:
            os.unlink(entry.path)
