"""Makes the bundled assets for demo and tests: a body, its walk, and two garments simulated on it.

    python -m warpgarment.training.generate.demo_assets OUT

All data come from this package's own code and Anny; no motion capture is used. OUT/rest_body.npz holds the body in its
rest pose, OUT/body.npz its motion (with hands and forearms marked as no collider), and OUT/<garment>.npz rest_vertices,
faces, pins and `truth`, the simulated vertices.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from warpgarment.bodies.anny import anny_bodies
from warpgarment.bodies.skeleton import arms_abducted, blended_in, facing_forward, posed
from warpgarment.training.garments.make import make_garment
from warpgarment.training.garments.pattern import Pattern
from warpgarment.training.motions.procedural import procedural
from warpgarment.training.teachers import Cloth, ClothScene
from warpgarment.training.teachers.newton.teacher import NewtonTeacher

from .quality import QualityGate

FPS, BLEND, FRAMES, SEED = 30.0, 20, 130, 2026
PHENOTYPE = {"gender": 0.9, "age": 0.68, "muscle": 0.5, "weight": 0.45, "height": 0.5, "proportions": 0.7}
PATTERNS = {
    "dress": Pattern("dress", sleeve=0.35, skirt_length=0.48, flare=0.2, ease=0.015, faces=1800),
    "tshirt": Pattern("tshirt", sleeve=0.6, hem=0.1, ease=0.016, faces=1300),
}


def make(out: Path, device: str = "cpu") -> None:
    """Writes the assets into a folder.

    Raises:
        RuntimeError: A garment did not pass the quality gate.
    """
    out.mkdir(parents=True, exist_ok=True)
    body = anny_bodies().rest(**PHENOTYPE)
    poses = arms_abducted(body, procedural(body, "walk", FRAMES, seed=SEED, fps=FPS), 15.0)
    poses = blended_in(body, facing_forward(poses), BLEND)
    frames, transforms = posed(body, poses)
    collider = body.collider_faces()
    body.save(out / "rest_body.npz")
    np.savez_compressed(
        out / "body.npz",
        rest_vertices=body.vertices.astype(np.float32),
        faces=body.faces,
        bone_indices=body.bone_indices,
        bone_weights=body.bone_weights,
        bone_transforms=transforms,
        collider_faces=collider,
        fps=FPS,
    )
    first = transforms[0, 0].astype(np.float64)
    for name, pattern in PATTERNS.items():
        garment, edge = make_garment(body, pattern)
        placed = (garment.vertices @ first[:, :3].T + first[:, 3]).astype(np.float32)
        gate = QualityGate((garment,), body.faces[collider])
        truth = []
        scene = ClothScene((Cloth(garment, edge, placed),), frames, body.faces[collider], fps=FPS)
        for frame, vertices in enumerate(NewtonTeacher(device=device).simulate(scene)):
            reason = gate.check(frame, vertices, frames[frame])
            if reason:
                raise RuntimeError(f"{name}: {reason}")
            truth.append(vertices)
        np.savez_compressed(
            out / f"{name}.npz",
            rest_vertices=garment.vertices,
            faces=garment.faces,
            pins=garment.pins,
            truth=np.stack(truth),
        )
        print(name, len(garment.faces), "faces", {k: round(v, 4) for k, v in gate.figures(len(truth)).items()})


if __name__ == "__main__":
    make(Path(sys.argv[1]))
