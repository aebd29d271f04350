"""`warpgarment info`: what a file holds, and how it would be read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from warpgarment.io.files import rate_of, read_motion
from warpgarment.io.source import holds, source_of
from warpgarment.objects.facts import Facts
from warpgarment.view.facts import facts_table

from . import spoken

MOST = 6  # objects that are shown side by side


@dataclass
class Info:
    """Options of `info`."""

    file: tyro.conf.Positional[Path]
    """Garment, body or motion: .obj, .ply, .off, .stl, .glb, .npz, .usd, .abc, .pc2, .mdd, .bvh, or a folder of
    .obj."""
    mesh: str | None = None
    """Name of the object, where the file holds several; by default each of them."""
    unit: str | None = None
    """Length unit of the file where it is not metres: m, dm, cm, mm or in."""
    up: Literal["y", "z"] | None = None
    """Axis that points up in the file; by default Y, or what the file says."""
    fps: float | None = None
    """Rate of the motion, where the file does not say (.pc2, folders of .obj) or says something else."""
    shape: str | None = None
    """The body that a .bvh or AMASS motion moves, as --shape of convert."""


def run(options: Info) -> None:
    """Reads each object and prints a table of them."""
    path = options.file
    names = holds(path).names if options.mesh is None and path.exists() else ()
    chosen: list[str | None] = list(names[:MOST]) if len(names) > 1 else [options.mesh]
    columns = {}
    with spoken(mesh="--mesh", unit="--unit", up="--up", fps="--fps", shape="--shape"):
        for name in chosen:
            told: dict[str, Any] = {"unit": options.unit, "up": options.up, "mesh": name}
            data = read_motion(path, **told, shape=options.shape)
            vertices, faces = np.asarray(data.vertices), np.asarray(data.faces)
            rate = rate_of(path, data, options.fps)
            source = source_of(path, **told, fps=options.fps, file_fps=data.fps, frames=len(vertices), data=data)
            columns[name or data.name or path.name] = Facts.measured(vertices, faces, rate, source)
    print(facts_table(columns))
    if len(names) > len(chosen):
        print(f"\n{len(names) - len(chosen):,} more objects: {', '.join(names[len(chosen) :])}")
