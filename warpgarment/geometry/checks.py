"""Requirements on meshes, and errors that name the fault, its place and the remedy.

A rest mesh is refused unless every edge has one or two faces, neighbouring faces agree on their outside, every face has
an area and every vertex a face. Two patches that touch in a single vertex are accepted, since no later step needs more.
A body mesh need only be finite with indices in range, because the distance queries skip faces that have no area.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from warpgarment.errors import MeshError

REMEDY = "Use Garment.cleaned_from(vertices, faces), Garment.load(path, clean=True) for a file, or remove them."
COARSE = 0.02  # steps of float32, as a share of the mean edge length, beyond which the shape of a mesh suffers
FLAT = 1e-6  # a face lower than this share of the mesh's size has no area: in float32 it does not differ from a line


def to_numpy(array: Any) -> np.ndarray:
    """A NumPy view or copy of an array, a nested list or a torch tensor on any device."""
    if hasattr(array, "detach"):
        array = array.detach().cpu()
    return np.asarray(array)


def complain(bad: np.ndarray, what: str, problem: str, remedy: str, element: str | None = None) -> None:
    """Raises MeshError with count, total and first index if any entry of the mask is set.

    Args:
        bad: Mask over all elements, bool, shape [N].
        what: Plural name of the elements, such as ``faces``.
        problem: Predicate of the error's sentence, which begins with the number of elements, as in "3 of N faces".
        remedy: One or more whole sentences that name the remedy.
        element: Singular name of an element, if it is not `what` without its final s.
    """
    if bad.any():
        element = element or what.removesuffix("s")
        count, first = int(np.count_nonzero(bad)), int(np.argmax(bad))
        raise MeshError(f"{count:,} of {len(bad):,} {what} {problem} (first: {element} {first}). {remedy}")


def checked_positions(
    positions: Any, *, name: str = "vertices", frames: bool = False, finite: bool = True
) -> np.ndarray:
    """Positions [m] as contiguous float32, shape [V,3], or [T,V,3] with `frames`.

    Args:
        positions: Positions [m]; NumPy, torch or nested lists.
        name: Name of the argument, for error messages.
        frames: Whether there is one array of positions per frame.
        finite: Whether NaN and infinity are refused.

    Raises:
        MeshError: The positions are not numbers, have another shape, no vertices or no frames, or are not finite.
    """
    shape = "[T,V,3]" if frames else "[V,3]"
    try:
        array = to_numpy(positions)
        if array.dtype.kind not in "fiu":
            raise TypeError
    except (TypeError, ValueError):
        raise MeshError(f"{name} must be an array of numbers of shape {shape}.") from None
    if array.ndim != (3 if frames else 2) or array.shape[-1] != 3:
        raise MeshError(f"{name} must have shape {shape}, got {list(array.shape)}.")
    if array.size == 0:
        raise MeshError(f"{name} is empty: shape {list(array.shape)}. A mesh needs vertices and a motion needs frames.")
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=np.float32)
    if finite:
        bad = ~np.isfinite(array).all(axis=-1)
        if frames and bad.any():
            t, v = (int(i) for i in np.argwhere(bad)[0])
            raise MeshError(
                f"{np.count_nonzero(bad.any(axis=1)):,} of {len(bad):,} frames hold NaN or infinite positions "
                f"(first: frame {t}, vertex {v}). Drop these frames or repair what wrote them."
            )
        if not frames:
            complain(
                bad, name, "are NaN or infinite", "Repair what wrote them.", "vertex" if name == "vertices" else None
            )
    return array


def checked_faces(faces: Any, vertex_count: int, *, name: str = "faces", remedy: str = "Remove them.") -> np.ndarray:
    """Faces as contiguous int32, shape [F,3], each index in [0, vertex_count).

    Args:
        faces: Vertex indices; NumPy, torch or nested lists.
        vertex_count: Number of vertices.
        name: Name of the argument, for error messages.
        remedy: Sentence that names the remedy for indices out of range.

    Raises:
        MeshError: The faces are not integers, have another shape, are none at all, or have an index out of range.
    """
    try:
        array = to_numpy(faces)
    except (TypeError, ValueError):
        raise MeshError(f"{name} must be an integer array of shape [F,3].") from None
    if array.size == 0:
        raise MeshError(f"The mesh has no {name}. A point cloud cannot be simulated.")
    if array.ndim != 2 or array.shape[1] != 3:
        raise MeshError(f"{name} must have shape [F,3], got {list(array.shape)}. Split polygons into triangles first.")
    if array.dtype.kind not in "iu":
        raise MeshError(f"{name} must be integers, got {array.dtype}.")
    bad = np.asarray(((array < 0) | (array >= vertex_count)).any(axis=1))
    complain(bad, name, f"name vertices that do not exist: indices must lie in 0..{vertex_count - 1:,}", remedy, "face")
    return np.ascontiguousarray(array, dtype=np.int32)


def repeated_vertices(faces: np.ndarray) -> np.ndarray:
    """Mask [F] of faces that name a vertex twice."""
    return (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])


def no_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask [F] of faces whose smallest height is at most `FLAT` times the mesh's size.

    The size is the diagonal of the bounding box, or the largest coordinate if that is larger, as for a mesh far from
    the origin, because the resolution of float32 is relative to it.
    """
    used = vertices[np.unique(faces)].astype(np.float64)
    size = max(float(np.linalg.norm(np.ptp(used, axis=0))), float(np.abs(used).max()))
    corners = vertices.astype(np.float64)[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    double_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return double_area <= FLAT * size * longest


def far_from_origin(vertices: Any, faces: np.ndarray, what: str) -> str:
    """A sentence for a warning about a mesh that is so far from the origin that float32 cannot tell its shape.

    Args:
        vertices: Positions as they were given [m], shape [V,3], finite.
        faces: Vertex indices in range, shape [F,3].
        what: What the sentence calls the mesh.

    Returns:
        The sentence, where float32 positions are farther apart than `COARSE` of the mean edge length, or more faces
        have no area than if the mesh were at the origin; otherwise an empty text.
    """
    given = to_numpy(vertices)[np.unique(faces)].astype(np.float64)
    largest = float(np.abs(given).max())
    step = float(np.spacing(np.float32(largest)))
    if step < 1e-5:  # less than 100 m away
        return ""
    exact = to_numpy(vertices).astype(np.float64)
    rounded = exact.astype(np.float32)
    corners = exact[faces]
    edge = float(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).mean())
    lost = np.count_nonzero(no_area(rounded, faces) & ~no_area(exact - given.mean(axis=0), faces))
    if step <= COARSE * edge and not lost:
        return ""
    return (
        f"{what} is {largest / 1e3:.3g} km from the origin, where positions in float32 are {1e3 * step:.2g} mm apart: "
        f"{lost:,} of {len(faces):,} faces have no area there. Move garment and body to the origin, both by the same "
        "offset, before they are exported."
    )


def duplicate_faces(faces: np.ndarray) -> np.ndarray:
    """Mask [F] of faces whose three vertices an earlier face has already used, in any order."""
    first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]
    mask = np.ones(len(faces), dtype=bool)
    mask[first] = False
    return mask


def directed_edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges (0,1), (1,2), (2,0) of each face, shape [3F,2]; edge k of face f is row 3f + k."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def check_rest_mesh(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Raises MeshError unless the mesh is an oriented 2-manifold whose vertices all have a face.

    Args:
        vertices: Positions [m], float32, shape [V,3].
        faces: Vertex indices in range, int32, shape [F,3].
    """
    complain(repeated_vertices(faces), "faces", "name a vertex twice", REMEDY)
    complain(no_area(vertices, faces), "faces", "have no area", REMEDY)
    complain(duplicate_faces(faces), "faces", "repeat an earlier face", REMEDY)
    check_edges(faces)
    unused = np.ones(len(vertices), dtype=bool)
    unused[faces] = False
    complain(unused, "vertices", "belong to no face", REMEDY, "vertex")


def check_edges(faces: np.ndarray) -> None:
    """Raises MeshError if an edge of the faces [F,3] has more than two faces, or neighbours disagree on the outside."""
    directed = directed_edges(faces)
    edges, edge_of, count = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    crowded = count > 2
    if crowded.any():
        first = int(np.argmax(crowded))
        owners = np.nonzero(edge_of.reshape(-1) == first)[0] // 3
        raise MeshError(
            f"{np.count_nonzero(crowded):,} of {len(edges):,} edges have more than two faces (first: edge "
            f"{edges[first, 0]}-{edges[first, 1]} of faces {', '.join(map(str, owners))}). {REMEDY}"
        )
    pairs, pair_of, count = np.unique(directed, axis=0, return_inverse=True, return_counts=True)
    twice = count > 1
    if twice.any():
        first = int(np.argmax(twice))
        a, b = np.nonzero(pair_of.reshape(-1) == first)[0][:2] // 3
        raise MeshError(
            f"{np.count_nonzero(twice):,} of {len(edges):,} edges join faces that disagree on which side is outside "
            f"(first: faces {a} and {b} at edge {pairs[first, 0]}-{pairs[first, 1]}). "
            "Use Garment.cleaned_from(vertices, faces), Garment.load(path, clean=True) for a file, or flip them."
        )


def checked_pins(pins: Any, vertex_count: int) -> np.ndarray:
    """Pinned vertices as sorted, unique int32, shape [P]; None or an empty list gives an empty array.

    Raises:
        MeshError: The pins are not a list of integers, or an index is out of range.
    """
    array = to_numpy([] if pins is None else pins)
    if array.size == 0:
        return np.zeros(0, dtype=np.int32)
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise MeshError(f"pins must be vertex indices of shape [P], got {array.dtype} of shape {list(array.shape)}.")
    bad = (array < 0) | (array >= vertex_count)
    complain(
        bad, "pins", f"name vertices that do not exist: indices must lie in 0..{vertex_count - 1:,}", "Remove them."
    )
    return np.unique(array).astype(np.int32)


def checked_fps(fps: Any) -> float:
    """Frames per second as a positive, finite float; raises MeshError for anything else."""
    value = float(fps)
    if not (np.isfinite(value) and value > 0):
        raise MeshError(f"fps must be positive and finite, got {fps}.")
    return value
