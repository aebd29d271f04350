"""Gives damaged files to every reader of the package, each in a process with limits of time and memory.

    python -m benchmarks.fuzz                                   # 1,000 files of all kinds
    python -m benchmarks.fuzz --files 10000 --seed 1 --out report.json
    python -m benchmarks.fuzz --only usdc obj --files 500
    python -m benchmarks.fuzz --replay obj:17 --keep FOLDER     # one of them again; its files stay in FOLDER

A file is sound at first, and is then damaged in one to three steps: cut short, with bits, numbers, lines, keys or
members of an archive that are others, missing or exchanged. All follows from the kind and the seed. Right is an error
of this package that names the file, or what can be in such a file: finite numbers, indices in range, shapes that
agree; where nothing but spaces or the order of members was changed, exactly what the sound file holds. All else is a
failure: another error, none at all, a process that dies, takes more than 10 s, or 800 MB more than it had. A failure is
shrunk to the steps that make it; `--replay` does them again. The exit status is 1 where there is one. All extras are
needed.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

from warpgarment.view.markdown import table

from . import judge
from .case import Case, make, steps_of
from .kinds import KINDS
from .workers import Result, results


def cases(kinds: Sequence[str], files: int, seed: int) -> list[Case]:
    """As many cases of each kind, one kind after the other."""
    each = -(-files // len(kinds))
    return [Case(kind, seed * 1_000_000 + k) for kind in kinds for k in range(each)][: each * len(kinds)]


def shrunk(result: Result) -> Result:
    """The failure with as few of its steps as make it."""
    count = steps_of(result.case)
    if result.case.steps is not None or (result.outcome.endswith(("may not", "was changed")) and count == 1):
        return result
    some = [Case(*result.case[:2], steps) for n in range(1, count) for steps in combinations(range(count), n)]
    for found in results(some, 1):
        if found.failed and _alike(found) == _alike(result):
            return found
    return result


def _alike(result: Result) -> str:
    """The outcome without its numbers and names: the same for failures that are alike."""
    return f"{result.case.kind} {re.sub(r'[0-9]+', '#', result.outcome.split(': ')[0])[:60]}"


def report(found: Sequence[Result]) -> list[str]:
    """A table: files of each kind by outcome, and the slowest."""
    rows = []
    for kind in [*dict.fromkeys(r.case.kind for r in found), "together"]:
        here = [r for r in found if kind in ("together", r.case.kind)]
        count = Counter("failed" if r.failed else r.outcome for r in here)
        slowest = max(r.seconds for r in here)
        rows.append([kind, len(here), count[judge.REFUSED], count[judge.RIGHT], count["failed"], f"{slowest:.2f}"])
    return table(["kind", "files", "named error", "right", "failed", "slowest [s]"], rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; the exit status is 1 where a case failed."""
    parser = argparse.ArgumentParser("python -m benchmarks.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("--files", type=int, default=1000, help="number of files (1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the damage (0)")
    parser.add_argument(
        "--only", nargs="+", default=list(KINDS), choices=list(KINDS), metavar="KIND", help="kinds (all)"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument("--out", type=Path, help="file for the numbers, JSON")
    parser.add_argument("--replay", metavar="KIND:SEED[:STEPS]", help="one case again")
    parser.add_argument("--keep", type=Path, help="folder for the files of the case")
    options = parser.parse_args(arguments)
    if options.replay:
        return _replay(Case.of(options.replay), options.keep)
    began, found = time.perf_counter(), []
    failures: dict[str, Result] = {}
    for result in results(cases(options.only, options.files, options.seed), options.jobs):
        found.append(result)
        if result.failed and _alike(result) not in failures:
            failures[_alike(result)] = result
            print(f"{result.case}: {result.outcome} [{result.story}]", flush=True)
    seconds = time.perf_counter() - began
    order = {kind: k for k, kind in enumerate(KINDS)}
    found.sort(key=lambda r: (order[r.case.kind], r.case.seed))
    lines = report(found)
    print("\n".join(["", *lines, "", f"{len(found):,} files in {seconds:.0f} s, {len(found) / seconds:.0f} a second"]))
    small = [shrunk(result) for result in failures.values()]
    for result in small:
        print(f"--replay {result.case}: {result.outcome} [{result.story}]")
    if options.out:
        failed = [{"case": str(r.case), "outcome": r.outcome, "story": r.story} for r in found if r.failed]
        slow = [f"{r.case}: {r.seconds:.2f} s [{r.story}]" for r in sorted(found, key=lambda r: -r.seconds)[:20]]
        content = {"table": lines, "seconds": seconds, "failed": failed, "slowest": slow}
        options.out.write_text(json.dumps(content, indent=1), "utf-8")
    return 1 if failures else 0


def _replay(case: Case, keep: Path | None) -> int:
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
        print(f"the files: {make(case, keep).path}")
    for result in results([case], 1):
        print(f"{result.case}: {result.outcome} [{result.story or 'not known'}] {result.seconds:.2f} s")
        return int(result.failed)
    return 1


if __name__ == "__main__":
    sys.exit(main())
