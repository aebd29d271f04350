"""Makes the bundled outfit of the demo: two garments over each other, each of its own material, in gusty wind.

    python -m warpgarment.training.generate.demo_outfit OUT

Garments, materials and wind are those of a sequence of the test split of the recipe `layers`, cut for the bundled body
in place of the sequence's own; no motion capture is used and nothing is simulated. OUT/outfit.npz holds `names`,
innermost first, of garment k the arrays rest_vertices_k, faces_k, pins_k, first_vertices_k (on the first frame of the
bundled walk) and material_k (the fields of `Material`), and `wind`, the velocity of the air in each frame [m/s].
"""

from __future__ import annotations

import sys
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.bodies.rest import bundled_body
from warpgarment.demo import ASSETS
from warpgarment.io.npz import read_npz
from warpgarment.training.garments.outfits import make_outfit

from .recipes import GenerateConfig, plan_sequence

NUMBER, FACES = 83, 500


def make(out: Path) -> None:
    """Writes outfit.npz into a folder.

    Raises:
        OutfitError: The garments cross at the start.
        RuntimeError: The sequence is not of the test split, or there is no wind in it.
    """
    out.mkdir(parents=True, exist_ok=True)
    plan = plan_sequence(GenerateConfig(out, recipe="layers", faces=FACES), NUMBER)
    if plan.split != "test" or plan.wind is None:
        raise RuntimeError(f"sequence {NUMBER} is of the split {plan.split}, with wind {plan.wind}; choose another")
    walk = read_npz(ASSETS / "body.npz", ("bone_transforms", "fps"))
    transforms = walk["bone_transforms"]
    first = transforms[0, 0].astype(np.float64)
    arrays: dict[str, Any] = {
        "names": np.array([pattern.category for pattern in plan.outfit.layers]),
        "wind": plan.wind.velocities(len(transforms), float(walk["fps"])),
    }
    for k, (garment, _) in enumerate(make_outfit(bundled_body(), plan.outfit)):
        arrays[f"rest_vertices_{k}"] = garment.vertices
        arrays[f"faces_{k}"] = garment.faces
        arrays[f"pins_{k}"] = garment.pins
        arrays[f"first_vertices_{k}"] = (garment.vertices @ first[:, :3].T + first[:, 3]).astype(np.float32)
        arrays[f"material_{k}"] = np.array(astuple(plan.materials[k]))
        print(garment.name, len(garment.faces), "faces", plan.materials[k])
    np.savez_compressed(out / "outfit.npz", **arrays)


if __name__ == "__main__":
    make(Path(sys.argv[1]))
