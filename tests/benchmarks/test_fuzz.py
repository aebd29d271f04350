"""Hostile files: every reader refuses them by name or reads what can be in them, and the judge sees what does not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.fuzz import case, judge, workers
from benchmarks.fuzz.__main__ import cases, report, shrunk
from benchmarks.fuzz.case import Case, make, sound
from benchmarks.fuzz.kinds import KINDS, Kind
from warpgarment.errors import MeshError

ROOT = Path(__file__).parents[2]
FILES = 4 * len(KINDS)


def test_no_file_is_outside_of_refused_or_right(tmp_path):
    """A damaged file crashes, hangs, fills memory, is an error of Python, or is NaN that nobody speaks of.

    Four files of each kind from a fixed seed; `python -m benchmarks.fuzz --files 10000` tries more.
    """
    command = [
        sys.executable,
        "-m",
        "benchmarks.fuzz",
        "--files",
        str(FILES),
        "--out",
        str(tmp_path / "r.json"),
    ]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert f"| together | {FILES} |" in ran.stdout
    assert (tmp_path / "r.json").exists()
    assert len(KINDS) >= 24


def test_damage_follows_from_the_seed(tmp_path):
    """A failure could not be replayed, or the files would not be damaged at all."""
    changed = 0
    for kind in ("obj", "npz_body", "glb", "gltf", "bvh", "set_verified"):
        for seed in range(20):
            made = [make(Case(kind, seed), tmp_path / f"{kind}_{seed}_{k}") for k in range(2)]
            files = [
                {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}
                for folder in (tmp_path / f"{kind}_{seed}_{k}" for k in range(2))
            ]
            assert files[0] == files[1]
            assert made[0].story == made[1].story
            assert made[0].harmless or not made[0].story or files[0] != sound(kind)[1]
            changed += files[0] != sound(kind)[1]
    assert changed > 100
    for text in ("obj:17", "npz_body:3:0,2"):
        assert str(Case.of(text)) == text


def test_every_damage_takes_every_file():
    """The harness itself would end at an empty member of an archive, or at bytes that are no text."""
    from random import Random

    from benchmarks.fuzz import damage, structure

    special = {change for changes in structure.STRUCTURE.values() for change in changes}
    for change in {*damage.BYTES, *damage.TEXT, *damage.HARMLESS, *special, *structure.HARMLESS.values()}:
        for data in (b"", b"\0", b"[1]", b"PK\x01\x02", bytes(300), b"\xff" * 300, b"v 1 2 3\n"):
            for seed in range(60):
                made = change(data, Random(seed))
                assert made is None or isinstance(made, bytes), change.__name__


def _write(folder: Path) -> Path:
    (folder / "a.json").write_text("[1, 2, 3]")
    return folder / "a.json"


def _named(path: Path) -> dict:
    raise MeshError(f"{path} is damaged.")


def _memory(path: Path) -> dict:
    return {"a": np.ones(1 << 30)}


FAKES = {
    "named": (_named, judge.REFUSED),
    "fine": (lambda path: {"vertices": np.zeros((3, 3)), "faces": np.array([[0, 1, 2]]), "fps": 30.0}, judge.RIGHT),
    "foreign": (lambda path: {}["x"], "KeyError"),
    "nameless": (lambda path: (_ for _ in ()).throw(MeshError("It is damaged.")), "names no file"),
    "nan": (lambda path: {"vertices": np.full((3, 3), np.nan)}, "not finite"),
    "range": (
        lambda path: {"vertices": np.zeros((3, 3)), "faces": np.array([[0, 1, 3]])},
        "name other than 3 vertices",
    ),
    "rate": (lambda path: {"fps": -1.0}, "frames a second"),
    "hang": (lambda path: time.sleep(0.01) or [None for _ in iter(int, 1)], "takes more than"),
    "memory": (_memory, "too much memory"),
    "death": (lambda path: os.kill(os.getpid(), signal.SIGKILL), "the process died"),
}


def test_the_judge_knows_every_fault(monkeypatch):
    """A reader that crashes, hangs or believes everything would pass for a good one."""
    monkeypatch.setattr(workers, "SECONDS", 0.5)
    monkeypatch.setattr(judge, "sound_facts", lambda kind: {})
    monkeypatch.setattr(case, "steps_of", lambda case: 1)
    for name, (read, _) in FAKES.items():
        monkeypatch.setitem(KINDS, name, Kind(_write, read))
    seed = next(s for s in range(50) if not _harmless(s))
    found = {r.case.kind: r for r in workers.results([Case(name, seed) for name in FAKES], 2)}
    for name, (_, outcome) in FAKES.items():
        assert outcome in found[name].outcome, name
        assert found[name].failed == (outcome not in (judge.REFUSED, judge.RIGHT))
    assert report(list(found.values()))[-1].startswith("| together | 10 | 1 | 1 | 8 |")


def _harmless(seed: int) -> bool:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        made = [make(Case(name, seed), Path(folder) / name) for name in FAKES]
        return any(one.harmless or "removed" in one.story for one in made)


def test_what_changes_nothing_must_be_read_as_before(monkeypatch):
    """A reader that minds spaces, or a cache that believes damaged files, would pass."""
    sizes = iter(range(100))
    monkeypatch.setitem(KINDS, "fickle", Kind(_write, lambda path: {"a": next(sizes)}))
    monkeypatch.setitem(KINDS, "cached", Kind(_write, lambda path: {"a": path.read_bytes()}, constant=True))
    monkeypatch.setitem(KINDS, "deaf", Kind(_write, lambda path: {"problems": []}, noticed=(".json",)))
    said = {
        name: {r.outcome for r in workers.results(cases([name], 30, 0), 1)} for name in ("fickle", "cached", "deaf")
    }
    assert "a differs though it may not" in said["fickle"]
    assert "a differs though it may not" in said["cached"]
    assert any("nothing is told" in outcome for outcome in said["deaf"])


def test_failures_are_shrunk(monkeypatch):
    """What is replayed would do three things to a file where one of them is the fault."""
    monkeypatch.setitem(
        KINDS, "short", Kind(_write, lambda path: {"a": 1} if path.read_bytes()[:1] == b"[" else {}["x"])
    )
    found = [r for r in workers.results(cases(["short"], 200, 3), 1) if r.failed and case.steps_of(r.case) == 3]
    small = [shrunk(result) for result in found[:5]]
    assert small
    assert all(one.failed for one in small)
    assert min(len(one.case.steps or (0, 1, 2)) for one in small) == 1
