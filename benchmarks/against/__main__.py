"""Today's build beside an earlier one, in turns: least and median times, memory, and what they make of the same state.

    python -m benchmarks against 1a9fae1                     # all rows, some twenty minutes on two cores
    python -m benchmarks against 1a9fae1 --only frame state  # rows whose names begin so
    python -m benchmarks against 1a9fae1 --rounds 40 --out FILE.json

Both builds run the same meshes in processes of their own, which take turns; torch and Warp are the same. One-core rows
are processor time, which other work on the machine changes less; rows for several cores are time by the clock, so they
need an idle machine. The ratio is today's least time over the earlier one's.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.measure import machine
from benchmarks.scenes import dressed
from warpgarment.view.markdown import table

from .cases import CASES, Case
from .environment import python_of
from .picture import draw
from .processes import Worker, demo_motions, fresh, trained

Row = dict[str, Any]
SAME = 0.02  # mm by which one frame from the same state may differ
NOISE, SEEDS = 1e-7, 8  # m by which known frames are moved, and how often, to see how much the earlier build differs


class Builds(NamedTuple):
    """Interpreters of the two builds."""

    before: Path
    now: Path


def measured(builds: Builds, options: argparse.Namespace, folder: Path) -> Iterator[Row]:
    """A row for each case whose name begins with one of `options.only`."""
    for case in CASES:
        if not any(case.name.startswith(wanted) for wanted in options.only):
            continue
        if case.kind == "train":
            yield _row(case, _in_turns(builds, case, lambda python, case=case: trained(python, case, folder), 3))
        elif case.kind == "next":
            yield _same_state(builds, case, folder)
        elif case.fresh:
            rounds, given = min(options.rounds, case.rounds), scenes(case.options, folder)
            yield _row(
                case, _in_turns(builds, case, lambda python, case=case, given=given: fresh(python, case, given), rounds)
            )
        else:
            yield _row(case, _with_workers(builds, case, options, folder))


def _in_turns(builds: Builds, case: Case, call: Callable[[Path], float], rounds: int) -> tuple[list[float], ...]:
    before: list[float] = []
    now: list[float] = []
    for number in range(rounds):
        for python, figures in ((builds.before, before), (builds.now, now))[:: 1 if number % 2 else -1]:
            figures.append(call(python))
    return before, now


def _with_workers(builds: Builds, case: Case, options: argparse.Namespace, folder: Path) -> tuple[list[float], ...]:
    given = scenes(case.options, folder)
    workers = [Worker(python, case.threads) for python in builds]
    try:
        for worker in workers:
            worker.ask("prepare", "case", case.kind, given)
            for _ in range(case.warm_up):
                worker.ask("run", "case")
        by_python = dict(zip(builds, workers, strict=True))
        key = "work_s" if case.threads == 1 else "wall_s"
        rounds = min(options.rounds, case.rounds)
        return _in_turns(
            builds, case, lambda python: 1e3 * by_python[python].ask("run", "case")[key] / case.share, rounds
        )
    finally:
        for worker in workers:
            worker.close()


def _same_state(builds: Builds, case: Case, folder: Path) -> Row:
    """Distances of what the earlier build predicts from a history to today's prediction, and to its own with noise."""
    given = case.options | {"motions": demo_motions(folder), "noise": 0.0, "seeds": [0]}

    def predicted(python: Path, options: dict[str, Any]) -> list[np.ndarray]:
        worker = Worker(python, case.threads)
        try:
            worker.ask("prepare", "case", "next", options)
            return [np.array(positions) for _, _, positions in worker.ask("run", "case")["result"]]
        finally:
            worker.close()

    def apart(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> list[float]:
        return [float(np.linalg.norm(a - b, axis=1).max() * 1e3) for a, b in zip(one, other, strict=True)]

    before, now = (predicted(python, given) for python in builds)
    moved = predicted(builds.before, given | {"noise": NOISE, "seeds": list(range(SEEDS))})
    between, itself = apart(before, now), apart([each for each in before for _ in range(SEEDS)], moved)
    row = {
        "what": case.what,
        "unit": "mm",
        "states": len(between),
        "most": max(between),
        "median": statistics.median(between),
        "itself_most": max(itself),
        "itself_median": statistics.median(itself),
    }
    return row | {"target": SAME, "met": max(between) <= SAME}


def _row(case: Case, figures: tuple[list[float], ...]) -> Row:
    before, now = figures
    row: Row = {"what": case.what, "unit": case.unit, "rounds": len(now)}
    for name, values in (("before", before), ("now", now)):
        row |= {f"{name}_least": min(values), f"{name}_median": statistics.median(values)}
    if case.kind == "frames" and case.share == 1 and not case.fresh:
        row |= {"faces": case.options["faces"][0], "threads": case.threads}
    row["ratio"] = row["now_least"] / row["before_least"]
    row["ratio_of_medians"] = row["now_median"] / row["before_median"]
    return row | {"target": case.target, "met": case.target is None or row["ratio"] <= case.target}


def scenes(options: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Options of a case with files in place of numbers of faces: `faces` [N] becomes `scenes`, or `scene` for one."""
    options = dict(options)
    if "faces" not in options:
        return options
    paths = []
    for number, faces in enumerate(options.pop("faces")):
        start = 40 + number % 8
        path = folder / f"{faces}_{start}.npz"
        if not path.exists():
            scene = dressed(faces, start=start)
            walk = scene.body.vertices[:12]
            arrays = {"vertices": scene.garment.vertices, "faces": scene.garment.faces, "first": scene.first}
            np.savez(path, body=walk, body_faces=scene.body.faces, **arrays)
        paths.append(str(path))
    return options | ({"scene": paths[0]} if options.pop("alone", False) else {"scenes": paths})


def shown(row: Row) -> list[str]:
    """The cells of a row."""
    target = "-" if row["target"] is None else f"{row['target']:g}"
    if "states" in row:
        itself, between = (f"{row[name]:.4f} {row['unit']}" for name in ("itself_most", "most"))
        cells = [row["what"], f"{itself} (beside itself, {NOISE:g} m of noise, {SEEDS} times)", between]
        return [*cells, "-", "-", target, "yes" if row["met"] else "no"]
    times = [f"{row[f'{name}_least']:.3g} / {row[f'{name}_median']:.3g} {row['unit']}" for name in ("before", "now")]
    ratios = [f"{row['ratio']:.2f}", f"{row['ratio_of_medians']:.2f}"]
    met = "-" if row["target"] is None else "yes" if row["met"] else "no"
    return [row["what"], *times, *ratios, target, met]


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the cases and prints a table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks against", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commit", help="the earlier build")
    names = ", ".join(case.name for case in CASES)
    parser.add_argument("--only", nargs="+", default=[""], metavar="NAME", help=f"beginnings of: {names}")
    parser.add_argument("--rounds", type=int, default=60, help="largest number of turns of a row")
    parser.add_argument("--out", type=Path, help="a JSON file for the rows")
    parser.add_argument("--picture", type=Path, help="a PNG of the times of a frame over the faces")
    options = parser.parse_args(arguments)
    builds = Builds(python_of(options.commit), Path(sys.executable))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for row in measured(builds, options, Path(folder)):
            rows.append(row)
            print(" | ".join(shown(row)), flush=True)
    about = machine(torch.device("cpu"))
    head = ["what", f"{options.commit}, least / median", "today", "ratio", "of medians", "target", "met"]
    print("", *table(head, [shown(row) for row in rows]), sep="\n")
    print(f"\n{about['device']}, {about['cores']} cores, torch {about['torch']}, warp-lang {about['warp-lang']}")
    if options.out:
        options.out.write_text(json.dumps({"machine": about, "against": options.commit, "rows": rows}, indent=1))
    if options.picture:
        draw(rows, options.picture, options.commit)
