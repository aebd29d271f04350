"""One dress in three fabrics and three winds, by a network and beside it by the teacher.

    python -m warpgarment.training.tables.outdoor.picture --network NETWORK --out DIR
    python -m warpgarment.training.tables.outdoor.picture --network NETWORK --out DIR --teacher blender

Only the second command has the teacher's rows. The bundled dress on the bundled walking body, from the same positions.
DIR gets `fabrics_and_winds.png` with a row for each fabric and a column for each wind at the last frame, and
`fabrics_and_winds.json` with the mean shift of the cloth against still air in the last half of the frames [cm]. The
teacher's frames are kept in DIR/teacher, and used again as long as the scene and the teacher's settings stay the same.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment import demo
from warpgarment.io.npz import write_npz
from warpgarment.nn import checkpoint
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.material import Material
from warpgarment.objects.motion import GarmentMotion
from warpgarment.sim.simulator import Simulator
from warpgarment.training.teachers import TEACHERS, Cloth, ClothScene, make_teacher
from warpgarment.view import draw

FABRICS = {  # within the ranges of the layered sets (training/materials.py)
    "light and soft": Material(density=0.2, stretch=300.0, shear=300.0, bend=1e-3, friction=0.2),
    "cotton-like": Material(density=0.4, stretch=700.0, shear=700.0, bend=0.03, friction=0.4),
    "heavy and stiff": Material(density=0.75, stretch=1200.0, shear=1200.0, bend=0.6, friction=0.6),
}
WINDS = {  # velocities of the air [m/s]; the body walks along +Z
    "still air": (0.0, 0.0, 0.0),
    "4 m/s from its right": (4.0, 0.0, 0.0),
    "7 m/s from the front": (0.0, 0.0, -7.0),
}
SIZE = (260, 360)  # pixels of a panel

Key = tuple[str, str]  # fabric, wind


def by_network(place: str, frames: int) -> dict[Key, np.ndarray]:
    """Frames [m], float32 [T,V,3], of every fabric in every wind, one batch."""
    simulator = Simulator(checkpoint.load(checkpoint.find(place, device="cpu")), "cpu")
    bundle = demo.assets()
    item, keys = bundle.garments["dress"], [(fabric, wind) for fabric in FABRICS for wind in WINDS]
    air = np.array([WINDS[wind] for _, wind in keys], np.float32)
    motions = simulator.rollout(
        [item.garment] * len(keys),
        bundle.collider,
        first_vertices=[item.first_vertices] * len(keys),
        frames=frames,
        materials=[FABRICS[fabric] for fabric, _ in keys],
        wind=np.broadcast_to(air, (frames, *air.shape)),
    )
    return {key: np.asarray(motion.vertices) for key, motion in zip(keys, motions, strict=True)}


def by_teacher(name: str, frames: int, kept: Path) -> dict[Key, np.ndarray]:
    """The same by a teacher, from files in the folder `kept` where they are of the same scene and settings."""
    bundle, teacher, found = demo.assets(), make_teacher(name, device="cpu"), {}
    item = bundle.garments["dress"]
    edges = item.garment.vertices[item.garment.edges]
    edge = float(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1).mean())
    for fabric, material in FABRICS.items():
        for wind, velocity in WINDS.items():
            about = json.dumps([teacher.settings(), material.as_dict(), velocity, frames], sort_keys=True)
            place = kept / f"{hashlib.sha256(about.encode()).hexdigest()[:16]}.npz"
            if not place.exists():
                cloth = Cloth(item.garment, edge, np.asarray(item.first_vertices, np.float32), material)
                body, air = bundle.collider, np.tile(np.array(velocity, np.float32), (frames, 1))
                scene = ClothScene((cloth,), body.vertices[:frames], body.faces, fps=body.fps, wind=air)
                simulated = np.stack(list(teacher.simulate(scene)))
                kept.mkdir(parents=True, exist_ok=True)
                write_npz(place, {"vertices": simulated})
                print(f"{name}: {fabric}, {wind}", flush=True)
            with np.load(place, allow_pickle=False) as stored:
                found[fabric, wind] = stored["vertices"]
    return found


def figures(found: dict[Key, np.ndarray]) -> list[dict[str, Any]]:
    """Mean shift of the cloth against the same fabric in still air, over the last half of the frames [cm]."""
    calm, rows = next(iter(WINDS)), []
    for (fabric, wind), vertices in found.items():
        half = len(vertices) // 2
        shift = 100.0 * (vertices[half:] - found[fabric, calm][half:]).mean(axis=(0, 1), dtype=np.float64)
        rows.append({"fabric": fabric, "wind": wind, "shift_cm": shift.tolist()})
    return rows


def picture(path: Path, by: dict[str, dict[Key, np.ndarray]]) -> None:
    """Draws the last frame: rows of fabrics, each by every method, and columns of winds."""
    bundle = demo.assets()
    faces = bundle.garments["dress"].garment.faces
    frames = len(next(iter(next(iter(by.values())).values())))
    body = BodyMotion(bundle.body.vertices[:frames], bundle.body.faces, bundle.body.fps)
    drawn = {(name, *key): GarmentMotion(v, faces, body.fps) for name, found in by.items() for key, v in found.items()}
    camera, strips = draw.chase([body, *drawn.values()], size=SIZE), []
    for fabric in FABRICS:
        for name, color in zip(by, (draw.CORAL, draw.SLATE), strict=False):
            panels = []
            for wind in WINDS:
                worn = drawn[name, fabric, wind]
                (panel,) = draw.film(body, [worn], size=SIZE, colors=[color], frames=[frames - 1], camera=camera)
                panels.append(draw.caption(panel, wind))
            strips.append(draw.titled(np.concatenate(panels, axis=1), f"{fabric}, {name}"))
    draw.write_png(path, np.concatenate(strips, axis=0))


def main(arguments: list[str] | None = None) -> None:
    """Simulates, measures and draws; the arguments are those of the command line, None for the real ones."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--network", required=True)
    parser.add_argument("--teacher", choices=TEACHERS, default=None)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    by = {"network": by_network(options.network, options.frames)}
    if options.teacher:
        by[options.teacher] = by_teacher(options.teacher, options.frames, options.out / "teacher")
    result: dict[str, Any] = {"frames": options.frames, "network": Path(options.network).name}
    result["materials"] = {name: material.as_dict() for name, material in FABRICS.items()}
    result["winds"] = WINDS
    result["shift"] = {name: figures(found) for name, found in by.items()}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "fabrics_and_winds.json").write_text(json.dumps(result, indent=1))
    picture(options.out / "fabrics_and_winds.png", by)
    print(f"written {options.out / 'fabrics_and_winds.png'}")


if __name__ == "__main__":
    main()
