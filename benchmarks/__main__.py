"""Times kernels, network and frames against references in one run on one device; writes JSON, tables and plots.

    python -m benchmarks                               # all parts, about ten minutes on one core
    python -m benchmarks --quick                       # fewer sizes, one or two minutes
    python -m benchmarks --only stages roofline
    python -m benchmarks --faces 1000 --batch 1 8      # other sizes and batches
    python -m benchmarks against 1a9fae1               # beside an earlier build, see benchmarks/against

The parts are `geodesics`, distances over the cloth; `stages`, each kernel beside the published method; `batch`, whole
frames, packed and one by one; `roofline`, the network beside the device's own rates; `teacher`, whole frames beside
Newton's VBD; `profile`, launches and waits within a frame. A CPU is measured on one thread. Calls that are compared
take turns. Frames are those of the networks `small` and `fast`, or of the networks given by `--network`. Results are in
benchmarks/results/<device>.json, .md and .png. The extras `physics` and `train` are needed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import torch

from benchmarks.against.__main__ import main as against
from benchmarks.measure import RESULTS, Row, machine
from benchmarks.networks import DEFAULT, named
from warpgarment.io.disk.atomic import atomic_files

from . import batch, frames, manifold, report, roofline, stages, teacher

PARTS = ("geodesics", "stages", "batch", "roofline", "teacher", "profile")
FACES = (500, 1000, 2000, 5000, 10000)
QUICK = (500, 2000)
GEODESICS = (1000, 2000, 5000)  # numbers of faces; without --quick also 10000, which later parts of that size need
SECONDS = {False: 0.5, True: 0.15}  # --quick -> time spent on each call that is timed [s]


def measured(options: argparse.Namespace, device: torch.device) -> Iterator[Row]:
    """All rows of the parts that the options name."""
    seconds, networks = SECONDS[options.quick], named(options.network)
    if "geodesics" in options.only:
        yield from manifold.geodesics(options.geodesics)
    if "stages" in options.only:
        yield from stages.all_rows(options.faces, options.large, device, seconds)
    if "batch" in options.only:
        yield from batch.rows(options.faces, options.batch, device, networks, seconds)
    if "roofline" in options.only:
        sizes = options.faces if options.quick or device.type == "cuda" else options.faces[:4]
        yield from roofline.rows(sizes, options.batch[:: len(options.batch) - 1 or 1], device, networks, seconds)
    if "teacher" in options.only:
        yield from teacher.against(options.faces[:2], device, networks, 2 if options.quick else 6)
    if "profile" in options.only:
        yield from frames.rows(options.faces[0], (1, 2, 8), device, networks)


def shown(rows: Iterable[Row]) -> Iterator[Row]:
    """Prints rows as they are measured, and passes them on."""
    began = time.perf_counter()
    for row in rows:
        where = " ".join(f"{row[key]:>6,} {key}" for key in ("faces", "batch") if key in row)
        where += f" {row['network']}" if "network" in row else ""
        if "note" in row:
            text = f"{row.get('reference', '')} {row['note']}".strip()
        elif "median_ms" in row:
            text = f"{row.get('min_ms', row['median_ms']):10.2f} ms"
            text += f"   {row['ratio']:8.2f} x {row['reference']}" if "ratio" in row else ""
            text += f"   {row['achieved']:.0%} of the roofline" if "achieved" in row else ""
        elif "reached" in row and "warp_launches" not in row:
            text = ""
        else:
            text = ", ".join(
                f"{k} {v:g}"
                for k, v in row.items()
                if isinstance(v, (int, float)) and k not in ("faces", "batch", "met")
            )
        if "target" in row:
            text += f"   {'met' if row['met'] else 'MISSED'}: {row['target']} ({row['reached']})"
        print(f"{time.perf_counter() - began:6.0f} s  {where:<22} {row['what']:<36} {text}", flush=True)
        yield row


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the parts that the arguments name and writes the results; `against` is `benchmarks/against`."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["against"]:
        return against(given[1:])
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run")
    parser.add_argument("--faces", type=int, nargs="+", help="sizes of the garment")
    parser.add_argument("--batch", type=int, nargs="+", help="garments at once")
    parser.add_argument("--quick", action="store_true", help="fewer sizes and shorter")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--network",
        nargs="+",
        default=list(DEFAULT),
        metavar="NAME",
        help="timed: networks that ship, files, or untrained small, fast or base; default: %(default)s",
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    options = parser.parse_args(arguments)
    device = torch.device(options.device)
    options.geodesics = options.faces or [*GEODESICS, *([] if options.quick else [10_000])]
    options.large = not options.faces and not options.quick
    options.faces = options.faces or list(QUICK if options.quick else FACES)
    everything = batch.CPU_BATCH if device.type == "cpu" else batch.GPU_BATCH
    options.batch = options.batch or list(everything[:3] if options.quick else everything)
    if device.type == "cpu":
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        torch.set_num_threads(1)
    began = time.perf_counter()
    rows = list(shown(measured(options, device)))
    command = " ".join(["python -m benchmarks", *(sys.argv[1:] if arguments is None else arguments)])
    about = machine(device)
    target = options.out / device.type
    spent = round(time.perf_counter() - began)
    files = [target.with_suffix(suffix) for suffix in (".json", ".md", ".png")]
    with atomic_files(*files) as (data, table, picture):
        data.write_text(json.dumps({"machine": about, "command": command, "seconds": spent, "rows": rows}, indent=1))
        table.write_text(report.markdown(about, command, rows))
        report.plot(picture, about, rows)
    print(f"written {target}.json, .md and .png")


if __name__ == "__main__":
    main()
