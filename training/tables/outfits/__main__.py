"""Tables 4 and 5 of LayersNet on one's own outfits, one command each:

    python -m warpgarment.training.tables.outfits train-static --data LAYERS --out static.safetensors --minutes 30
    python -m warpgarment.training.tables.outfits table4 --data LAYERS --network LayersNet=run/best.safetensors
    python -m warpgarment.training.tables.outfits table5 --data LAYERS --network LayersNet=run/best.safetensors

Rows: the recording; every network, without and with contact between garments, and with `--apart` each garment alone;
the static baseline if it is given; the skinned and the rigid baseline. `rows/` in the output folder has every rollout;
table5 takes from there what table4 has measured.
"""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from warpgarment.io.disk.atomic import atomic_file
from warpgarment.training.data.splits import evenly
from warpgarment.training.tables.options import RESULTS, DataLacks, OptionMissing
from warpgarment.training.tables.protocol import plain, skipped_lines
from warpgarment.training.tables.report import machine
from warpgarment.training.train.training_set import folders_of, reason_of
from warpgarment.view.markdown import code, escape

from . import page
from .means import means
from .measuring import Case, measure_row
from .rows import WHOLE, WINDOW, rows_of
from .static import notes_of
from .static_training import train_static

TITLES = {
    "table4": "Table 4: tight and loose inner garments, without and with wind",
    "table5": "Table 5: outfits by category",
}
NOT_BUILT = (
    "MGNet is one network for one garment and has no row. GarSim has none of its own: nearest to it is a row with "
    "garments apart, a LayersNet in which each garment is alone with its body, though trained on whole outfits. The "
    "static row is in the manner of DeePSD (training/tables/outfits/static.py), without losses against collisions; it "
    "is bound in frame 0 in windows too, while all other rows start from frame 60."
)
PAGE = "The commands below write this page (`--page`). layersnet.md says what differs from the publication."


@dataclass(frozen=True)
class Table:
    """Options of both tables.

    Attributes:
        data: Folder of sequences.
        out: Folder of the table, and of every rollout in rows/.
        network: NAME=CHECKPOINT each: a file, a folder, or the name of a network that ships.
        apart: Names of networks that also have a row in which each garment is alone with its body.
        contact: Whether every network also has a row with contact between garments.
        static: Checkpoint of the static baseline.
        splits: Splits whose sequences are measured.
        starts: The 35-frame windows, whole sequences, or both.
        frames: Most frames of rollouts of whole sequences; None: all.
        sequences: Most sequences, evenly spread over the list; None: all.
        device: Device of the networks; None: a GPU where there is one.
        threads: CPU threads of torch; None leaves torch's own choice.
        page: Markdown file that is to hold all tables in the output folder.
    """

    data: Path
    out: Path = RESULTS / "outfits"
    network: tuple[str, ...] = ("fast=fast",)
    apart: tuple[str, ...] = ()
    contact: bool = True
    static: Path | None = None
    splits: tuple[Literal["train", "validation", "test"], ...] = ("test",)
    starts: tuple[Literal["window", "whole"], ...] = ("window", "whole")
    frames: int | None = None
    sequences: int | None = None
    device: str | None = None
    threads: int | None = None
    page: Path | None = None


@dataclass(frozen=True)
class Table4(Table):
    """Tight or loose inner garments, without and with wind."""


@dataclass(frozen=True)
class Table5(Table):
    """By category."""


@dataclass(frozen=True)
class TrainStatic:
    """Train the static baseline.

    Attributes:
        data: Folder of sequences.
        out: File of safetensors to write.
        minutes: Time of the processor, all threads together [min].
        seed: Seed of the training.
        threads: CPU threads of torch; None leaves torch's own choice.
    """

    data: Path
    out: Path
    minutes: float = 30.0
    seed: int = 0
    threads: int | None = None


def make(options: Table) -> dict[str, Any]:
    """Measures what is not measured yet and writes the table as JSON and Markdown.

    Returns:
        The contents of the JSON file: `table`, `command`, `machine`, `skipped`, `means` (start -> row -> means),
        `networks`, and `rows` (row -> every rollout).

    Raises:
        OptionMissing: A network is not NAME=CHECKPOINT.
        DataLacks: There is no sequence to measure.
    """
    name = type(options).__name__.lower()
    named = [_named(text) for text in options.network]
    networks = dict(named)
    if len(networks) < len(named):
        raise OptionMissing(f"--network: a name is given twice in {' '.join(options.network)}")
    rows = rows_of(networks, contact=options.contact, apart=options.apart, static=options.static, device=options.device)
    skipped: dict[str, str] = {}
    folders = [f for split in dict.fromkeys(options.splits) for f in folders_of(Path(options.data), split, skipped)]
    cases = []
    for folder in evenly(folders, options.sequences):
        try:
            cases.append(Case.of(folder))
        except Exception as error:
            skipped[folder.name] = reason_of(error)
    if not cases:
        wanted = ", ".join(options.splits)
        raise DataLacks(f"{options.data}: no sequence of {wanted} to measure ({len(skipped)} skipped)")
    starts = [start for start in (WINDOW, WHOLE) if start.name in options.starts]
    for start in starts:
        short = [case.folder.name for case in cases if not case.steps(start, options.frames)]
        skipped |= {f"{case} ({start.name})": "too short" for case in short}
    results = {row.name: measure_row(row, cases, starts, options.frames, options.out / "rows") for row in rows}
    result: dict[str, Any] = {"table": name, "title": TITLES[name], "command": command(options, name)}
    result |= {"machine": machine(options.device), "skipped": skipped}
    result["networks"] = {row.name: {"file": row.file.name, "sha256": row.checksum} for row in rows if row.file}
    if options.static is not None:
        result["static"] = notes_of(options.static)
    result["means"] = {
        start.name: {row: means(r for r in found if r["start"] == start.name) for row, found in results.items()}
        for start in starts
    }
    result["rows"] = results
    _write(options, result, getattr(page, name)(results))
    return result


def command(options: Any, name: str) -> str:
    """The command that makes the table again, with the names of files and folders alone."""
    words = [f"python -m warpgarment.training.tables.outfits {name}"]
    for field in fields(options):
        value = getattr(options, field.name)
        if field.name in ("out", "page") or (field.name != "data" and value == field.default):
            continue
        flag = field.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
            continue
        values = value if isinstance(value, tuple) else (value,)
        words.append(f"--{flag} " + " ".join(shlex.quote(_without_folders(v)) for v in values))
    return " ".join(words)


def main(arguments: list[str] | None = None) -> None:
    """Runs one command."""
    kinds: Any = Table4 | Table5 | TrainStatic
    options = tyro.cli(kinds, prog="python -m warpgarment.training.tables.outfits", args=arguments, description=__doc__)
    if options.threads:
        torch.set_num_threads(options.threads)
    if isinstance(options, TrainStatic):
        notes = train_static(options.data, options.out, options.minutes, seed=options.seed)
        print(json.dumps(notes, indent=1))
    else:
        make(options)


def _write(options: Table, result: dict[str, Any], body: list[str]) -> None:
    name, out = result["table"], options.out
    about = ", ".join(f"{k} {v}" for k, v in result["machine"].items())
    lines = [f"# {result['title']}", "", code(result["command"]), "", f"{about}.", "", *body, "", NOT_BUILT]
    if "static" in result:
        notes = result["static"]
        lines += ["", f"The static row was trained for {notes.get('minutes')} minutes of one processor: "
                  f"{notes.get('steps'):,} steps on {notes.get('train')} sequences."]  # fmt: skip
    failed = {r["reason"] for found in result["rows"].values() for r in found if r["reason"]}
    lines += [line for reason in sorted(failed) for line in ("", f"A rollout failed: {escape(reason)}")]
    lines += ["", *skipped_lines(result["skipped"])]
    with atomic_file(out / f"{name}.json") as temporary:
        temporary.write_text(json.dumps(plain(result), indent=1), "utf-8")
    with atomic_file(out / f"{name}.md") as temporary:
        temporary.write_text("\n".join(lines).rstrip() + "\n", "utf-8")
    print("\n".join(lines[6:]).rstrip())
    print(f"wrote {name}.json and {name}.md to {out}")
    if options.page is not None:
        parts = [(out / f"{table}.md").read_text("utf-8") for table in TITLES if (out / f"{table}.md").exists()]
        text = re.sub("^#", "##", "\n".join(parts), flags=re.MULTILINE)
        with atomic_file(options.page) as temporary:
            temporary.write_text(f"# Layered outfits measured\n\n{PAGE}\n\n{text.rstrip()}\n", "utf-8")


def _named(text: str) -> tuple[str, str]:
    name, separator, place = text.partition("=")
    if not (name and separator and place):
        raise OptionMissing(f"--network {text}: networks are NAME=CHECKPOINT")
    return name, place


def _without_folders(value: Any) -> str:
    text = str(value)
    name, separator, place = text.partition("=")
    return name + separator + Path(place).name if separator else Path(text).name if "/" in text else text


if __name__ == "__main__":
    main()
