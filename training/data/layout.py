"""Names, types and shapes of the arrays of a sequence, and the check that they fit each other.

Letters are sizes: T is the number of frames; V, F and P are the numbers of vertices, faces and pins of all garments
together; U and G are the numbers of vertices and faces of the body; B is the number of bones, W of which move a vertex;
K is the number of garments plus 1.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from warpgarment.errors import MeshError

SPLITS = ("train", "validation", "test")

ARRAYS = {
    "garment_rest_vertices": "V,3",
    "garment_faces": "F,3",
    "garment_starts": "K",  # optional: first vertex of each garment of an outfit, innermost first, and V
    "pins": "P",
    "garment_vertices": "T,V,3",
    "garment_velocities": "T,V,3",  # optional: at the end of each frame [m/s]
    "body_faces": "G,3",
    "collider_faces": "G",
    "body_rest_vertices": "U,3",  # these four, or body_vertices
    "bone_indices": "U,W",
    "bone_weights": "U,W",
    "bone_transforms": "T,B,3,4",
    "body_vertices": "T,U,3",
    "wind": "T,3",  # optional: velocity of the air [m/s]
}
"""Arrays from which a sequence is written and which it gives back: names and shapes."""

_INDEX = "uint8 uint16 int32"
STORED = {
    "garment_rest_vertices": ("float32", "V,3"),
    "garment_faces": (_INDEX, "F,3"),
    "garment_starts": ("int32", "K"),
    "pins": (_INDEX, "P"),
    "garment_positions": ("uint16", "T,V,3"),
    "garment_boxes": ("float32", "T,2,3"),
    "velocity_codes": ("uint16", "T,V,3"),
    "velocity_boxes": ("float32", "T,2,3"),
    "body_faces": (_INDEX, "G,3"),
    "collider_faces": ("uint8", "ceil(G/8)"),
    "body_rest_positions": ("uint16", "U,3"),
    "body_rest_box": ("float32", "2,3"),
    "bone_indices": (_INDEX, "U,W"),
    "bone_weights": ("uint16", "U,W-1"),
    "bone_rotations": ("uint64", "T,B"),
    "bone_translations": ("uint64", "T,B"),
    "bone_origins": ("float32", "T,3"),
    "body_positions": ("uint16", "T,U,3"),
    "body_boxes": ("float32", "T,2,3"),
    "wind": ("float32", "T,3"),
}
"""Files of a sequence: types and shapes. `encoding` explains the numbers."""

_STORED_1 = {
    "garment_rest_vertices": ("float32", "V,3"),
    "garment_faces": ("int32", "F,3"),
    "pins": ("int32", "P"),
    "garment_vertices": ("float32", "T,V,3"),
    "body_rest_vertices": ("float32", "U,3"),
    "body_faces": ("int32", "G,3"),
    "collider_faces": ("bool", "G"),
    "bone_indices": ("uint8", "U,W"),
    "bone_weights": ("float32", "U,W"),
    "bone_transforms": ("float32", "T,B,3,4"),
}
_OPTIONAL = ("garment_starts", "wind")
_VELOCITIES = ("velocity_codes", "velocity_boxes")  # both or none
_PLAIN_BODY = ("body_positions", "body_boxes")
_SKINNED_BODY = (
    "body_rest_positions", "body_rest_box", "bone_indices", "bone_weights", "bone_rotations", "bone_translations",
    "bone_origins",
)  # fmt: skip
_MAY_BE_EMPTY = ("pins", "bone_weights")
AGAIN = "Delete the folder and generate it again."


def expected(version: int, present: Collection[str]) -> dict[str, tuple[str, str]]:
    """Types and shapes of the arrays that a sequence must have, by name.

    Args:
        version: Version of the format, 1 or 2.
        present: Names of the arrays that are there. They decide on the kind of body and on optional arrays.
    """
    if version == 1:
        return dict(_STORED_1)
    absent = _SKINNED_BODY if "body_positions" in present else _PLAIN_BODY
    left_out = {*absent, *(name for name in _OPTIONAL if name not in present)}
    if not any(name in present for name in _VELOCITIES):
        left_out |= set(_VELOCITIES)
    return {name: value for name, value in STORED.items() if name not in left_out}


def check_fit(where: str, stored: Mapping[str, np.ndarray], schema: Mapping[str, tuple[str, str]]) -> None:
    """Raises MeshError unless all types are right, sizes of the same letter agree, and indices are in range.

    Args:
        where: Name of the sequence, for error messages.
        stored: Arrays by name.
        schema: Types and shapes by name, from :func:`expected`.
    """
    missing = [name for name in schema if name not in stored]
    if missing:
        raise MeshError(f"{where}: {len(missing)} arrays are missing (first: {missing[0]}). {AGAIN}")
    sizes: dict[str, tuple[int, str]] = {}
    for name, (types, shape) in schema.items():
        array, letters = stored[name], shape.split(",")
        if array.dtype.name not in types.split():
            raise MeshError(f"{where}: {name}.npy is {array.dtype}, not {' or '.join(types.split())}. {AGAIN}")
        if array.ndim != len(letters):
            raise MeshError(f"{where}: {name}.npy has shape {list(array.shape)}, not [{shape}]. {AGAIN}")
        for letter, size in zip(letters, array.shape, strict=True):
            count, source = _size(letter, sizes) or sizes.setdefault(letter, (size, name))
            if size != count:
                because = f" with {letter} = {count:,} as in {source}.npy" if source else ""
                raise MeshError(f"{where}: {name}.npy has shape {list(array.shape)}, not [{shape}]{because}. {AGAIN}")
        if array.size == 0 and name not in _MAY_BE_EMPTY:
            raise MeshError(f"{where}: {name}.npy is empty. {AGAIN}")
    _check_indices(where, stored, {letter: count for letter, (count, _) in sizes.items()})


def _size(letter: str, sizes: Mapping[str, tuple[int, str]]) -> tuple[int, str] | None:
    """The size that a letter stands for and the array that determines it; None if no array has so far."""
    if letter.isdigit():
        return int(letter), ""
    if letter == "W-1":
        return sizes["W"][0] - 1, sizes["W"][1]
    if letter == "ceil(G/8)":
        return -(-sizes["G"][0] // 8), sizes["G"][1]
    return sizes.get(letter)


def _check_indices(where: str, stored: Mapping[str, np.ndarray], sizes: Mapping[str, int]) -> None:
    """Raises MeshError if an index is out of range or garments share faces."""
    for name, letter in (("garment_faces", "V"), ("pins", "V"), ("body_faces", "U"), ("bone_indices", "B")):
        if name in stored and letter in sizes:
            bad = (stored[name] < 0) | (stored[name] >= sizes[letter])
            if bad.any():
                count, last = np.count_nonzero(bad), sizes[letter] - 1
                raise MeshError(f"{where}: {count:,} of {bad.size:,} entries of {name}.npy exceed 0..{last:,}. {AGAIN}")
    if "garment_starts" not in stored:
        return
    starts = stored["garment_starts"]
    if len(starts) < 2 or starts[0] != 0 or starts[-1] != sizes["V"] or (np.diff(starts) <= 0).any():
        raise MeshError(f"{where}: garment_starts.npy is {starts.tolist()}, not 0 to {sizes['V']:,}, rising. {AGAIN}")
    owner = np.searchsorted(starts, stored["garment_faces"], side="right") - 1
    if (owner != owner[:, :1]).any() or (np.diff(owner[:, 0]) < 0).any() or len(np.unique(owner)) < len(starts) - 1:
        raise MeshError(
            f"{where}: garment_faces.npy does not list the faces of one garment of garment_starts after the other, "
            f"each with vertices of its own. {AGAIN}"
        )
