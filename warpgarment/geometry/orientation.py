"""Which side of a surface is outside, decided from its geometry and not from how its faces happen to be wound.

A piece is a set of faces that are connected through edges with exactly two faces. Within a piece, faces are first made
to agree (libigl's breadth-first orientation); then the piece is closed by caps over its holes, and the sign of its
volume says which way it looks:

    V = 1/6 sum over faces and caps of a · (b × c),    V > 0: outwards

A piece that encloses next to nothing, such as a flat sheet, has no outside to be found: it keeps the orientation that
most of its area has.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import igl
import numpy as np

from warpgarment.kernels.mesh.caps import caps_of

from .checks import directed_edges

FLAT = 1e-3
"""Least |V| / area^1.5 of an open piece that counts as enclosing something; a sphere has 0.094."""
ROUNDING = 1e-7
"""The same for a closed piece, whose volume is exact but for rounding."""

MOST_MENDED = 0.1
"""Largest share of a garment's faces that are turned round to agree with the others."""


class Outward(NamedTuple):
    """Faces that look outwards, and what had to be done for it."""

    faces: np.ndarray
    """int32 [F,3], in the given order; a turned face has its corners reversed."""
    turned: np.ndarray
    """Faces that were turned round, bool [F]."""
    inside_out: int
    """Pieces that looked inwards."""
    pieces: int
    """Number of pieces."""
    torn: int
    """Edges whose two faces cannot be made to agree, as on a Moebius strip."""

    def message(self, what: str) -> str:
        """A sentence for a warning about `what`; empty where nothing was turned and nothing is torn."""
        parts = []
        count = int(np.count_nonzero(self.turned))
        if count:
            whole = f": {self.inside_out:,} of {self.pieces:,} pieces were inside out" if self.inside_out else ""
            parts.append(
                f"{count:,} of {len(self.faces):,} faces of {what} looked inwards (first: face "
                f"{int(np.argmax(self.turned))}) and were turned round{whole}. Reverse their winding in the file."
            )
        if self.torn:
            parts.append(
                f"{self.torn:,} edges of {what} join faces that disagree on which side is outside and cannot be made "
                "to agree; inside and outside are not reliable there."
            )
        return " ".join(parts)


def outward(vertices: np.ndarray, faces: np.ndarray) -> Outward:
    """Turns the faces of a surface outwards.

    Args:
        vertices: Positions [m], shape [V,3], finite.
        faces: Vertex indices, shape [F,3].
    """
    oriented, piece = igl.bfs_orient(np.ascontiguousarray(faces, np.int64))
    piece = np.asarray(piece).reshape(-1)
    turned = _reversed(faces, oriented)
    area, volume, closed = _measures(np.asarray(vertices, np.float64), oriented, piece)
    scale = np.where(closed, ROUNDING, FLAT) * area**1.5
    turned_area = np.bincount(piece, _areas(vertices, faces) * turned, len(area))
    # breadth-first orientation starts from any face: a piece that has no inside takes the side of most of its area
    wrong = np.where(np.abs(volume) > scale, volume < 0.0, turned_area > 0.5 * area)
    turned ^= wrong[piece]
    result = np.where(turned[:, None], faces[:, ::-1], faces).astype(np.int32)
    whole = np.bincount(piece, turned, len(area)) == np.bincount(piece, minlength=len(area))
    return Outward(result, turned, int(np.count_nonzero(whole)), len(area), _torn(result))


def turned_outward(vertices: np.ndarray, faces: np.ndarray, what: str) -> np.ndarray:
    """Faces turned outwards, int32 [F,3], with a warning about `what` where some were not; see `outward`."""
    result = outward(vertices, faces)
    message = result.message(what)
    if message:
        warnings.warn(message, UserWarning, stacklevel=3)
    return result.faces


def agreeing(vertices: np.ndarray, faces: np.ndarray, what: str) -> np.ndarray:
    """Turns a few faces of a garment round that disagree with their neighbours about the outside.

    A garment is open, so the side of most of a piece's area is the outside. Where more than `MOST_MENDED` of all faces
    would have to be turned, that is a guess, and the faces are returned as they are.

    Args:
        vertices: Positions [m], shape [V,3].
        faces: Vertex indices, int32 [F,3].
        what: What the warning calls the mesh.

    Returns:
        Faces, int32 [F,3], in the given order.
    """
    oriented, piece = igl.bfs_orient(np.ascontiguousarray(faces, np.int64))
    piece = np.asarray(piece).reshape(-1)
    turned = _reversed(faces, oriented)
    area = _areas(vertices, faces)
    most = np.bincount(piece, area * turned) > 0.5 * np.bincount(piece, area)
    turned ^= most[piece]
    count = int(np.count_nonzero(turned))
    if not count or count > MOST_MENDED * len(faces):
        return faces
    result = np.where(turned[:, None], faces[:, ::-1], faces).astype(np.int32)
    if _torn(result):
        return faces
    warnings.warn(
        f"{count:,} of {len(faces):,} faces of {what} disagreed with their neighbours about the outside (first: face "
        f"{int(np.argmax(turned))}) and were turned round. Reverse them in the file.",
        UserWarning,
        stacklevel=3,
    )
    return result


def _reversed(faces: np.ndarray, oriented: np.ndarray) -> np.ndarray:
    """Whether a face runs the other way round than it did, bool [F]."""
    at = (oriented == faces[:, :1]).argmax(1)  # where the first corner went
    following = np.take_along_axis(oriented, ((at + 1) % 3)[:, None], 1)[:, 0]
    return np.asarray(following != faces[:, 1])


def _measures(vertices: np.ndarray, faces: np.ndarray, piece: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Area [m2] and signed volume [m3] of each piece, and whether it is closed, all [P]."""
    count = int(piece.max()) + 1
    # pieces share no vertex in what follows, so that a cap belongs to one of them
    keys, own = np.unique(piece[:, None].astype(np.int64) * len(vertices) + faces, return_inverse=True)
    own = own.reshape(-1, 3)
    piece_of_vertex, position = keys // len(vertices), vertices[keys % len(vertices)]
    caps = caps_of(own, len(keys)).triangles
    owner = piece_of_vertex[caps[:, 0]] if len(caps) else np.zeros(0, np.int64)
    centre = np.zeros((count, 3))
    np.add.at(centre, piece_of_vertex, position)
    centre /= np.maximum(np.bincount(piece_of_vertex, minlength=count), 1)[:, None]
    position = position - centre[piece_of_vertex]
    closed = np.bincount(owner, minlength=count) == 0
    volume = np.zeros(count)
    for triangles, of in ((own, piece), (caps, owner)):
        a, b, c = (position[triangles[:, k]] for k in range(3))
        volume += np.bincount(of, np.einsum("fi,fi->f", a, np.cross(b, c)) / 6.0, count)
    return np.bincount(piece, _areas(position, own), count), volume, closed


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, k]] for k in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def _torn(faces: np.ndarray) -> int:
    """Edges with exactly two faces that run along it the same way."""
    directed = directed_edges(faces)
    edges, edge_of, count = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    forwards = np.bincount(edge_of.reshape(-1), directed[:, 0] < directed[:, 1], len(edges))
    return int(np.count_nonzero((count == 2) & (forwards != 1)))
