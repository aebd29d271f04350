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

    Garments of an outfit have rows for triangles that cross and for vertices that were held back. Times of a rollout of
    several garments have a column of their own.

    Args:
        motions: Results of rollouts by name.
        timings: `Simulator.timings` after each rollout by the name of its garment, or of all its garments together:
            time in each stage over all frames [s].
        errors: Mean vertex error against the ground truth by name [cm], for garments that have one.

    Returns:
        Text of several lines; the last ones name the remedy for every garment whose rollout failed.
    """
    names = list(motions)
    together = [n for n in timings if n not in motions]
    columns, longest = [*names, *together], max(motion.frames for motion in motions.values())
    rows: list[list[object]] = [["faces", *(f"{len(motions[n].faces):,}" for n in names)]]
    rows.append(["frames", *(motions[n].frames for n in names)])
    steps = {n: max(1, (motions[n].frames if n in motions else longest) - 1) for n in columns}
    stages = [s for s in STAGES if any(s in timings[n] for n in timings)]
    stages += sorted({s for n in timings for s in timings[n]} - set(stages))

    def times(seconds: Mapping[str, float]) -> list[str]:
        return [f"{1e3 * seconds[n] / steps[n]:.1f}" if n in seconds else "" for n in columns]

    for stage in stages:
        rows.append([f"{stage} [ms/frame]", *times({n: timings[n].get(stage, 0.0) for n in timings})])
    rows.append(["together [ms/frame]", *times({n: sum(timings[n].values()) for n in timings})])
    if errors:
        rows.append(["mean vertex error [cm]", *(f"{errors[n]:.2f}" if n in errors else "-" for n in names)])
    rows.append(["deepest penetration [mm]", *(f"{1e3 * deepest(motions[n]):.1f}" for n in names)])
    rows += _meetings([motions[n] for n in names])
    rows = [[*row, *[""] * (1 + len(columns) - len(row))] for row in rows]
    text = table(["", *(n or "garment" for n in columns)], rows)
    for name in names:
        bad = [s for s in motions[name].status if s.verdict is not Verdict.OK]
        if bad:
            text += (
                f"\n{name}: {len(bad)} of {motions[name].frames} frames are {bad[0].verdict.value}. {bad[0].message}"
            )
    return text


def _meetings(motions: Sequence[GarmentMotion]) -> list[list[object]]:
    """Rows of cloth that meets cloth, if any garment is of an outfit."""
    worn = [[(s.layer_crossings, s.self_crossings) for s in motion.status] for motion in motions]
    lags = [[s.lag for s in motion.status if s.lag is not None] for motion in motions]
    if not any(pair != (None, None) for pairs in worn for pair in pairs) and not any(lags):
        return []

    def most(pairs: list[tuple[int | None, int | None]], which: int) -> str:
        found = [pair[which] for pair in pairs]
        known = [count for count in found if count is not None]
        return f"{max(known):,}{' or more' if None in found else ''}" if known else "not counted"

    return [
        ["crossing pairs with other garments, most", *(most(pairs, 0) for pairs in worn)],
        ["crossing pairs with itself, most", *(most(pairs, 1) for pairs in worn)],
        ["lag, most [mm]", *(f"{1e3 * max(lag):.1f}" if lag else "-" for lag in lags)],
    ]


def certified(motion: GarmentMotion) -> str:
    """What keeps a garment of an outfit from being free of crossings in every frame; empty where it is.

    A motion of a garment that is in no outfit was not looked at, and is not free.
    """
    crossing = [s.frame for s in motion.status if s.layer_crossings or s.self_crossings]
    uncounted = [s.frame for s in motion.status if s.layer_crossings is None or s.self_crossings is None]
    failed = [s.frame for s in motion.status if not s.finite]
    if not motion.status:
        return "not counted"
    if failed:
        return f"not finite from frame {failed[0]} on"
    if crossing:
        pairs = max((s.layer_crossings or 0) + (s.self_crossings or 0) for s in motion.status)
        return f"crosses in {_frames(crossing, motion)}, {pairs:,} pairs at most"
    return f"not counted in {_frames(uncounted, motion)}" if uncounted else ""


def _frames(found: Sequence[int], motion: GarmentMotion) -> str:
    return f"{len(found):,} of {motion.frames:,} frames (first: frame {found[0]})"


def deepest(motion: GarmentMotion) -> float:
    """Largest penetration over all frames [m]; 0 for a motion without status."""
    return float(np.max([s.max_penetration for s in motion.status], initial=0.0))
