"""`warpgarment demo`: the bundled garments on the bundled body."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from warpgarment import demo


@dataclass
class Demo:
    """Options of `demo`."""

    out: Path = Path("out/demo")
    """Folder for the USD, PC2, PNG and MP4 files."""
    device: str | None = None
    """cpu or cuda:0; by default a GPU where there is one."""
    weights: str = "default"
    """Network: a name that ships with the package, or a checkpoint file or folder."""
    frames: int | None = None
    """Only the first so many frames."""
    moments: int = 8
    """Columns of rollout.png."""
    film: bool = True
    """Draw demo.mp4."""
    assets: Path | None = None
    """Other assets of the same layout: body.npz, dress.npz, tshirt.npz."""


def run(options: Demo) -> None:
    """Runs the demo with a progress bar."""
    demo.run(
        options.out,
        device=options.device,
        weights=options.weights,
        frames=options.frames,
        moments=options.moments,
        film=options.film,
        folder=options.assets,
        progress=sys.stderr.isatty(),
    )
