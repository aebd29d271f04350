"""Tiny sequences in the format on disk: a tube of cloth that sways behind a swaying capsule, without physics or
downloads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from warpgarment.objects.material import Material
from warpgarment.training.data.sequence import write_sequence


def tube(around: int, rings: int, radius: float, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """An open tube about the y axis with normals outward: vertices [m], [V,3], and faces, [F,3]."""
    angle = np.arange(around) * 2 * np.pi / around
    height = np.repeat(np.linspace(low, high, rings), around)
    circle = np.tile(np.stack([np.cos(angle), np.sin(angle)], 1), (rings, 1)) * radius
    faces = []
    for ring in range(rings - 1):
        for i in range(around):
            p, q = ring * around + i, ring * around + (i + 1) % around
            faces += [[p, p + around, q], [q, p + around, q + around]]
    return np.stack([circle[:, 0], height, circle[:, 1]], 1), np.array(faces)


def turn_about_up(angle: np.ndarray) -> np.ndarray:
    """Rotations about +Y by angles [rad], [...,3,3]."""
    cos, sin, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], -1).reshape(*angle.shape, 3, 3)


def arrays(frames: int = 40, seed: int = 0, around: int = 12, rings: int = 6, pins: int = 0) -> dict[str, np.ndarray]:
    """Arrays of a sequence by name. The body has two bones, feet and head; the cloth lags 2 frames behind the head."""
    rng = np.random.default_rng(seed)
    body = trimesh.creation.capsule(height=1.2, radius=0.15, count=[12, 12])
    rest = np.asarray(body.vertices)[:, [1, 2, 0]]  # a cyclic exchange of axes does not turn the outside in
    rest = rest + [0.0, 0.15 - rest[:, 1].min(), 0.0]  # from 0.15 m to 1.65 m
    share = np.clip((rest[:, 1] - 0.3) / 1.2, 0.0, 1.0)
    time = np.arange(-2, frames) / 30.0
    phase = rng.uniform(0, 2 * np.pi)
    pace, swing = 0.4 + 0.2 * rng.random(), 0.4 + 0.4 * rng.random()
    transforms = np.zeros((len(time), 2, 3, 4))
    for bone, amplitude in enumerate((0.1, swing)):
        transforms[:, bone, :, :3] = turn_about_up(amplitude * np.sin(3.0 * time + phase))
        transforms[:, bone, 0, 3] = pace * time
        transforms[:, bone, 2, 3] = 0.05 * bone * np.sin(4.0 * time + phase)
    cloth, faces = tube(around, rings, 0.18 + 0.01 * rng.random(), 0.8, 1.3)
    moved = np.einsum("tij,vj->tvi", transforms[:, 1, :, :3], cloth) + transforms[:, 1, None, :, 3]
    lag = moved[:-2] * ((1.3 - cloth[:, 1:2]) * 0.4) + moved[2:] * (1 - (1.3 - cloth[:, 1:2]) * 0.4)
    collider = np.ones(len(body.faces), bool)
    collider[:3] = False
    return {
        "garment_rest_vertices": cloth.astype(np.float32),
        "garment_faces": faces.astype(np.int32),
        "pins": np.arange((rings - 1) * around, (rings - 1) * around + pins).astype(np.int32),
        "garment_vertices": lag.astype(np.float32),
        "body_rest_vertices": rest.astype(np.float32),
        "body_faces": np.asarray(body.faces).astype(np.int32),
        "collider_faces": collider,
        "bone_indices": np.tile(np.array([[0, 1]], np.uint8), (len(rest), 1)),
        "bone_weights": np.stack([1 - share, share], 1).astype(np.float32),
        "bone_transforms": transforms[2:].astype(np.float32),
    }


def write(root: Path, name: str, split: str = "train", *, spoil=None, manifest=None, **settings) -> Path:
    """Writes one sequence and returns its folder; `spoil` may change the arrays first, `manifest` adds entries."""
    content = arrays(**settings)
    if spoil is not None:
        spoil(content)
    entries = {
        "status": "good", "reason": "", "split": split, "motion": "sway", "garment": "tube", "category": "tube",
        "body": "capsule", "seed": settings.get("seed", 0), "fps": 30.0, "frames": len(content["garment_vertices"]),
        "figures": {}, "versions": {},
    }  # fmt: skip
    folder = Path(root) / name
    write_sequence(folder, content, entries | (manifest or {}))
    return folder


def two_layers(content: dict) -> None:
    """Makes an outfit of the tube and a wider one over it, in a wind."""
    count = len(content["garment_rest_vertices"])
    for name in ("garment_rest_vertices", "garment_vertices"):
        inner = content[name]
        middle = inner.mean(axis=-2, keepdims=True)
        content[name] = np.concatenate([inner, middle + (inner - middle) * [1.2, 0.9, 1.2]], axis=-2).astype(np.float32)
    faces = content["garment_faces"]
    content["garment_faces"] = np.concatenate([faces, faces + count]).astype(np.int32)
    content["garment_starts"] = np.array([0, count, 2 * count], np.int32)
    frames = len(content["garment_vertices"])
    content["wind"] = np.stack([np.linspace(0, 2, frames), np.zeros(frames), np.ones(frames)], 1).astype(np.float32)


def write_set(root: Path, train: int = 3, validation: int = 1, test: int = 1, **settings) -> Path:
    """Writes a data set of tubes with different seeds."""
    names = [("train", i) for i in range(train)] + [("validation", i) for i in range(validation)]
    for number, (split, i) in enumerate(names + [("test", i) for i in range(test)]):
        write(root, f"{split}_{i}", split, seed=number, **settings)
    return Path(root)


def widened(wide: float = 1.15, wind: float = 2.0):
    """A change of a sequence's arrays: a tube `wide` times as wide over the first, in a wind of about `wind` [m/s]."""

    def change(content: dict) -> None:
        count = len(content["garment_rest_vertices"])
        for name in ("garment_rest_vertices", "garment_vertices"):
            inner = content[name]
            middle = inner.mean(axis=-2, keepdims=True)
            outer = middle + (inner - middle) * np.float32([wide, 0.9, wide])
            content[name] = np.concatenate([inner, outer], axis=-2).astype(np.float32)
        faces = content["garment_faces"]
        content["garment_faces"] = np.concatenate([faces, faces + count]).astype(np.int32)
        content["garment_starts"] = np.array([0, count, 2 * count], np.int32)
        if wind:
            frames = len(content["garment_vertices"])
            content["wind"] = np.tile(np.float32([wind, 0.0, 0.1]), (frames, 1))

    return change


def write_worn(
    root: Path, name: str, split: str = "test", *, wide: float = 1.15, wind: float = 2.0, **settings
) -> Path:
    """Writes a sequence of an inner dress and an outer jacket, by name; returns its folder."""
    garments = [
        {"name": "inner", "category": "dress", "material": Material(density=0.4).as_dict()},
        {"name": "outer", "category": "jacket", "material": Material(density=0.2).as_dict()},
    ]
    return write(root, name, split, spoil=widened(wide, wind), manifest={"garments": garments}, **settings)
