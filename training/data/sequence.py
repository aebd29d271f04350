"""Sequences on disk: one folder each, arrays as .npy, a JSON manifest; nothing pickled.

    write_sequence(folder, arrays, manifest)      # arrays in floats (layout.ARRAYS), stored in few bytes (encoding)
    sequence = Sequence.load(folder)              # sequence.garment, .vertices, .body(), .layers, .wind

A body with skinning weights and bone transforms is stored as these and a rest mesh, any other body as positions.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.skinning import linear_blend_skinning
from warpgarment.io.disk.atomic import atomic_folder
from warpgarment.io.disk.plain import open_plain
from warpgarment.io.npz import array_header
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from .encoding import decoded, encoded, stored_body, stored_transforms
from .layout import AGAIN, ARRAYS, STORED, check_fit, expected
from .schema import SEQUENCE
from .set_manifest import DatasetMismatch, read_checked, read_set_manifest, write_set_manifest

__all__ = [
    "ARRAYS", "FORMAT", "MANIFEST", "DatasetMismatch", "Layer", "Sequence", "list_sequences", "read_manifest",
    "read_set_manifest", "stored_body", "stored_transforms", "write_sequence", "write_set_manifest",
]  # fmt: skip

FORMAT = 2
MANIFEST = "manifest.json"
MOST_BYTES = 1 << 30  # of an array that is copied into memory
# Mapped; others would cost an open file each
_LARGE = ("garment_positions", "body_positions", "garment_vertices", "velocity_codes")
_OF_FRAMES = (  # arrays of the body with one entry per frame: format 1, then 2
    "bone_transforms", "bone_rotations", "bone_translations", "bone_origins", "body_positions", "body_boxes",
)  # fmt: skip
_ONE_OF_TWO_BODIES = {"body_vertices", "bone_transforms"}


@dataclass(frozen=True)
class Layer:
    """One garment of an outfit.

    Attributes:
        name, category: Name and category in the manifest.
        vertices, faces: Ranges of the garment in the vertices and faces of the sequence.
        entry: The garment's entry in the manifest: name, category, material.
    """

    name: str
    category: str
    vertices: slice
    faces: slice
    entry: Mapping[str, Any]


class Sequence:
    """One simulated sequence: garments on a moving body. Read one with :meth:`load`.

    Attributes:
        folder: Folder of the sequence.
        manifest: Status, split, seed, parameters, figures and checksums.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], stored: dict[str, np.ndarray]):
        self.folder, self.manifest, self._stored = folder, manifest, stored

    @classmethod
    def load(cls, folder: str | Path) -> Sequence:
        """Reads a sequence. Positions are memory-mapped, and decoded when they are first used.

        Raises:
            MeshError: The manifest or an array is missing, damaged, of another type or shape, or does not fit the
                others.
        """
        folder = Path(folder)
        manifest = read_manifest(folder)
        version, fps = manifest.get("format", 1), manifest.get("fps")
        if version not in (1, FORMAT):
            raise MeshError(f"{folder.name}: format {version!r} is not known, only 1 and {FORMAT}. Update warpgarment.")
        if not (isinstance(fps, (int, float)) and 0 < fps < np.inf):
            raise MeshError(f"{folder.name}: {MANIFEST} says {fps!r} frames per second. {AGAIN}")
        schema = expected(version, {path.stem for path in folder.glob("*.npy")})
        stored = {name: read_array(folder, name) for name in schema}
        check_fit(folder.name, stored, schema)
        sequence = cls(folder, manifest, stored)
        count = len(sequence.starts) - 1
        described = manifest.get("garments") or [{}] * count
        if not isinstance(described, list) or [type(entry) for entry in described] != [dict] * count:
            raise MeshError(f"{folder.name}: {MANIFEST} does not describe {count} garments. {AGAIN}")
        return sequence

    def __len__(self) -> int:
        name = "garment_positions" if "garment_positions" in self._stored else "garment_vertices"
        return len(self._stored[name])

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.manifest["fps"])

    @cached_property
    def vertices(self) -> np.ndarray:
        """Garment vertices [m], float32 [T, V, 3]. A frame with a number that was not finite is NaN throughout."""
        return self._array("garment_vertices")

    @property
    def velocities(self) -> np.ndarray | None:
        """Velocities of the garment at the end of each frame, as the teacher had them [m/s], float32 [T, V, 3].

        None where they were not recorded.
        """
        return self._array("garment_velocities") if "velocity_codes" in self._stored else None

    @cached_property
    def garment(self) -> Garment:
        """The rest mesh, of all garments together."""
        rest, faces, pins = map(self._array, ("garment_rest_vertices", "garment_faces", "pins"))
        try:
            return Garment(rest, faces, pins=pins, name=str(self.manifest.get("garment", self.name)))
        except MeshError as error:
            raise MeshError(f"{self.name}: rest mesh: {error}") from None

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """The garments, innermost first."""
        starts, count = self.starts, len(self.starts) - 1
        alone = {"name": self.manifest.get("garment"), "category": self.manifest.get("category")}
        entries = self.manifest.get("garments") or [alone] * count
        owner = np.searchsorted(starts, self._array("garment_faces")[:, 0], side="right") - 1
        first = np.searchsorted(owner, np.arange(count + 1))
        return tuple(
            Layer(
                str(entries[k].get("name") or self.name),
                str(entries[k].get("category") or ""),
                slice(int(starts[k]), int(starts[k + 1])),
                slice(int(first[k]), int(first[k + 1])),
                entries[k],
            )
            for k in range(count)
        )

    @cached_property
    def worn(self) -> tuple[Garment, ...]:
        """The garments one by one, innermost first, each with its own vertices, faces and pins."""
        whole, found = self.garment, []
        for layer in self.layers:
            first, last = layer.vertices.start, layer.vertices.stop
            pins = whole.pins[(whole.pins >= first) & (whole.pins < last)] - first
            faces = whole.faces[layer.faces] - first
            try:
                found.append(Garment(whole.vertices[layer.vertices], faces, pins=pins, name=layer.name))
            except MeshError as error:
                raise MeshError(f"{self.name}: {layer.name}: {error}") from None
        return tuple(found)

    @cached_property
    def materials(self) -> tuple[Material | None, ...]:
        """The material of each garment; None where the manifest has none.

        Raises:
            MeshError: An entry of the manifest is not a material.
        """
        found = []
        for layer in self.layers:
            entry = layer.entry.get("material")
            try:
                found.append(None if entry is None else Material(**entry))
            except (TypeError, ValueError) as error:
                raise MeshError(f"{self.name}: material of {layer.name}: {error}") from None
        return tuple(found)

    @property
    def starts(self) -> np.ndarray:
        """First vertex of each of K garments, and the number of all vertices, int [K + 1]."""
        return self._stored.get("garment_starts", np.array([0, len(self._stored["garment_rest_vertices"])]))

    @property
    def wind(self) -> np.ndarray | None:
        """Velocity of the air in each frame [m/s], float32 [T, 3]; None for still air."""
        return self._array("wind") if "wind" in self._stored else None

    def full_body(self) -> BodyMotion:
        """The whole body, for pictures."""
        return self.body_in(slice(None))

    def body(self) -> BodyMotion:
        """The part of the body with which cloth collides (without hands and forearms), with its own vertices only."""
        body = self.full_body()
        try:
            return body.submesh(self.collider_faces)
        except MeshError as error:
            raise MeshError(f"{self.name}: body: {error}") from None

    @property
    def collider_faces(self) -> np.ndarray:
        """Mask of the faces of the whole body with which cloth collides, bool [G]."""
        return self._array("collider_faces")

    def body_in(self, frames: slice | list[int]) -> BodyMotion:
        """The whole body in the given frames; other frames are not decoded."""
        vertices = self.body_vertices_in(frames)
        try:
            return BodyMotion(vertices, self._array("body_faces"), self.fps)
        except MeshError as error:
            raise MeshError(f"{self.name}: body: {error}") from None

    def body_vertices_in(self, frames: slice | list[int], used: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Vertices of the body in the given frames [m], float32 [T,U,3], or those with the indices `used` alone.

        Raises:
            MeshError: The body cannot be posed.
        """
        some = {name: array[frames] if name in _OF_FRAMES else array for name, array in self._stored.items()}
        part = Sequence(self.folder, self.manifest, some)
        if "body_positions" in self._stored:
            return part._array("body_vertices")[:, used]
        rest, bones, weights = (
            part._array(name)[used] for name in ("body_rest_vertices", "bone_indices", "bone_weights")
        )
        try:
            return linear_blend_skinning(rest, bones, weights, part._array("bone_transforms"))
        except MeshError as error:
            raise MeshError(f"{self.name}: body: {error}") from None

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays in the form that `write_sequence` takes, so that a sequence of format 1 can be written anew."""
        skinned = {"body_rest_vertices", "bone_indices", "bone_weights", "bone_transforms"}
        left_out = skinned if "body_positions" in self._stored else {"body_vertices"}
        left_out |= {name for name in ("garment_starts", "wind") if name not in self._stored}
        left_out |= {"garment_velocities"} if "velocity_codes" not in self._stored else set()
        return {name: self._array(name) for name in ARRAYS if name not in left_out}

    def _array(self, name: str) -> np.ndarray:
        return np.asarray(self._stored[name]) if self._is_plain else decoded(self._stored, name)

    @property
    def _is_plain(self) -> bool:
        return self.manifest.get("format", 1) == 1


def read_array(folder: Path, name: str) -> np.ndarray:
    """One array of a sequence; large ones are memory-mapped, all others copied into memory.

    Raises:
        MeshError: The file is missing, is not a plain file with one array, or is larger than such an array may be.
    """
    path = Path(folder) / f"{name}.npy"
    try:
        check_array_file(path)
        array = np.lib.format.open_memmap(path, mode="r")  # refuses pickled arrays
    except MeshError as error:
        reason = str(error).removeprefix(f"{path} ").rstrip(".")
        raise MeshError(f"{folder.name}: {name}.npy cannot be read (it {reason}). {AGAIN}") from None
    except (OSError, ValueError, EOFError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise MeshError(f"{folder.name}: {name}.npy cannot be read ({why}). {AGAIN}") from None
    if name not in _LARGE and array.nbytes > MOST_BYTES:
        raise MeshError(f"{folder.name}: {name}.npy has {array.nbytes:,} bytes, at most {MOST_BYTES:,}. {AGAIN}")
    return array if name in _LARGE else np.array(array)


def check_array_file(path: Path) -> None:
    """Checks that a file is a plain one with as many bytes as the array in its header needs; reads no more than that.

    Raises:
        MeshError: It is another kind of file, or has another number of bytes.
        OSError, ValueError: It cannot be read, or does not begin like a .npy file.
    """
    with open_plain(path) as file:
        shape, _, dtype = array_header(file)
        size, needed = path.stat().st_size, file.tell() + dtype.itemsize * math.prod(shape)
    if size != needed and not dtype.hasobject:
        raise MeshError(f"{path} has {size:,} bytes, its header says {needed:,}.")


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a sequence folder.

    Raises:
        MeshError: There is no manifest, it is not a JSON object, or an entry is of another kind than in `schema`.
    """
    return read_checked(Path(folder) / MANIFEST, SEQUENCE)


def list_sequences(root: str | Path, split: str | None = None, status: str | None = "good") -> list[Path]:
    """Sequence folders below `root`, sorted by name.

    Args:
        root: Folder of the data set.
        split: "train", "validation" or "test"; None for all.
        status: "good" or "rejected"; None for both.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"no data set at {root}: make one with `warpgarment generate --out {root}`")
    folders = []
    for path in sorted(root.glob(f"[!.]*/{MANIFEST}")):
        manifest = read_manifest(path.parent)
        if (split is None or manifest.get("split") == split) and (status is None or manifest.get("status") == status):
            folders.append(path.parent)
    return folders


def write_sequence(folder: Path, arrays: Mapping[str, np.ndarray], manifest: Mapping[str, Any]) -> None:
    """Writes a sequence beside its final place and moves it there, so that it is whole or absent.

    Args:
        folder: Folder of the sequence, which must not exist.
        arrays: Arrays by name, with the shapes of `layout.ARRAYS`. A rejected sequence may have none; its manifest
            keeps the parameters and the reason.
        manifest: Entries of the manifest, in types of JSON; `format` and `checksums` (sha256 of every file) are added.

    Raises:
        FileExistsError: The folder exists.
        MeshError: Arrays are missing, unknown, do not fit each other, or cannot be stored.
    """
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists. Remove it to write the sequence again.")
    unknown = sorted(set(arrays) - set(ARRAYS))
    if unknown:
        raise MeshError(f"{folder.name}: unknown arrays {', '.join(unknown)}. There are {', '.join(ARRAYS)}.")
    if set(arrays) >= _ONE_OF_TWO_BODIES:
        raise MeshError(f"{folder.name}: a body has either bone_transforms or body_vertices. Leave one out.")
    try:
        stored = encoded(arrays)
    except MeshError as error:
        raise MeshError(f"{folder.name}: {error}") from None
    if arrays or manifest.get("status") == "good":
        check_fit(folder.name, stored, expected(FORMAT, stored))
    checksums = {}
    with atomic_folder(folder, "*") as partial:
        for name in (name for name in STORED if name in stored):
            path = partial / f"{name}.npy"
            np.save(path, np.ascontiguousarray(stored[name]), allow_pickle=False)
            checksums[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
        content = {**manifest, "format": FORMAT, "checksums": checksums}
        (partial / MANIFEST).write_text(json.dumps(content, indent=1), "utf-8")
