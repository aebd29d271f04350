"""Sequences on disk: one folder each, arrays as .npy (memory-mapped when read), a JSON manifest; nothing pickled.

The body is stored as rest mesh, skinning weights and bone transforms, a few hundred numbers a frame.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.body import BodyMotion
from warpgarment.errors import MeshError
from warpgarment.garment import Garment
from warpgarment.skinning import linear_blend_skinning

ARRAYS = {
    "garment_rest_vertices": np.float32,
    "garment_faces": np.int32,
    "pins": np.int32,
    "garment_vertices": np.float32,
    "body_rest_vertices": np.float32,
    "body_faces": np.int32,
    "collider_faces": np.bool_,
    "bone_indices": np.uint8,
    "bone_weights": np.float32,
    "bone_transforms": np.float32,
}
MANIFEST = "manifest.json"


class Sequence:
    """One simulated sequence: a garment on a moving body. Read one with :meth:`load`.

    Attributes:
        folder: Where it lies.
        manifest: Status, split, seed, parameters, figures, checksums.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], arrays: dict[str, np.ndarray]):
        self.folder, self.manifest, self._arrays = folder, manifest, arrays

    @classmethod
    def load(cls, folder: str | Path) -> Sequence:
        """Reads a sequence; large arrays are memory-mapped.

        Raises:
            MeshError: The manifest or an array is missing, damaged, or of another shape or type.
        """
        folder = Path(folder)
        manifest = read_manifest(folder)
        arrays = {}
        for name, dtype in ARRAYS.items():
            try:
                arrays[name] = np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError) as error:
                raise MeshError(f"{folder.name}: {name}.npy cannot be read ({error}). Generate it again.") from error
            if arrays[name].dtype != dtype:
                raise MeshError(f"{folder.name}: {name}.npy is {arrays[name].dtype}, not {np.dtype(dtype)}.")
        vertices, transforms = arrays["garment_vertices"], arrays["bone_transforms"]
        if vertices.ndim != 3 or vertices.shape[1:] != arrays["garment_rest_vertices"].shape:
            raise MeshError(
                f"{folder.name}: garment_vertices has shape {list(vertices.shape)}, its rest mesh "
                f"{list(arrays['garment_rest_vertices'].shape)}."
            )
        if len(vertices) != len(transforms):
            raise MeshError(f"{folder.name}: {len(vertices)} frames of garment, {len(transforms)} of body.")
        return cls(folder, manifest, arrays)

    def __len__(self) -> int:
        return len(self._arrays["garment_vertices"])

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.manifest["fps"])

    @property
    def vertices(self) -> np.ndarray:
        """Garment vertices [m], memory-mapped float32 [T, V, 3]."""
        return self._arrays["garment_vertices"]

    @cached_property
    def garment(self) -> Garment:
        """The rest mesh."""
        return Garment(
            np.array(self._arrays["garment_rest_vertices"]),
            np.array(self._arrays["garment_faces"]),
            pins=np.array(self._arrays["pins"]),
            name=str(self.manifest.get("garment", self.name)),
        )

    def full_body(self) -> BodyMotion:
        """The whole body, for pictures."""
        arrays = self._arrays
        vertices = linear_blend_skinning(
            arrays["body_rest_vertices"], arrays["bone_indices"], arrays["bone_weights"], arrays["bone_transforms"]
        )
        return BodyMotion(vertices, np.array(arrays["body_faces"]), self.fps)

    def body(self) -> BodyMotion:
        """The faces cloth collides with (no hands and forearms), vertices compacted."""
        return self.full_body().submesh(np.array(self._arrays["collider_faces"]))


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a sequence folder.

    Raises:
        MeshError: There is none, or it is not JSON.
    """
    try:
        return json.loads((folder / MANIFEST).read_text())
    except (OSError, ValueError) as error:
        raise MeshError(f"{folder} holds no readable {MANIFEST} ({error}).") from error


def list_sequences(root: str | Path, split: str | None = None, status: str | None = "good") -> list[Path]:
    """Sequence folders below `root`, sorted by name.

    Args:
        root: The data set's folder.
        split: "train", "validation" or "test"; None for all.
        status: "good" or "rejected"; None for both.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"no data set at {root}: make one with `warpgarment generate --out {root}`")
    found = []
    for path in sorted(root.glob(f"*/{MANIFEST}")):
        manifest = read_manifest(path.parent)
        if (split is None or manifest.get("split") == split) and (status is None or manifest.get("status") == status):
            found.append(path.parent)
    return found


def write_sequence(folder: Path, arrays: dict[str, np.ndarray], manifest: dict[str, Any]) -> None:
    """Writes a sequence beside its final place and moves it there, so that it is whole or absent.

    A rejected sequence may leave arrays out; its manifest keeps parameters and reason.
    """
    partial = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    checksums = {}
    for name, array in arrays.items():
        path = partial / f"{name}.npy"
        np.save(path, np.ascontiguousarray(array, dtype=ARRAYS[name]), allow_pickle=False)
        checksums[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    (partial / MANIFEST).write_text(json.dumps(manifest | {"checksums": checksums}, indent=1))
    partial.rename(folder)
