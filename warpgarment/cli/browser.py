"""A page in the browser: of motions (`view --browser`), and of what is simulated again (`simulate --browser`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.errors import UsageError
from warpgarment.io.files import read_mesh, whole_output
from warpgarment.io.source import holds
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.motion import GarmentMotion
from warpgarment.view.browser.page import Browser, browse
from warpgarment.view.browser.parts import BODY

from . import spoken
from .shot import checked, loaded, whole_body

if TYPE_CHECKING:
    from .simulate import Simulate
    from .view import View


def show(options: View) -> None:
    """Serves motions of files until the user stops it."""
    first, body = _results(options.motion, options)
    second, _ = _results(options.beside, options)
    if options.body is not None:
        with spoken(mesh="--body-mesh", fps="--body-fps"):
            body = BodyMotion.load(options.body, mesh=options.body_mesh, fps=options.body_fps, collider=False)
        if options.body_start is not None:
            body.start = options.body_start
    if not first:
        raise UsageError(f"{options.motion[0]} holds nothing but a body. Name the garments' motions too.")
    if len(options.rest) > len(first):
        raise UsageError(f"--rest: {len(options.rest)} meshes for {len(first)} garments.")
    rest = [np.asarray(read_mesh(path, expect_garment=False).vertices) for path in options.rest]
    try:
        page = browse(first, body, beside=second, rest=rest, host=options.host, port=options.port)
    except UsageError as error:
        raise UsageError(_as_options(error, "--fps, --start, --body-fps and --body-start")) from None
    _serve(page)


def _as_options(error: UsageError, times: str) -> str:
    text = str(error)
    return f"{text} Are {times} right?" if "no frame in common" in text else text


def _results(paths: Sequence[Path], options: View) -> tuple[list[GarmentMotion], BodyMotion | None]:
    """Garments of files, each mesh of a file with several; one called "body" is the body."""
    garments: list[GarmentMotion] = []
    body = None
    for path in paths:
        mesh = whole_output(path, options.mesh)
        names = holds(path).names if mesh is None and path.exists() else ()
        for name in names if len(names) > 1 else (mesh,):
            with spoken(mesh="--mesh", fps="--fps"):
                read = BodyMotion.load(path, mesh=name, fps=options.fps, collider=False)
            begins = read.start if options.start is None else options.start
            if name is not None and name.rsplit("/", 1)[-1] == BODY and len(names) > 1:
                body = read
                body.start = begins
                continue
            called = path.stem if len(names) < 2 else str(name).rsplit("/", 1)[-1]
            told: dict[str, Any] = {"name": called, "start": begins, "last": read.last}
            garments.append(GarmentMotion(read.vertices, read.faces, read.fps, **told))
    return garments, body


def rerun(options: Simulate) -> None:
    """Serves a simulation that is run again whenever the wind or a material is changed, until the user stops it."""
    if options.out is not None:
        raise UsageError("--browser shows what --out would write. Leave one of them out.")
    known = checked(replace(options, out_fps="network"), written=False)
    from warpgarment.sim.results.rerun import Rerun
    from warpgarment.sim.simulator import Simulator

    shot = loaded(known)
    simulator = Simulator.from_pretrained(options.weights, device=options.device)
    known.check_read(simulator.network.reads, options.weights)
    given: dict[str, Any] = {"first_vertices": shot.first, "layers": options.layers or None, "wind": shot.wind}
    given |= {"materials": known.materials or None, "frames": options.frames}
    live = Rerun(simulator, list(shot.garments.values()), shot.body, **given)
    if not live.reads:
        print(f"the network {options.weights!r} reads neither wind nor materials: there is nothing to change")
    body = None
    if options.files[-1].suffix.lower() == ".npz":  # which may hold parts that garments do not collide with
        body = whole_body(options).on_clock(live.body.clock)
    _serve(browse(live, body, host=options.host, port=options.port))


def _serve(page: Browser) -> None:
    print(f"open {page.url} (Ctrl+C ends)", flush=True)
    with page:
        try:
            page.wait()
        except KeyboardInterrupt:
            print("closed")
