"""The protocol of all measurements: rollouts of sequences from two starts, their figures, and the means of these.

Every sequence is rolled out twice: **warm**, from the ten recorded frames of a network's history, and **cold**, from
the first frame alone. After the start no recorded frames are used; only predicted frames count. Pins are tied to the
body's surface, never to recorded positions, and the recording is compared without smoothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warpgarment import metrics
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.rollouts import check_rate, predict, rigid, skinned
from warpgarment.training.train.training_set import reason_of
from warpgarment.view.markdown import escape

METHODS = ("network", "skinned", "rigid")
STARTS = ("warm", "cold")
FIGURES = {  # key -> heading, format
    "mean_vertex_error_cm": ("error [cm]", "{:.2f}"),
    "chamfer_m2": ("chamfer [m²]", "{:.2e}"),
    "geodesic_distortion_m": ("geodesic distortion [m]", "{:.2e}"),
    "body_collision": ("inside body [%]", "{:.2%}"),
    "max_penetration_m": ("deepest [mm]", "{:.1f}"),
}


@dataclass
class Measured:
    """Rollouts of one network, measured.

    Attributes:
        rows: Figures of each method, one row per sequence and start.
        curves: (method, start) -> error over time [cm], one array per sequence.
        skipped: Sequence -> reason.
        frames: Number of frames that the network predicted.
        seconds: Time that the network took for them [s].
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    curves: dict[tuple[str, str], list[np.ndarray]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    frames: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Known:
    """The part of a sequence that `rollouts.predict` reads: a garment and its first frames [m], [H,V,3]."""

    garment: Garment
    vertices: np.ndarray


def measure(
    simulator: Simulator,
    folders: list[Path],
    *,
    frames: int | None = None,
    geodesic_frames: int = 5,
    baselines: bool = True,
    observe: Callable[[Sequence, BodyMotion, str, int, np.ndarray], None] | None = None,
) -> Measured:
    """Rolls sequences out from both starts and measures them.

    Args:
        simulator: Simulator with the network.
        folders: Folders of the sequences; those that cannot be evaluated are skipped with a reason.
        frames: Largest number of frames predicted per sequence; None for all.
        geodesic_frames: Number of frames per rollout at which geodesic distortion is sampled.
        baselines: Whether the baselines are rolled out, too.
        observe: Function that is called for every rollout of the network with the sequence, its body, the start, the
            index of the newest recorded frame that was an input, and the predicted vertices [m], [T,V,3].
    """
    history = simulator.network.config.history
    result = Measured()
    for folder in tqdm(folders, desc="evaluating", unit="sequence"):
        try:
            sequence = Sequence.load(folder)
            body = sequence.body()
            check_rate(body.fps, simulator.network.config.fps)
            last = min(len(sequence.vertices), body.frames) - 1
            if last < history:
                raise ValueError(f"{last + 1} frames, fewer than history + 1 = {history + 1}")
            if not np.isfinite(np.asarray(sequence.vertices)).all():
                raise ValueError("recorded garment positions are not finite")
        except Exception as error:
            result.skipped[Path(folder).name] = reason_of(error)
            continue
        for start in STARTS:
            newest = history - 1 if start == "warm" else 0
            steps = min(last - newest, frames or last)
            truth = np.array(sequence.vertices[newest + 1 : newest + steps + 1], np.float32)
            after = np.asarray(body.vertices[newest + 1 : newest + steps + 1])
            row = {"sequence": Path(folder).name, "start": start, "frames": steps}
            row |= {key: sequence.manifest.get(key, "") for key in ("category", "motion", "body")}
            for method, run in _methods(simulator, sequence, body, newest, steps, start, baselines).items():
                began = time.perf_counter()
                vertices = run()
                if method == "network":
                    result.seconds += time.perf_counter() - began
                    result.frames += steps
                    if observe is not None:
                        observe(sequence, body, start, newest, vertices)
                row[method] = figures(vertices, truth, sequence.garment.faces, after, body.faces, geodesic_frames)
                errors = 100.0 * np.linalg.norm(vertices.astype(np.float64) - truth, axis=-1).mean(axis=1)
                result.curves.setdefault((method, start), []).append(errors)
            result.rows.append(row)
    return result


def figures(
    vertices: np.ndarray,
    truth: np.ndarray,
    faces: np.ndarray,
    body_vertices: np.ndarray,
    body_faces: np.ndarray,
    geodesic_frames: int,
) -> dict[str, float]:
    """All figures of one rollout; inf or NaN if it failed.

    Args:
        vertices: Predicted positions [m], [T,V,3].
        truth: Recorded positions [m], [T,V,3].
        faces: Vertex indices of the garment, [F,3].
        body_vertices: Positions of the body [m], [T,U,3].
        body_faces: Vertex indices of the body, [G,3].
        geodesic_frames: Number of frames at which geodesic distortion is sampled.
    """
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
    """Means over the sequences that stayed finite (for penetration, the largest): start -> method -> figure."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for start in STARTS:
        for method in METHODS:
            runs = [row[method] for row in rows if row["start"] == start and method in row]
            if not runs:
                continue
            good = [f for f in runs if f["finite"]]
            mean = {key: float(np.mean([f[key] for f in good])) if good else math.nan for key in FIGURES}
            mean["max_penetration_m"] = max((f["max_penetration_m"] for f in good), default=math.nan)
            result.setdefault(start, {})[method] = mean | {"failed": len(runs) - len(good), "sequences": len(runs)}
    return result


def cells(values: dict[str, float]) -> list[str]:
    """Figures as text, in the order of `FIGURES`; depth in millimetres."""
    scale = {"max_penetration_m": 1000.0}
    return [form.format(values[key] * scale.get(key, 1.0)) for key, (_, form) in FIGURES.items()]


def skipped_lines(skipped: dict[str, str]) -> list[str]:
    """The number of skipped sequences and the reasons, as lines of Markdown; empty if none was skipped."""
    if not skipped:
        return []
    count = f"{len(skipped)} sequence{'s' if len(skipped) > 1 else ''} skipped:"
    return [count, "", *(f"- {escape(f'{name}: {reason}')}" for name, reason in sorted(skipped.items()))]


def plain(value: Any) -> Any:
    """A value for JSON, which has neither infinity nor NaN: they become None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _methods(
    simulator: Simulator, sequence: Sequence, body: BodyMotion, newest: int, steps: int, start: str, baselines: bool
) -> dict[str, Callable[[], np.ndarray]]:
    """Rollouts by method: functions that return the vertices of frames newest+1 .. newest+steps [m], [steps,V,3]."""
    methods = {"network": lambda: predict(simulator, sequence, newest, steps, cold=start == "cold", body=body)}
    if baselines:
        first = np.array(sequence.vertices[newest], np.float32)
        part = BodyMotion(body.vertices[newest : newest + steps + 1], body.faces, body.fps)
        methods["skinned"] = lambda: skinned(sequence.garment, first, part)[1:]
        methods["rigid"] = lambda: rigid(sequence.garment, first, part)[1:]
    return methods
