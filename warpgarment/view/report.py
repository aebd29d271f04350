"""Tables for the terminal: the outcome of rollouts, and the time spent in each stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from warpgarment.objects.motion import GarmentMotion
from warpgarment.objects.status import Verdict

STAGES = ("features", "network", "singular values", "poisson", "collision")


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table as plain text, with the first column aligned to the left and the others to the right."""
    cells = [[str(c) for c in row] for row in (header, *rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    lines = [
        "  ".join(c.rjust(w) if k else c.ljust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))).rstrip()
        for row in cells
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def rollout_table(
    motions: Mapping[str, GarmentMotion],
    timings: Mapping[str, Mapping[str, float]],
    errors: Mapping[str, float] | None = None,
) -> str:
    """A table with one column per garment: frames, milliseconds per frame in each stage, error, deepest penetration.

    Args:
        motions: Results of rollouts by name.
        timings: `Simulator.timings` after each rollout by name: time in each stage over all frames [s].
        errors: Mean vertex error against the ground truth by name [cm], for garments that have one.

    Returns:
        Text of several lines; the last ones name the remedy for every garment whose rollout failed.
    """
    names = list(motions)
    rows: list[list[object]] = [["faces", *(f"{len(motions[n].faces):,}" for n in names)]]
    rows.append(["frames", *(motions[n].frames for n in names)])
    steps = {n: max(1, motions[n].frames - 1) for n in names}
    stages = [s for s in STAGES if any(s in timings[n] for n in names)]
    stages += sorted({s for n in names for s in timings[n]} - set(stages))
    for stage in stages:
        rows.append([f"{stage} [ms/frame]", *(f"{1e3 * timings[n].get(stage, 0.0) / steps[n]:.1f}" for n in names)])
    rows.append(["together [ms/frame]", *(f"{1e3 * sum(timings[n].values()) / steps[n]:.1f}" for n in names)])
    if errors:
        rows.append(["mean vertex error [cm]", *(f"{errors[n]:.2f}" if n in errors else "-" for n in names)])
    rows.append(["deepest penetration [mm]", *(f"{1e3 * deepest(motions[n]):.1f}" for n in names)])
    text = table(["", *(n or "garment" for n in names)], rows)
    for name in names:
        bad = [s for s in motions[name].status if s.verdict is not Verdict.OK]
        if bad:
            text += (
                f"\n{name}: {len(bad)} of {motions[name].frames} frames are {bad[0].verdict.value}. {bad[0].message}"
            )
    return text


def deepest(motion: GarmentMotion) -> float:
    """Largest penetration over all frames [m]; 0 for a motion without status."""
    return float(np.max([s.max_penetration for s in motion.status], initial=0.0))
