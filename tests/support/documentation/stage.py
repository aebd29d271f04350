"""The files and names that pages of the documentation speak of, small: six frames of the bundled walk."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

import warpgarment as wg
from support import sequences
from support.bodies import write_bvh
from warpgarment.io.usd import write_usd

FRAMES = 6
SKELETON = [
    *(("Hips", None, (0, 0, 0)), ("Spine", "Hips", (0, 20, 0)), ("Head", "Spine", (0, 40, 0))),
    *(
        joint
        for side, x in (("Left", 1), ("Right", -1))
        for joint in (
            *((f"{side}UpLeg", "Hips", (9 * x, 0, 0)), (f"{side}Leg", f"{side}UpLeg", (0, -40, 0))),
            *((f"{side}Foot", f"{side}Leg", (0, -40, 0)), (f"{side}Arm", "Spine", (15 * x, 30, 0))),
            *((f"{side}ForeArm", f"{side}Arm", (28 * x, 0, 0)), (f"{side}Hand", f"{side}ForeArm", (28 * x, 0, 0))),
        )
    ),
]


@functools.cache
def assets() -> Any:
    """The bundled assets with six frames of motion."""
    full = wg.demo.assets.__wrapped__() if hasattr(wg.demo.assets, "__wrapped__") else wg.demo.assets()

    def cut(body: wg.BodyMotion) -> wg.BodyMotion:
        return wg.BodyMotion(body.vertices[:FRAMES], body.faces, body.fps, start=body.start)

    garments = {
        name: dataclasses.replace(
            item, truth=wg.GarmentMotion(item.truth.vertices[:FRAMES], item.garment.faces, item.truth.fps, name=name)
        )
        for name, item in full.garments.items()
    }
    return dataclasses.replace(full, body=cut(full.body), collider=cut(full.collider), garments=garments)


def write(folder: Path) -> None:
    """Writes the files: garments, bodies, motions, wind, a list of jobs, and a data set."""
    bundle = assets()
    dress, shirt = bundle.garments["dress"], bundle.garments["tshirt"]
    with np.load(wg.demo.ASSETS / "body.npz") as stored:
        rest = wg.BodyMotion(stored["rest_vertices"][None], bundle.body.faces)
    _obj(folder / "body_rest.obj", rest.vertices[0], rest.faces)
    _obj(folder / "dress.obj", 100.0 * dress.garment.vertices, dress.garment.faces)
    (folder / "worn").mkdir()
    for name, garment, first in zip(
        ("inner", "jacket"), bundle.outfit.outfit, bundle.outfit.first_vertices, strict=True
    ):
        _obj(folder / f"{name}.obj", first, garment.faces)
        wg.Garment(first, garment.faces, name=name).save(folder / "worn" / f"{name}.npz")
    bundle.body.save(folder / "walk.npz")
    bundle.body.save(folder / "dance.npz")
    worn = bundle.outfit.outfit.garments[0]
    wg.Garment(bundle.outfit.first_vertices[0], worn.faces, name="worn").save(folder / "worn.npz")
    bundle.body.save(folder / "walk.pc2")
    wg.GarmentMotion(dress.truth.vertices, dress.garment.faces, 30.0, name="draped").save(folder / "draped.pc2")
    _obj(folder / "draped.obj", dress.garment.vertices, dress.garment.faces)
    wg.GarmentMotion(shirt.truth.vertices, shirt.garment.faces, 30.0, name="jacket").save(folder / "jacket.npz")
    meshes = [
        ("dress", dress.truth.vertices, dress.garment.faces),
        ("jacket", shirt.truth.vertices, shirt.garment.faces),
    ]
    write_usd(folder / "own.usd", meshes[:1], 30.0)
    write_usd(folder / "scene.usd", [*meshes, ("body", bundle.body.vertices, bundle.body.faces)], 30.0)
    (folder / "gusts.csv").write_text("0, 0, -1\n0, 0, -3\n0, 0, -6\n")
    job = {"garment": "inner.obj", "body": "walk.npz", "out": "out/job.npz"}
    (folder / "jobs.jsonl").write_text(json.dumps(job) + "\n")
    write_bvh(folder / "walk.bvh", SKELETON, [[0.0, 80.0, float(t), *[0.0] * 45] for t in range(FRAMES)])
    for name in ("clips", "CLIPS"):  # of which names and number are looked at
        (folder / name).mkdir()
        (folder / name / "walk.bvh").touch()
    for number, split in enumerate(("train", "train", "validation", "test")):
        named = {"motion": f"sway {split}"}
        sequences.write(folder / "sequences", f"{split}_{number}", split, seed=number, frames=16, manifest=named)


def names(folder: Path) -> dict[str, Any]:
    """What blocks may use without having made it: garments that hang on the first frame, bodies, a simulator."""
    bundle = assets()
    inner, jacket = (
        wg.Garment(first, garment.faces, name=name)
        for name, garment, first in zip(
            ("shirt", "jacket"), bundle.outfit.outfit, bundle.outfit.first_vertices, strict=True
        )
    )
    walk = bundle.collider
    return {
        **{"wg": wg, "np": np, "garment": inner, "shirt": inner, "jacket": jacket, "body": walk, "walk": walk},
        **{"run": wg.BodyMotion(walk.vertices, walk.faces, 24.0), "vertices": _tensor(inner.vertices)},
        "poses": walk.vertices[1:],
    }


def _tensor(array: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(array)


def _obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n")
