"""The files of a table: JSON, Markdown and PNG, each complete or not at all."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import torch

from warpgarment.io.disk.atomic import atomic_file
from warpgarment.training.data.set_manifest import package_versions
from warpgarment.view.markdown import code, escape, table

from .options import RESULTS
from .protocol import FIGURES, STARTS, cells, plain, skipped_lines

PROTOCOL = (
    "Warm: ten recorded frames, then free running. Cold: the first frame alone. Only predicted frames count. "
    "Waistbands are tied to the body's surface, nothing to recorded positions; the recording is not smoothed. Means "
    "are over the sequences that stayed finite, deepest: of all of these; failed: those that did not."
)
PACKAGES = ("warpgarment", "warp-lang", "torch", "numpy", "scipy", "libigl")
BASELINES = ("skinned", "rigid")


def publish(config: Any, result: dict[str, Any], body: list[str], draw: Callable[[Path], None] | None) -> Path:
    """Writes `<table>.json`, `.md` and, if `draw` is given and pictures are wanted, `.png`.

    Args:
        config: Configuration of the evaluation, an `EvaluateConfig`.
        result: Result with `table` and `title`; command and machine are added.
        body: Lines of Markdown between the head and the list of skipped sequences.
        draw: Function that writes a picture to a path.

    Returns:
        Path of the Markdown file.
    """
    out = Path(config.out or RESULTS)
    name = result["table"]
    result["command"], result["machine"] = command(config), machine(config.device)
    about = ", ".join(f"{k} {v}" for k, v in result["machine"].items())
    lines = [f"# {result['title']}", "", code(result["command"]), "", f"{about}.", "", *body]
    if draw is not None and config.picture:
        lines += ["", f"![{result['title']}]({name}.png)"]
        with atomic_file(out / f"{name}.png") as temporary:
            draw(temporary)
    skipped = result.get("skipped", {})
    result["skipped_count"] = len(skipped)
    lines += ["", *skipped_lines(skipped)]
    with atomic_file(out / f"{name}.json") as temporary:
        temporary.write_text(json.dumps(plain(result), indent=1, default=str), "utf-8")
    with atomic_file(out / f"{name}.md") as temporary:
        temporary.write_text("\n".join(lines).rstrip() + "\n", "utf-8")
    print("\n".join(lines[6:]).rstrip())
    print(f"wrote {name}.json, .md{' and .png' if draw is not None and config.picture else ''} to {out}")
    return out / f"{name}.md"


def grid(headings: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table with all columns aligned to the left."""
    return table(headings, rows, text=len(headings))


def means_table(rows: list[dict[str, Any]], extra: dict[str, str] | None = None) -> list[str]:
    """A Markdown table of rows with `label` and `mean` (start -> method -> figures), and of baselines if there are any.

    Args:
        rows: Rows, which also have the keys of `extra`.
        extra: key -> heading of additional columns after the label.
    """
    extra = extra or {}
    headings = ["", *extra.values(), "start", *(heading for heading, _ in FIGURES.values()), "failed"]
    lines = []
    for row in rows:
        for start in STARTS:
            for method, figures in row["mean"].get(start, {}).items():
                label = row["label"] if method == "network" else f"{row['label']}: {method}" if row["label"] else method
                label = escape(label)
                more = [str(row.get(key, "")) if method == "network" else "" for key in extra]
                failed = f"{figures['failed']} of {figures['sequences']}"
                lines.append([label, *more, start, *cells(figures), failed])
    return grid(headings, lines)


def machine(device: str | None) -> dict[str, Any]:
    """The machine and the versions of packages of a measurement."""
    gpu = (device or ("cuda" if torch.cuda.is_available() else "cpu")).startswith("cuda")
    name = torch.cuda.get_device_name(device or "cuda") if gpu else "cpu"
    return {"device": name, "threads": torch.get_num_threads()} | package_versions(PACKAGES)


def command(config: Any) -> str:
    """The command that makes the table again; it has only the names of files and folders, since results are shared."""
    words = ["warpgarment evaluate"]

    def add(options: Any) -> None:
        default = type(options)()
        for field in fields(options):
            value = getattr(options, field.name)
            if is_dataclass(value):
                add(value)
            elif value != getattr(default, field.name) and field.name not in ("out", "runs"):
                flag = field.name.replace("_", "-")
                if isinstance(value, bool):
                    words.append(f"--{flag}" if value else f"--no-{flag}")
                else:
                    values = value if isinstance(value, tuple) else (value,)
                    words.append(f"--{flag} {' '.join(shlex.quote(_name(v)) for v in values)}")

    add(config)
    return " ".join(words)


def _name(value: Any) -> str:
    text = str(value)
    return Path(text).name if isinstance(value, Path) or text.startswith("/") else text
