"""The pictures of a network's page: curves of its training, and rollouts above the teacher's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.errors import MissingExtra
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.motion import GarmentMotion
from warpgarment.training.data.sequence import Sequence as SequenceOnDisk
from warpgarment.view import draw

if TYPE_CHECKING:
    from .model_card_cases import Drawn

LARGEST = 400_000  # largest file of a picture [bytes]


def rollout_sheet(
    path: Path,
    sequence: SequenceOnDisk,
    moved: np.ndarray,
    truth: np.ndarray,
    drawn: Drawn,
    *,
    size: tuple[int, int],
) -> None:
    """Draws the network's rollout above the teacher's, at some frames; pictures shrink if the file would be too large.

    Args:
        path: PNG file to write.
        sequence: Sequence with its body.
        moved: Positions by the network [m], [T,V,3], NaN where it failed.
        truth: Positions by the teacher [m], [T,V,3].
        drawn: Frames to draw, and errors to write beside them.
        size: Width and height of a picture in pixels.
    """
    body = sequence.body_in(slice(0, len(truth)))
    while True:
        draw.write_png(path, _sheet(body, sequence, moved, truth, drawn, size), colors=256)
        if path.stat().st_size <= LARGEST:
            return
        size = (int(0.85 * size[0]), int(0.85 * size[1]))


def _sheet(
    body: BodyMotion,
    sequence: SequenceOnDisk,
    moved: np.ndarray,
    truth: np.ndarray,
    drawn: Drawn,
    size: tuple[int, int],
) -> np.ndarray:
    faces, fps = sequence.garment.faces, sequence.fps
    network, teacher = (GarmentMotion(vertices, faces, fps) for vertices in (moved, truth))
    camera = draw.chase([body, teacher], size=size)  # without the network, whose garment may have moved away
    strips = []
    for motion, color, caption in ((network, draw.CORAL, "{e:.1f} cm"), (teacher, draw.SLATE, "{s:.1f} s")):
        panels = draw.film(body, [motion], size=size, colors=[color], frames=drawn.moments, camera=camera)
        values = [(t, drawn.errors[t - 1] if t else 0.0, t / fps) for t in drawn.moments]
        strip = [
            draw.caption(p, f"frame {t}, {caption.format(e=e, s=s)}")
            for p, (t, e, s) in zip(panels, values, strict=True)
        ]
        strips.append(np.concatenate(strip, axis=1))
    row = drawn.case.row
    error = "failed" if np.isnan(drawn.error) else f"{drawn.error:.2f} cm"
    figures = f"network {error} (above), skinned {row['skinned']['mean_vertex_error_cm']:.2f} cm"
    title = draw.titled(np.concatenate(strips), f"{figures}, ratio {drawn.case.ratio:.2f}; teacher below", size=13)
    return draw.titled(title, f"{drawn.case.role}: {row['sequence']}, {row.get('motion') or 'motion not named'}")


def curves(path: Path, lines: Sequence[Mapping[str, Any]]) -> bool:
    """Draws the training loss and the validation error over the steps.

    Args:
        path: PNG file to write.
        lines: Lines of a training log by step.

    Returns:
        Whether there was anything to draw.
    """
    wanted = {"loss": "training loss", "rollout_error_cm": "validation: error of rollouts [cm]"}
    points = {key: [(line["step"], line[key]) for line in lines if _is_number(line.get(key))] for key in wanted}
    points = {key: series for key, series in points.items() if series}
    if not points:
        return False
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("view", "Drawing the curves of a training") from error
    figure = Figure(figsize=(4.2 * len(points), 2.8), layout="constrained")
    for axis, (key, series) in zip(np.atleast_1d(figure.subplots(1, len(points))), points.items(), strict=True):
        steps, values = np.array(series, float).T
        axis.plot(steps, values, color=draw.TEAL, linewidth=1.0, marker="." if len(series) < 60 else None)
        axis.set_title(wanted[key], fontsize=9)
        axis.set_xlabel("step", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
        if key == "loss" and values.max() > 10 * values.min() > 0:
            axis.set_yscale("log")
    with atomic_file(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")
    return True


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))
