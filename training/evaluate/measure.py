"""Evaluation: a network's rollouts on the test sequences of a data folder, beside two baselines.

    warpgarment evaluate --data sequences --network out/run/best.safetensors --out out/evaluation
    warpgarment evaluate --table table1 --data sequences --steps 20000      # one of the paper's tables, see `tables`

Every sequence is rolled out autoregressively twice: **warm**, from its first ten recorded frames, and **cold**, from
the first alone. Only predicted frames count. Baselines start from the newest input frame of the network. Pins are tied
to the body's surface at their places in the first input frame, as in any simulation; no recorded frame is used after
the start.

A second part (`excess`) reports the network's error over that of the teacher against itself, by height and by kind, and
folds, strain and acceleration beside the recording's; its floors are the twins that `evaluate.twins` has made.

The results are `evaluation.json`, `evaluation.md` and `error_over_time.png`, each written completely or not at all. The
tables use the same function `measure`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from warpgarment.errors import MissingExtra
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.outputs import check_writable
from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.splits import evenly
from warpgarment.training.tables.options import OptionMissing, TableName, TableOptions
from warpgarment.training.tables.protocol import (
    FIGURES,
    METHODS,
    STARTS,
    cells,
    means,
    measure,
    plain,
    skipped_lines,
)
from warpgarment.training.tables.report import grid
from warpgarment.training.train.training_set import folders_of
from warpgarment.view.markdown import code, escape

from .excess import Excess
from .excess import lines as detail_lines
from .twins.stored import FOLDER


class NoTestData(ValueError):
    """No sequence could be evaluated; the message has the reasons."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Settings of an evaluation.

    Attributes:
        data: Folder of sequences.
        out: Folder for the results; those of tables go to benchmarks/results by default.
        network: Checkpoint file or folder, or the name of a network that ships. table1, table2 and recipe train
            networks of their own: small, base or fast, the shape to start from ("default" is small).
        split: Which sequences.
        frames: Most frames predicted per sequence; None: all there are.
        geodesic_frames: Frames per rollout at which geodesic distortion is sampled, evenly spaced.
        max_sequences: Evaluate this many only, evenly spread over the list.
        baselines: Also roll out the baselines.
        device: "cpu", "cuda"; None: a GPU where there is one.
        threads: CPU threads of torch; None leaves torch's own choice.
        twins: Folder of the teacher's twins of these sequences; None for DATA/twins.
        picture: Draw the error over time (needs matplotlib: extra `train`).
        table: Make one of the paper's tables or figures, or `long`, rollouts of 1,000 frames.
        tables: Options of the tables.
    """

    data: Path | None = None
    out: Path | None = None
    network: str = "default"
    split: str = "test"
    frames: int | None = None
    geodesic_frames: int = 5
    max_sequences: int | None = None
    baselines: bool = True
    device: str | None = None
    threads: int | None = None
    twins: Path | None = None
    picture: bool = True
    table: TableName | None = None
    tables: tyro.conf.OmitArgPrefixes[TableOptions] = field(default_factory=TableOptions)


def evaluate(config: EvaluateConfig) -> dict[str, Any]:
    """Evaluates a network, or makes a table.

    Returns:
        `settings`, `network` (file, config, notes), `sequences` (per sequence and start: figures of each method),
        `mean` (start -> method -> figures), `detail` (see `excess.Excess.result`), `skipped` (name -> reason),
        `skipped_count`, `frames_predicted`, `seconds_per_frame`; for tables what `tables.make_table` returns.

    Raises:
        OptionMissing: There are no data or no output folder.
        NoTestData: No sequence can be evaluated.
        CheckpointError: The network does not exist or cannot be read.
        MissingExtra: A picture is wanted and matplotlib is missing.
    """
    if config.threads:
        import torch

        torch.set_num_threads(config.threads)
    if config.picture:
        _pyplot()
    if config.table is not None:
        from warpgarment.training.tables import make_table

        return make_table(config)
    if config.data is None or config.out is None:
        raise OptionMissing(f"an evaluation needs --{'data' if config.data is None else 'out'} FOLDER")
    check_writable(Path(config.out) / "evaluation.json")
    path = checkpoint.find(config.network, device=config.device)
    simulator = Simulator(checkpoint.load(path), config.device)
    skipped: dict[str, str] = {}
    folders = evenly(folders_of(Path(config.data), config.split, skipped), config.max_sequences)
    excess = Excess(config.twins or Path(config.data) / FOLDER)
    measured = measure(
        simulator,
        folders,
        frames=config.frames,
        geodesic_frames=config.geodesic_frames,
        baselines=config.baselines,
        observe=excess.observe,
    )
    skipped |= measured.skipped
    if not measured.rows:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3])
        raise NoTestData(f"{config.data}: no {config.split} sequence to evaluate ({reasons or 'none found'})")
    settings = {k: v for k, v in vars(config).items() if k not in ("table", "tables")}
    result = {
        "settings": {k: v.name if isinstance(v, Path) else v for k, v in settings.items()},  # without private folders
        "network": _describe(path, simulator),
        "frames_predicted": measured.frames,
        "seconds_per_frame": measured.seconds / max(measured.frames, 1),
        "mean": means(measured.rows),
        "sequences": measured.rows,
        "detail": excess.result(),
        "skipped": skipped,
        "skipped_count": len(skipped),
    }
    write(Path(config.out), result, measured.curves, picture=config.picture)
    return result


def write(out: Path, result: dict[str, Any], curves: dict[tuple[str, str], list[np.ndarray]], *, picture: bool) -> None:
    """Writes the result files, each completely or not at all.

    Args:
        out: Folder of the files.
        result: Result of :func:`evaluate`.
        curves: (method, start) -> error over time [cm], one array per sequence.
        picture: Whether the picture is drawn.
    """
    with atomic_file(out / "evaluation.json") as path:
        path.write_text(json.dumps(plain(result), indent=1), "utf-8")
    with atomic_file(out / "evaluation.md") as path:
        path.write_text(table(result), "utf-8")
    if picture:
        with atomic_file(out / "error_over_time.png") as path:
            draw(path, curves)


def table(result: dict[str, Any]) -> str:
    """The result as Markdown: the means, then every sequence."""
    lines = [
        "# Evaluation",
        "",
        f"Network {code(result['network']['file'])}, data {code(result['settings']['data'])}: "
        f"{result['frames_predicted']:,} predicted frames, {1000 * result['seconds_per_frame']:.0f} ms each.",
        "",
        "Warm: from ten recorded frames; cold: from the first alone. Only predicted frames count. Chamfer and "
        "geodesic distortion at sampled frames; deepest: of all sequences.",
        "",
    ]
    headings = [heading for heading, _ in FIGURES.values()]
    rows: list[list[str]] = []
    for start, methods in result["mean"].items():
        rows += [[start, method, *cells(f), str(f["failed"])] for method, f in methods.items()]
    lines += [*grid(["start", "method", *headings, "failed"], rows), ""]
    rows = []
    for row in result["sequences"]:
        for method in METHODS:
            if method in row:
                rows.append([escape(row["sequence"]), row["start"], str(row["frames"]), method, *cells(row[method])])
    lines += [*grid(["sequence", "start", "frames", "method", *headings], rows), ""]
    if "detail" in result:  # evaluations of before have none
        lines += detail_lines(result["detail"])
    lines += skipped_lines(result["skipped"])
    return "\n".join(lines).rstrip() + "\n"


def draw(path: Path, curves: dict[tuple[str, str], list[np.ndarray]]) -> None:
    """Draws the mean error over time of the sequences that are long enough: a curve per method, a panel per start.

    Args:
        path: PNG file to write.
        curves: (method, start) -> error over time [cm], one array per sequence.
    """
    pyplot = _pyplot()
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), sharey=True, constrained_layout=True)
    for axis, start in zip(axes, STARTS, strict=True):
        for method in METHODS:
            errors = curves.get((method, start), [])
            if not errors:
                continue
            padded = np.full((len(errors), max(map(len, errors))), np.nan)
            for i, curve in enumerate(errors):
                padded[i, : len(curve)] = curve
            counted = np.maximum(np.isfinite(padded).sum(axis=0), 1)
            mean = np.where(np.isfinite(padded).any(axis=0), np.nansum(padded, axis=0) / counted, np.nan)
            axis.plot(np.arange(1, len(mean) + 1), mean, label=f"{method} ({len(errors)})")
        axis.set(title=f"{start} start", xlabel="predicted frame")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("mean vertex error [cm]")
    axes[0].set_ylim(bottom=0)
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=150, format="png")
    pyplot.close(figure)


def _describe(path: Path, simulator: Simulator) -> dict[str, Any]:
    _, notes = checkpoint.read_metadata(path)
    return {"file": path.name, "config": simulator.network.config.as_dict(), "notes": notes}


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtra("train", "The picture of an evaluation (switched off by picture=False)") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot
