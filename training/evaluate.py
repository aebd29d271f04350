"""Evaluation: a network's rollouts on the test sequences of a data folder, beside two baselines.

    warpgarment evaluate --data sequences --network out/run/best.safetensors --out out/evaluation

Every sequence is rolled out autoregressively twice: **warm**, from its first ten recorded frames, and **cold**, from
the first alone. Only predicted frames count. Baselines start from the newest frame that the network saw. Pins are
tied to the body's surface where they were in the first frame the method saw, as in any simulation; nothing recorded
is used after the start.

Writes `evaluation.json`, `evaluation.md` and `error_over_time.png`, each complete or not at all.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warpgarment import checkpoint, metrics
from warpgarment.body import BodyMotion
from warpgarment.errors import MissingExtra
from warpgarment.simulator import Simulator
from warpgarment.training.baselines import rigid, skinned
from warpgarment.training.dataset import Sequence, list_sequences
from warpgarment.training.rollouts import predict

METHODS = ("network", "skinned", "rigid")
STARTS = ("warm", "cold")
FIGURES = {  # key -> heading, format
    "mean_vertex_error_cm": ("error [cm]", "{:.2f}"),
    "chamfer_m2": ("chamfer [m²]", "{:.2e}"),
    "geodesic_distortion_m": ("geodesic distortion [m]", "{:.2e}"),
    "body_collision": ("inside body [%]", "{:.2%}"),
    "max_penetration_m": ("deepest [mm]", "{:.1f}"),
}


class NoTestData(ValueError):
    """No sequence could be evaluated; the message says why."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Settings of an evaluation.

    Attributes:
        data: Folder of sequences.
        out: Folder for the results.
        network: Checkpoint file or folder, or the name of a network that ships.
        split: Which sequences.
        frames: Most frames predicted per sequence; None: all there are.
        geodesic_frames: Frames per rollout at which geodesic distortion is sampled, evenly spaced.
        max_sequences: Evaluate this many only, evenly spread over the list.
        baselines: Also roll out the baselines.
        device: "cpu", "cuda"; None: a GPU where there is one.
        threads: CPU threads of torch; None leaves torch's own choice.
        picture: Draw the error over time (needs matplotlib: extra `train`).
    """

    data: Path
    out: Path
    network: str = "default"
    split: str = "test"
    frames: int | None = None
    geodesic_frames: int = 5
    max_sequences: int | None = None
    baselines: bool = True
    device: str | None = None
    threads: int | None = None
    picture: bool = True


def evaluate(config: EvaluateConfig) -> dict[str, Any]:
    """Evaluates a network.

    Returns:
        `settings`, `network` (file, config, notes), `sequences` (per sequence and start: figures of each method),
        `mean` (start -> method -> figures), `skipped` (name -> reason), `frames_predicted`, `seconds_per_frame`.

    Raises:
        NoTestData: Nothing to evaluate.
        CheckpointError: No such network.
        MissingExtra: A picture is wanted and matplotlib is missing.
    """
    if config.threads:
        import torch

        torch.set_num_threads(config.threads)
    if config.picture:
        _pyplot()
    path = checkpoint.find(config.network)
    simulator = Simulator(checkpoint.load(path), config.device)
    history = simulator.network.config.history
    folders = _chosen(list_sequences(Path(config.data), split=config.split), config.max_sequences)
    rows: list[dict[str, Any]] = []
    curves: dict[tuple[str, str], list[np.ndarray]] = {}
    skipped: dict[str, str] = {}
    spent, predicted_frames = 0.0, 0
    for folder in tqdm(folders, desc="evaluating", unit="sequence"):
        try:
            sequence = Sequence.load(folder)
            body = sequence.body()
            last = min(len(sequence.vertices), body.frames) - 1
            if last < history:
                raise ValueError(f"{last + 1} frames, fewer than history + 1 = {history + 1}")
            if not np.isfinite(np.asarray(sequence.vertices)).all():
                raise ValueError("recorded garment positions are not finite")
        except (ValueError, OSError, KeyError, IndexError) as error:
            skipped[Path(folder).name] = f"{type(error).__name__}: {error}"
            continue
        for start in STARTS:
            newest = history - 1 if start == "warm" else 0
            steps = min(last - newest, config.frames or last)
            truth = np.array(sequence.vertices[newest + 1 : newest + steps + 1], np.float32)
            after = np.asarray(body.vertices[newest + 1 : newest + steps + 1])
            row = {"sequence": Path(folder).name, "start": start, "frames": steps}
            row |= {key: sequence.manifest.get(key, "") for key in ("category", "motion", "body")}
            for method, run in _methods(simulator, sequence, body, newest, steps, start, config.baselines).items():
                began = time.perf_counter()
                vertices = run()
                if method == "network":
                    spent, predicted_frames = spent + time.perf_counter() - began, predicted_frames + steps
                faces = sequence.garment.faces
                row[method] = figures(vertices, truth, faces, after, body.faces, config.geodesic_frames)
                error = 100.0 * np.linalg.norm(vertices.astype(np.float64) - truth, axis=-1).mean(axis=1)
                curves.setdefault((method, start), []).append(error)
            rows.append(row)
    if not rows:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3])
        raise NoTestData(f"{config.data}: no {config.split} sequence to evaluate ({reasons or 'none found'})")
    result = {
        "settings": {k: v.name if isinstance(v, Path) else v for k, v in vars(config).items()},  # results travel
        "network": _describe(path, simulator),
        "frames_predicted": predicted_frames,
        "seconds_per_frame": spent / max(predicted_frames, 1),
        "mean": means(rows),
        "sequences": rows,
        "skipped": skipped,
    }
    write(Path(config.out), result, curves, picture=config.picture)
    return result


def figures(
    vertices: np.ndarray,
    truth: np.ndarray,
    faces: np.ndarray,
    body_vertices: np.ndarray,
    body_faces: np.ndarray,
    geodesic_frames: int,
) -> dict[str, float]:
    """All figures of one rollout, [T,V,3] against [T,V,3] on a body [T,U,3]; inf or NaN where it failed."""
    finite = bool(np.isfinite(vertices).all())
    sampled = np.unique(np.linspace(0, len(vertices) - 1, max(geodesic_frames, 1)).round().astype(int))
    return {
        "mean_vertex_error_cm": float(metrics.mean_vertex_error(vertices, truth)) if finite else math.inf,
        "chamfer_m2": float(metrics.chamfer_distance(vertices[sampled], truth[sampled])),
        "geodesic_distortion_m": float(metrics.geodesic_distortion(vertices[sampled], truth[sampled], faces)),
        "body_collision": float(metrics.body_collision(vertices, body_vertices, body_faces)),
        "max_penetration_m": float(metrics.max_penetration(vertices, body_vertices, body_faces)),
        "finite": finite,
    }


def means(rows: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Means over sequences, start -> method -> figure (penetration: the deepest), over those that stayed finite."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for start in STARTS:
        for method in METHODS:
            found = [row[method] for row in rows if row["start"] == start and method in row]
            if not found:
                continue
            good = [f for f in found if f["finite"]]
            mean = {key: float(np.mean([f[key] for f in good])) if good else math.nan for key in FIGURES}
            mean["max_penetration_m"] = max((f["max_penetration_m"] for f in good), default=math.nan)
            result.setdefault(start, {})[method] = mean | {"failed": len(found) - len(good), "sequences": len(found)}
    return result


def write(out: Path, result: dict[str, Any], curves: dict[tuple[str, str], list[np.ndarray]], *, picture: bool) -> None:
    """Writes the result files, each under another name first."""
    out.mkdir(parents=True, exist_ok=True)
    _replace(out / "evaluation.json", lambda path: path.write_text(json.dumps(_plain(result), indent=1), "utf-8"))
    _replace(out / "evaluation.md", lambda path: path.write_text(table(result), "utf-8"))
    if picture:
        _replace(out / "error_over_time.png", lambda path: draw(path, curves))


def table(result: dict[str, Any]) -> str:
    """The result as Markdown: means first, then every sequence."""
    lines = [
        "# Evaluation",
        "",
        f"Network `{result['network']['file']}`, data `{result['settings']['data']}`: "
        f"{result['frames_predicted']:,} predicted frames, {1000 * result['seconds_per_frame']:.0f} ms each.",
        "",
        "Warm: from ten recorded frames; cold: from the first alone. Only predicted frames count. Chamfer and "
        "geodesic distortion at sampled frames; deepest: of all sequences.",
        "",
    ]
    headings = [heading for heading, _ in FIGURES.values()]
    lines += _row(["start", "method", *headings, "failed"]), _row(["---"] * (len(headings) + 3))
    for start, methods in result["mean"].items():
        lines += [_row([start, method, *_cells(f), str(f["failed"])]) for method, f in methods.items()]
    lines += ["", _row(["sequence", "start", "frames", "method", *headings]), _row(["---"] * (len(headings) + 4))]
    for row in result["sequences"]:
        for method in METHODS:
            if method in row:
                lines.append(_row([row["sequence"], row["start"], str(row["frames"]), method, *_cells(row[method])]))
    lines += ["", *(f"Skipped {name}: {reason}" for name, reason in result["skipped"].items())]
    return "\n".join(lines).rstrip() + "\n"


def draw(path: Path, curves: dict[tuple[str, str], list[np.ndarray]]) -> None:
    """Error over time: mean over the sequences that last so long, one curve per method, one panel per start."""
    pyplot = _pyplot()
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), sharey=True, constrained_layout=True)
    for axis, start in zip(axes, STARTS, strict=True):
        for method in METHODS:
            found = curves.get((method, start), [])
            if not found:
                continue
            padded = np.full((len(found), max(map(len, found))), np.nan)
            for i, curve in enumerate(found):
                padded[i, : len(curve)] = curve
            counted = np.maximum(np.isfinite(padded).sum(axis=0), 1)
            mean = np.where(np.isfinite(padded).any(axis=0), np.nansum(padded, axis=0) / counted, np.nan)
            axis.plot(np.arange(1, len(mean) + 1), mean, label=f"{method} ({len(found)})")
        axis.set(title=f"{start} start", xlabel="predicted frame")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("mean vertex error [cm]")
    axes[0].set_ylim(bottom=0)
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=150, format="png")
    pyplot.close(figure)


def _methods(
    simulator: Simulator, sequence: Sequence, body: BodyMotion, newest: int, steps: int, start: str, baselines: bool
) -> dict[str, Callable[[], np.ndarray]]:
    """What to roll out: each gives vertices of frames newest+1 .. newest+steps."""
    methods = {"network": lambda: predict(simulator, sequence, newest, steps, cold=start == "cold", body=body)}
    if baselines:
        first = np.array(sequence.vertices[newest], np.float32)
        part = BodyMotion(body.vertices[newest : newest + steps + 1], body.faces, body.fps)
        methods["skinned"] = lambda: skinned(sequence.garment, first, part)[1:]
        methods["rigid"] = lambda: rigid(sequence.garment, first, part)[1:]
    return methods


def _chosen(folders: list[Path], most: int | None) -> list[Path]:
    if most is None or len(folders) <= most:
        return folders
    return [folders[(i * len(folders)) // most] for i in range(most)]


def _describe(path: Path, simulator: Simulator) -> dict[str, Any]:
    _, notes = checkpoint.read_metadata(path)
    return {"file": path.name, "config": vars(simulator.network.config), "notes": notes}


def _cells(values: dict[str, float]) -> list[str]:
    scale = {"max_penetration_m": 1000.0}
    return [form.format(values[key] * scale.get(key, 1.0)) for key, (_, form) in FIGURES.items()]


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _plain(value: Any) -> Any:
    """JSON knows neither infinity nor NaN: null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _replace(path: Path, make: Callable[[Path], Any]) -> None:
    temporary = path.with_name(f".{path.name}.partial")
    try:
        make(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _pyplot():
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtra("train", "The picture of an evaluation (switched off by picture=False)") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot
