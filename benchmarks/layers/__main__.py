"""Contact of cloth with cloth on recorded outfits: what crosses with and without it, its cost, and what it gives up.

    python -m benchmarks.layers --data layers                            # test and validation sequences
    python -m benchmarks.layers --data layers --splits train --every 1   # every frame is counted

Every outfit of several garments is rolled out with the network `fast` from its first recorded frame, without and with
`layers=True` ("off" and "on"); then each of its garments alone, off and on. Crossing pairs of triangles, and
vertices beneath another garment (L surface), are counted in float64 without the kernels that are judged
(`training.tables.outfits`), in every third frame but the first. Lag and depth in the body are those of the status.
Certified are frames in which every pair was looked at and none crosses, by the status. Times are processor times of a
frame, without the time before the first frame; cost is what layers add, as a share of a frame without.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import warpgarment as wg
from warpgarment.geometry.orientation import turned_outward
from warpgarment.training.data.sequence import Sequence as Recorded
from warpgarment.training.data.sequence import list_sequences
from warpgarment.training.tables.outfits.crossings import crossing_pairs
from warpgarment.training.tables.outfits.figures import OF_FRAMES, Outfit, frame_figures
from warpgarment.view.markdown import code, table

FEW = 2  # frames of a rollout whose time is that before the first frame, nearly
HEADINGS = (
    "sequence", "split", "faces", "frames", "start crosses", "pairs off", "pairs on", "free on", "certified",
    "L surface off", "L surface on", "lag mean mm", "lag most mm", "depth off mm", "depth on mm", "deepest on mm",
    "alone off", "alone on", "ms off", "ms on", "cost",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a Markdown table with a row for each sequence."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of sequences")
    parser.add_argument("--splits", nargs="+", default=["test", "validation"])
    parser.add_argument("--network", default="fast", help="one that ships, or a file")
    parser.add_argument("--frames", type=int, help="most frames of a rollout")
    parser.add_argument("--every", type=int, default=3, help="count in every so manieth frame")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    simulator = wg.Simulator.from_pretrained(options.network, device="cpu")
    folders = [folder for split in options.splits for folder in list_sequences(options.data, split)]
    rows = []
    for folder in sorted(folders):
        sequence = Recorded.load(folder)
        if len(sequence.layers) > 1:
            rows.append(measured(simulator, sequence, options.frames, options.every))
            print(f"{folder.name}: done", flush=True)
    print(code(f"python -m benchmarks.layers --data {options.data.name} --splits {' '.join(options.splits)}"), "\n")
    print("\n".join(table(HEADINGS, rows, text=2)))


def measured(simulator: wg.Simulator, sequence: Recorded, frames: int | None, every: int) -> list[str]:
    """The row of a sequence."""
    body = sequence.body()
    outfit, garments = Outfit.of(sequence, body), list(sequence.worn)
    first = [np.array(sequence.vertices[0, part], np.float32) for part in outfit.parts]
    faces = turned_outward(np.asarray(body.vertices[0]), np.asarray(body.faces), "the body")
    rolled, figures, seconds, before = {}, {}, {}, {}
    for on in (False, True):
        before[on] = timed(simulator, garments, body, first, FEW, on)[1]
        rolled[on], seconds[on] = timed(simulator, garments, body, first, frames, on)
        moved = np.concatenate([motion.vertices for motion in rolled[on]], axis=1)
        found = [
            frame_figures(outfit, moved[t], np.asarray(body.vertices[t]), faces) for t in range(0, len(moved), every)
        ]
        figures[on] = dict(zip(OF_FRAMES, np.mean(found[1:], axis=0), strict=True))
        start = int(found[0][OF_FRAMES.index("crossings_layers")] + found[0][OF_FRAMES.index("crossings_itself")])
    count = len(rolled[True][0].vertices)
    certified = [all(statuses_free(m.status[t]) for m in rolled[True]) for t in range(1, count)]
    lag = [max(m.status[t].lag for m in rolled[True]) for t in range(1, count)]
    depth = {on: [max(m.status[t].max_penetration for m in rolled[on]) for t in range(count)] for on in rolled}
    alone = {on: 0.0 for on in (False, True)}
    for on in alone:
        for k, garment in enumerate(garments):
            motion = timed(simulator, [garment], body, first[k : k + 1], frames, on)[0][0]
            same = outfit.same[outfit.parts[k]]
            sampled = [len(crossing_pairs(v, garment.faces, same)) for v in motion.vertices[1::every]]
            alone[on] += float(np.mean(sampled))
    pairs = {on: figures[on]["crossings_layers"] + figures[on]["crossings_itself"] for on in figures}
    per_frame = {on: 1e3 * (seconds[on] - before[on]) / (count - FEW) for on in seconds}
    return [
        sequence.name, str(sequence.manifest.get("split")), "+".join(f"{len(g.faces):,}" for g in garments), str(count),
        str(start), f"{pairs[False]:.1f}", f"{pairs[True]:.2f}", f"{figures[True]['free']:.0%}",
        f"{np.mean(certified):.0%}", f"{figures[False]['l_surface']:.2%}", f"{figures[True]['l_surface']:.2%}",
        f"{1e3 * np.mean(lag):.2f}", f"{1e3 * max(lag):.1f}", f"{1e3 * np.mean(depth[False]):.2f}",
        f"{1e3 * np.mean(depth[True]):.2f}", f"{1e3 * max(depth[True][1:]):.1f}", f"{alone[False]:.2f}",
        f"{alone[True]:.2f}", f"{per_frame[False]:.0f}", f"{per_frame[True]:.0f}",
        f"{per_frame[True] / per_frame[False] - 1:.2f}",
    ]  # fmt: skip


def statuses_free(status: wg.RolloutStatus) -> bool:
    """Whether a status says that every pair was looked at, and none crosses."""
    return status.layer_crossings == 0 and status.self_crossings == 0


def timed(
    simulator: wg.Simulator,
    garments: list[wg.Garment],
    body: wg.BodyMotion,
    first: list[np.ndarray],
    frames: int | None,
    on: bool,
) -> tuple[list[wg.GarmentMotion], float]:
    """The motions of garments, and the processor time of the rollout [s]."""
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # starts that cross are a column
        motions = simulator.rollout(garments, body, first_vertices=first, frames=frames, layers=on or None)
    return motions, time.process_time() - began


if __name__ == "__main__":
    main()
