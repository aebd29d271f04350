"""Encoding of the arrays of a sequence: few bytes, bounded errors, and no further change when read and written again.

| what | stored as | largest error |
| --- | --- | --- |
| positions | uint16 within the bounding box of their frame | half a step, size / 131,070: 0.008 mm at 1 m |
| velocities | uint16 within the box of their frame | half a step, range / 131,070: 0.08 mm/s at 10 m/s |
| rotations | the quaternion over its largest component, the other three in 20 bits: 8 bytes | 4e-6 rad |
| translations | multiples of 2^-17 m above the frame's lowest, 21 bits a coordinate: 8 bytes | 0.004 mm |
| skinning weights | 65,535ths that sum to 65,535; that of the last bone is the remainder | 1.6e-5 |
| indices | the smallest of uint8, uint16 and int32 that holds them | none |
| masks | 8 faces per byte | none |

A moving body of 31 bones takes 508 bytes per frame, regardless of its number of vertices. Arrays that were read and are
written again give exactly the same numbers, so that cloth can be simulated on the body that will be stored:
:func:`stored_body` and :func:`stored_transforms`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError

STEPS = 65535  # number of steps within a box, and within a skinning weight of 1
GRID = 2.0**-17  # m: exact in float32 up to 128 m from the origin
TRANSLATION_BITS, ROTATION_BITS = 21, 20
_HALF = 2 ** (ROTATION_BITS - 1)
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
_RIGID = 2e-5  # largest difference between R R^T and I: 0.02 mm at 1 m


def boxed(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions as steps within the bounding boxes of their frames.

    Args:
        positions: Positions [m], float32 [..., N, 3]. A frame with a NaN or infinity becomes NaN throughout.

    Returns:
        Codes, uint16 [..., N, 3]; boxes, lowest and highest corner [m], float32 [..., 2, 3].
    """
    positions = np.asarray(positions, np.float32)
    finite = np.isfinite(positions).all(axis=(-2, -1), keepdims=True)
    positions = np.where(finite, positions, np.float32(0.0))
    box = np.stack([positions.min(axis=-2), positions.max(axis=-2)], axis=-2)
    low, size = _low_and_size(box)
    steps = (positions - low) * (STEPS / np.where(size > 0, size, 1.0))
    return np.rint(steps).astype(np.uint16), np.where(finite, box, np.float32(np.nan))


def unboxed(codes: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Positions [m], float32 [..., N, 3], from the codes and boxes of :func:`boxed`."""
    low, size = _low_and_size(np.asarray(box))
    return (codes * (size / STEPS) + low).astype(np.float32)


def _low_and_size(box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    box = box.astype(np.float64)
    return box[..., :1, :], box[..., 1:, :] - box[..., :1, :]


def packed_rotations(rotations: np.ndarray) -> np.ndarray:
    """Rotations in 8 bytes each.

    Quaternions q and -q are the same rotation and their length does not matter, so a quaternion is divided by its
    largest component; if two are equally large, either choice gives the same numbers. Bits 0-1 hold the index of the
    largest component; bits 2-21, 22-41 and 42-61 the other three, in order, as 2^19 + (2^19 - 1) times their value
    within -1..1.

    Args:
        rotations: Rotation matrices, float [..., 3, 3].

    Returns:
        Codes, uint64 [...].
    """
    shape = np.shape(rotations)[:-2]
    quaternions = Rotation.from_matrix(np.reshape(rotations, (-1, 3, 3)).astype(np.float64)).as_quat()
    largest = np.abs(quaternions).argmax(axis=1)
    ratios = quaternions / np.take_along_axis(quaternions, largest[:, None], axis=1)
    others = np.take_along_axis(ratios, _OTHERS[largest], axis=1)
    codes = (np.rint(others * (_HALF - 1)) + _HALF).astype(np.uint64)
    return (_packed(codes, ROTATION_BITS) << np.uint64(2) | largest.astype(np.uint64)).reshape(shape)


def unpacked_rotations(codes: np.ndarray) -> np.ndarray:
    """Rotation matrices, float64 [..., 3, 3], from the codes of :func:`packed_rotations`."""
    flat = np.asarray(codes).reshape(-1)
    largest = (flat & np.uint64(3)).astype(np.int64)
    others = _unpacked(flat >> np.uint64(2), ROTATION_BITS).astype(np.float64)
    quaternions = np.ones((len(flat), 4))
    np.put_along_axis(quaternions, _OTHERS[largest], (others - _HALF) / (_HALF - 1), axis=1)
    return Rotation.from_quat(quaternions).as_matrix().reshape(*np.shape(codes), 3, 3)


def packed_translations(translations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translations in 8 bytes each, on a grid of 2^-17 m.

    Args:
        translations: Translations [m], float [T, B, 3]; those of one frame lie within 16 m of each other.

    Returns:
        Codes, uint64 [T, B], with x in bits 0-20, y in 21-41 and z in 42-62 as grid steps from the origin; origin of
        each frame [m], float32 [T, 3].

    Raises:
        MeshError: Translations of a frame are further apart.
    """
    steps = np.rint(np.asarray(translations, np.float64) / GRID).astype(np.int64)
    origins = steps.min(axis=1)
    steps -= origins[:, None]
    if steps.size and steps.max() >= 2**TRANSLATION_BITS:
        frame = int(steps.max(axis=(1, 2)).argmax())
        raise MeshError(
            f"bone_transforms move bones {steps[frame].max() * GRID:.0f} m apart (frame {frame}), more than "
            f"{GRID * 2**TRANSLATION_BITS:.0f} m. Positions must be in metres."
        )
    return _packed(steps.astype(np.uint64), TRANSLATION_BITS), (origins * GRID).astype(np.float32)


def unpacked_translations(codes: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Translations [m], float64 [T, B, 3], from the codes and origins of :func:`packed_translations`."""
    return _unpacked(codes, TRANSLATION_BITS) * GRID + origins[:, None].astype(np.float64)


def _packed(codes: np.ndarray, bits: int) -> np.ndarray:
    """Three codes, [..., 3], in one uint64; the first is in the lowest bits."""
    return codes[..., 0] | codes[..., 1] << np.uint64(bits) | codes[..., 2] << np.uint64(2 * bits)


def _unpacked(packed: np.ndarray, bits: int) -> np.ndarray:
    shifts = np.arange(3, dtype=np.uint64) * np.uint64(bits)
    return np.asarray(packed)[..., None] >> shifts & np.uint64(2**bits - 1)


def packed_transforms(transforms: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rest-to-posed transforms [R | t] in 16 bytes each.

    Args:
        transforms: Rigid transforms with translations in metres, float [T, B, 3, 4].

    Returns:
        Codes of the rotations, uint64 [T, B]; codes of the translations, uint64 [T, B]; origins [m], float32 [T, 3].

    Raises:
        MeshError: The shape is another, a number is not finite, or a transform is not rigid.
    """
    transforms = np.asarray(transforms, np.float64)
    if transforms.ndim != 4 or transforms.shape[2:] != (3, 4):
        raise MeshError(f"bone_transforms must have shape [T,B,3,4], got {list(transforms.shape)}.")
    turns = transforms[..., :3]
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(turns @ np.swapaxes(turns, -1, -2) - np.eye(3)).max(axis=(-2, -1))
        rigid = (off < _RIGID) & (np.linalg.det(turns) > 0) & np.isfinite(transforms).all(axis=(-2, -1))
    if not rigid.all():
        frame, bone = (int(i) for i in np.argwhere(~rigid)[0])
        raise MeshError(
            f"{np.count_nonzero(~rigid):,} of {rigid.size:,} bone_transforms are not finite and rigid (first: frame "
            f"{frame}, bone {bone}). Take scale and shear out of them, or store body_vertices instead of bones."
        )
    return packed_rotations(turns), *packed_translations(transforms[..., 3])


def unpacked_transforms(rotations: np.ndarray, translations: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Transforms with translations in metres, float32 [T, B, 3, 4], from the arrays of :func:`packed_transforms`."""
    moves = unpacked_translations(translations, origins)[..., None]
    return np.concatenate([unpacked_rotations(rotations), moves], axis=-1).astype(np.float32)


def packed_weights(weights: np.ndarray) -> np.ndarray:
    """Skinning weights in 65,535ths, rounded so that each vertex's sum stays exact.

    Args:
        weights: Weights that are not negative, with no row zero, float [V, K].

    Returns:
        Codes of all bones but the last, whose weight is the remainder, uint16 [V, K - 1].

    Raises:
        MeshError: A weight is negative or not finite, or a vertex has no weight.
    """
    weights = np.asarray(weights, np.float64)
    total = weights.sum(axis=1, keepdims=True)
    bad = ~((weights >= 0).all(axis=1) & np.isfinite(total[:, 0]) & (total[:, 0] > 0))
    if bad.any():
        raise MeshError(
            f"{np.count_nonzero(bad):,} of {len(bad):,} vertices have bone_weights that are negative, not finite or "
            f"all zero (first: vertex {int(bad.argmax())}). Normalise bone_weights."
        )
    exact = weights / total * STEPS
    codes = np.floor(exact)
    missing = STEPS - codes.sum(axis=1, keepdims=True)
    rank = np.argsort(np.argsort(codes - exact, axis=1, kind="stable"), axis=1, kind="stable")
    return (codes + (rank < missing)).astype(np.uint16)[:, :-1]


def unpacked_weights(codes: np.ndarray) -> np.ndarray:
    """Skinning weights, float32 [V, K], from the codes of :func:`packed_weights`."""
    codes = np.asarray(codes, np.int64)
    last = STEPS - codes.sum(axis=1, keepdims=True)
    return (np.concatenate([codes, last], axis=1) / STEPS).astype(np.float32)


def packed_indices(indices: np.ndarray) -> np.ndarray:
    """Indices in the smallest of uint8, uint16 and int32 that holds them."""
    indices = np.asarray(indices)
    highest = int(indices.max(initial=0)) if int(indices.min(initial=0)) >= 0 else np.iinfo(np.int32).max
    return indices.astype(np.uint8 if highest < 2**8 else np.uint16 if highest < 2**16 else np.int32)


def stored_transforms(bone_transforms: np.ndarray) -> np.ndarray:
    """Bone transforms as they will be read back from a sequence; each frame is encoded by itself.

    Args:
        bone_transforms: Rigid transforms with translations in metres, shape [T, B, 3, 4].

    Returns:
        Transforms after encoding and decoding, float32 [T, B, 3, 4].

    Raises:
        MeshError: As in :func:`packed_transforms`.
    """
    return unpacked_transforms(*packed_transforms(bone_transforms))


def stored_body(
    rest_vertices: np.ndarray, bone_indices: np.ndarray, bone_weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A body's rest vertices, bones and weights as they will be read back from a sequence, at most 0.02 mm away.

    Args:
        rest_vertices: Rest positions [m], shape [U, 3].
        bone_indices: Bones that move each vertex, shape [U, K].
        bone_weights: Weight of each of these bones, shape [U, K].

    Returns:
        Rest positions [m], float32 [U, 3]; bones, uint8 or uint16 [U, K]; weights, float32 [U, K].
    """
    weights = unpacked_weights(packed_weights(bone_weights))
    return unboxed(*boxed(rest_vertices)), packed_indices(bone_indices), weights


def encoded(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a sequence (`layout.ARRAYS`) as they are stored (`layout.STORED`).

    Raises:
        MeshError: An array cannot be stored, for the reasons that the functions above name.
    """
    stored: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if name in _BOXED:
            stored |= dict(zip(_BOXED[name], boxed(array), strict=True))
        elif name == "bone_transforms":
            stored |= dict(zip(_TRANSFORMS, packed_transforms(array), strict=True))
        elif name == "bone_weights":
            stored[name] = packed_weights(array)
        elif name == "collider_faces":
            stored[name] = np.packbits(np.asarray(array, bool))
        elif name in _INDICES:
            stored[name] = packed_indices(array)
        else:
            stored[name] = np.asarray(array, np.int32 if name == "garment_starts" else np.float32)
    return stored


def decoded(stored: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """One array of a sequence (`layout.ARRAYS`), from the arrays that :func:`encoded` returned.

    Raises:
        KeyError: The array is not among them.
    """
    if name in _BOXED:
        return unboxed(*(stored[part] for part in _BOXED[name]))
    if name == "bone_transforms":
        return unpacked_transforms(*(stored[part] for part in _TRANSFORMS))
    if name == "bone_weights":
        return unpacked_weights(stored[name])
    if name == "collider_faces":
        return np.unpackbits(stored[name], count=len(stored["body_faces"])).astype(bool)
    return stored[name].astype(np.int32) if name in _INDICES else np.array(stored[name])


_INDICES = ("garment_faces", "body_faces", "pins", "bone_indices")
_BOXED = {
    "garment_vertices": ("garment_positions", "garment_boxes"),
    "garment_velocities": ("velocity_codes", "velocity_boxes"),
    "body_vertices": ("body_positions", "body_boxes"),
    "body_rest_vertices": ("body_rest_positions", "body_rest_box"),
}
_TRANSFORMS = ("bone_rotations", "bone_translations", "bone_origins")
