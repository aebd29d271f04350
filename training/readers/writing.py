"""Recordings as sequences of a training set, so that networks train on data made elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.training.data.layout import SPLITS
from warpgarment.training.data.sequence import write_sequence

from .recording import Recording


def write_as_sequence(
    recording: Recording,
    folder: str | Path,
    *,
    split: str,
    collider: np.ndarray | None = None,
    name: str | None = None,
    motion: str | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Writes a recording as a sequence of a data set, which `train` and `evaluate` read like those that were generated.

    Garments of an outfit become one mesh, innermost first, with `garment_starts` between them. The body is stored as
    its vertices in every frame.

    Args:
        recording: Recording with a body, since a network learns how cloth reacts to the body.
        folder: Folder of the sequence within the data set, which must not exist. It is written completely or not at
            all.
        split: "train", "validation" or "test".
        collider: Mask of the body's faces with which cloth collides, bool [G]; None for all faces. Hands and forearms
            pinch cloth and are better left out.
        name: Name of the garment in tables; None for the garments' names.
        motion: Name of the motion, by which `dataset verify` detects clips that are both trained and tested on; None
            for its name in the data set, or the source.
        extra: Additional entries of the manifest.

    Returns:
        The folder.

    Raises:
        MeshError: There is no body, there are fewer than two frames, or a mask does not fit.
        ValueError: The split is not one of the three.
        FileExistsError: The folder exists.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
    body = recording.body
    if body is None:
        raise MeshError(
            f"{recording.source}: no body, without which there is nothing to learn from. Give one to the reader: "
            "body= takes a BodyMotion, or a function that makes it of the SMPL poses."
        )
    if len(recording) < 2:
        raise MeshError(f"{recording.source}: one frame does not move.")
    mask = np.ones(len(body.faces), dtype=bool) if collider is None else np.asarray(collider)
    if mask.dtype != bool or mask.shape != (len(body.faces),) or not mask.any():
        raise MeshError(f"collider must be bool [{len(body.faces):,}] and keep a face.")
    garments = [g.rest for g in recording.garments]
    starts = np.cumsum([0, *(len(g.vertices) for g in garments)])
    arrays = {
        "garment_rest_vertices": np.concatenate([g.vertices for g in garments]),
        "garment_faces": np.concatenate([g.faces + s for g, s in zip(garments, starts, strict=False)]),
        "garment_starts": starts.astype(np.int32),
        "pins": np.concatenate([g.pins + s for g, s in zip(garments, starts, strict=False)]),
        "garment_vertices": np.concatenate([g.vertices for g in recording.garments], axis=1),
        "body_faces": body.faces,
        "collider_faces": mask,
        "body_vertices": body.vertices,
    }
    if recording.wind is not None:
        arrays["wind"] = recording.wind
    names = [g.name or f"garment {k}" for k, g in enumerate(garments)]
    manifest = {
        "split": split,
        "garment": name or "+".join(names),
        "garments": [
            {"name": garment, "category": garment.lower()} | ({"material": material.as_dict()} if material else {})
            for garment, material in zip(names, recording.materials, strict=True)
        ],
        "category": names[-1].lower() if len(names) == 1 else "outfit",
        "motion": motion or str(recording.attributes.get("motion") or recording.source),
        "fps": recording.fps,
        "status": "good",
        "reason": None,
        "frames": len(recording),
        "figures": {},
        "source": recording.source,
        "attributes": dict(recording.attributes),
    }
    write_sequence(Path(folder), arrays, {**manifest, **(extra or {})})
    return Path(folder)
