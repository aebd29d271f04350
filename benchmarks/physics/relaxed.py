"""A network with a few iterations of the cloth's own physics in each frame: error, folds, strain, and their cost.

    python -m benchmarks.physics.relaxed                    # `fast` on the bundled walk: three minutes
    python -m benchmarks.physics.relaxed --network layers

Bending energy and acceleration are shares of the recording's, strain is that of edges (`training.evaluate.shape`).
Times are processor times of a frame of the stage and of all stages. Results: benchmarks/results/relaxed_NETWORK.md.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np
import torch

from benchmarks.measure import RESULTS, machine
from warpgarment import demo
from warpgarment.io.disk.atomic import atomic_files
from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator
from warpgarment.training.evaluate.shape import Shape
from warpgarment.view.markdown import table

TRIED = ((0, 1.0), (4, 0.3), (8, 0.2), (8, 0.3), (8, 0.45), (8, 0.7))  # iterations and length [m]
HEADINGS = (
    "garment",
    "iterations",
    "length m",
    "error cm",
    "bending",
    "strain 1st %",
    "99th %",
    "acceleration",
    "ms",
    "of",
)


def main() -> None:
    """Simulates, measures and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--network", default="fast")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    bundle, rows = demo.assets(), []
    network = checkpoint.load(checkpoint.find(options.network))
    for name, item in bundle.garments.items():
        shape, recorded = Shape(item.garment), item.truth.vertices
        seen = {key: np.nanmean(values) for key, values in shape.looks(recorded).items()}
        rows.append([name, "recording", "", "", "1.00", *(f"{100 * seen[k]:.1f}" for k in ("strain_1", "strain_99"))])
        rows[-1] += ["1.00", "", ""]
        for iterations, length in TRIED:
            network.config = dataclasses.replace(network.config, physics=iterations, physics_length=length)
            simulator = Simulator(network, "cpu")
            moved = simulator.rollout(item.garment, bundle.body, first_vertices=recorded[0]).vertices[: len(recorded)]
            looks = {key: np.nanmean(values) for key, values in shape.looks(moved).items()}
            cells = [f"{shape.differences(moved, recorded)['distance'].mean():.2f}"]
            cells += [f"{looks['bending'] / seen['bending']:.2f}"]
            cells += [f"{100 * looks[key]:.1f}" for key in ("strain_1", "strain_99")]
            cells += [f"{looks['acceleration'] / seen['acceleration']:.2f}"]
            each = 1e3 / (len(moved) - 1)
            times = dict(simulator.timings)
            cells += [f"{each * times.get('physics', 0.0):.1f}", f"{each * sum(times.values()):.1f}"]
            rows.append([name, str(iterations), f"{length:g}" if iterations else "", *cells])
            print("  ".join(rows[-1]), flush=True)
    about = ", ".join(f"{k} {v}" for k, v in machine(torch.device("cpu")).items())
    lines = [
        "# Physics in the frame",
        "",
        about,
        "",
        f"`python -m benchmarks.physics.relaxed --network {options.network}`",
    ]
    lines += ["", *table(list(HEADINGS), rows, text=2)]
    path = options.out / f"relaxed_{options.network}.md"
    with atomic_files(path) as (written,):
        written.write_text("\n".join(lines) + "\n")
    print(f"written {path}")


if __name__ == "__main__":
    main()
