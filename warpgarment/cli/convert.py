"""`warpgarment convert`: a motion from one file format to another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from warpgarment.errors import UsageError
from warpgarment.io.data import MeshData
from warpgarment.io.files import has_bones, suffixes, write_mesh
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.clock import in_words

from . import spoken
from .outputs import Output, check_output


@dataclass
class Convert:
    """Options of `convert`."""

    input: tyro.conf.Positional[Path]
    """Motion to read: .npz, .usd, .abc, .glb, .pc2 or .mdd (with its .obj beside it), .bvh, or a folder of .obj."""
    output: tyro.conf.Positional[Output]
    """Motion to write: .npz, .usd (.usda, .usdc), .abc, .glb, .pc2, .mdd, or a folder of .obj. Polygons, UVs, materials
    and groups stay, as far as the format has them."""
    fps: float | None = None
    """Resample to this rate; by default the rate stays. The motion begins and ends when it did."""
    input_fps: float | None = None
    """Rate of the input, where its file does not say (.pc2, folders of .obj) or says something else."""
    unit: str | None = None
    """Length unit of the input where it is not metres: m, dm, cm, mm or in."""
    up: Literal["y", "z"] | None = None
    """Axis that points up in the input; by default Y, or what its file says."""
    mesh: str | None = None
    """Name of the mesh to read where the input holds several."""
    shape: str | None = None
    """The body that a .bvh or AMASS motion moves: bundled (the default), anny, anny with values from 0 to 1
    (anny,height=0.7,weight=0.3), or an .npz of SMPL, SMPL-H or SMPL-X."""
    rest: bool = False
    """Write this body at rest, to model garments on and for --fit-rest; OUTPUT is a mesh then: .obj, .ply, .usd, ..."""


def run(options: Convert) -> None:
    """Reads, resamples if asked, writes."""
    check_output(options.output, suffixes("write_mesh" if options.rest else "write_motion"), (options.input,))
    if options.rest and options.input.exists() and not has_bones(options.input):
        raise UsageError(f"--rest: {options.input} has a body of its own. It is for .bvh and AMASS motions.")
    with spoken(mesh="--mesh", unit="--unit", fps="--input-fps", up="--up", shape="--shape"):
        motion = BodyMotion.load(
            options.input,
            unit=options.unit,
            fps=options.input_fps,
            up=options.up,
            mesh=options.mesh,
            collider=False,
            shape=options.shape,
            rest=options.rest,
        )
    if options.rest:
        write_mesh(options.output, MeshData(motion.vertices[0], motion.faces, name="body"))
        print(f"{options.output}: the body at rest, {motion.vertices.shape[1]} vertices")
        return
    if options.fps is not None:
        motion = motion.resampled(options.fps)
    with spoken(fps="--fps", output="OUTPUT"):
        motion.save(options.output)
    print(f"{options.output}: {in_words(motion.clock)}, {motion.vertices.shape[1]} vertices")
