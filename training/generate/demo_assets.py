"""Makes the bundled assets for demo and tests: a body, its walk, and two garments simulated on it.

    python -m warpgarment.training.generate.demo_assets OUT
    python -m warpgarment.training.generate.demo_assets OUT KEPT    # with the garments and the body in the folder KEPT

The second form simulates the meshes that ship again: a newer cutter or remesher makes others of the same patterns.
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
from warpgarment.geometry.skinning import linear_blend_skinning
from warpgarment.objects.garment import Garment
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


def make(out: Path, kept: Path | None = None, device: str = "cpu") -> None:
    """Writes the assets into a folder.

    Args:
        out: The folder.
        kept: Folder of such assets, whose body, motion and garments are simulated again; None makes new ones.
        device: Warp device of the teacher.

    Raises:
        RuntimeError: A garment did not pass the quality gate.
    """
    out.mkdir(parents=True, exist_ok=True)
    if kept is not None:
        with np.load(kept / "body.npz") as held:
            skin = {name: held[name] for name in ("rest_vertices", "bone_indices", "bone_weights", "bone_transforms")}
            faces = held["faces"][held["collider_faces"]]
        frames = linear_blend_skinning(*skin.values())
        for name in PATTERNS:
            with np.load(kept / f"{name}.npz") as held:
                garment = Garment(held["rest_vertices"], held["faces"], pins=held["pins"], name=name)
            corners = garment.vertices[garment.faces].astype(np.float64)
            across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            area = 0.5 * np.linalg.norm(across, axis=1).mean()
            edge = float(np.sqrt(4.0 / np.sqrt(3.0) * area))
            _simulate(out, name, garment, edge, skin["bone_transforms"][0, 0], frames, faces, device)
        return
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
    for name, pattern in PATTERNS.items():
        garment, edge = make_garment(body, pattern)
        _simulate(out, name, garment, edge, transforms[0, 0], frames, body.faces[collider], device)


def _simulate(
    out: Path,
    name: str,
    garment: Garment,
    edge: float,
    first: np.ndarray,
    frames: np.ndarray,
    faces: np.ndarray,
    device: str,
) -> None:
    """Writes one garment and its simulation; `first` [3,4] is the rigid motion from the rest pose to frame 0."""
    first = first.astype(np.float64)
    placed = (garment.vertices @ first[:, :3].T + first[:, 3]).astype(np.float32)
    gate = QualityGate((garment,), faces)
    truth = []
    scene = ClothScene((Cloth(garment, edge, placed),), frames, faces, fps=FPS)
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
    make(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
