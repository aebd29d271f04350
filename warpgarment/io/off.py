"""OFF, as text: a header, the numbers of vertices and faces, then a row for each; colours after them are skipped."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import read_plain
from warpgarment.io.surface.record import Surface, worth_keeping

from .data import Format, MeshData, ReadOptions
from .polygons import triangulate_counts

HEADERS = ("OFF", "COFF", "NOFF", "CNOFF", "STOFF")  # rows of vertices begin with positions in all of them


def read_off(path: Path) -> MeshData:
    """The mesh, its vertices in the file's unit.

    Raises:
        MeshError: Not an OFF file in text form, cut short, or a face names a vertex that does not exist.
    """
    data = read_plain(path, text=True)
    try:
        text = data.decode("utf-8-sig")
        rows = [row for line in text.splitlines() if (row := line.split("#", 1)[0].split())]
        head = rows[0][0]
        if head not in HEADERS:
            raise ValueError("the first word is not OFF")
        rows = [rows[0][1:], *rows[1:]] if len(rows[0]) > 1 else rows[1:]
        count, polygons = int(rows[0][0]), int(rows[0][1])
        if count < 1 or polygons < 1 or 1 + count + polygons > len(rows):
            raise ValueError(f"{count:,} vertices and {polygons:,} faces in {len(rows) - 1:,} rows")
        vertices = np.array([row[:3] for row in rows[1 : 1 + count]], dtype=np.float64)
        faces = rows[1 + count : 1 + count + polygons]
        counts = np.array([int(row[0]) for row in faces])
        if (counts < 3).any() or any(len(row) <= n for row, n in zip(faces, counts.tolist(), strict=True)):
            raise ValueError("a face has fewer corners than it says, or fewer than three")
        corners = np.array(
            [int(word) for row, n in zip(faces, counts.tolist(), strict=True) for word in row[1 : 1 + n]]
        )
        if corners.min() < 0 or corners.max() >= count:
            raise ValueError(f"a face names a vertex beyond the {count:,}")
        with np.errstate(over="ignore"):
            rest, triangles = vertices.astype(np.float32), triangulate_counts(vertices, counts, corners)
        return MeshData(rest, triangles, surface=worth_keeping(path, lambda: Surface(counts, corners)))
    except (ValueError, IndexError, OverflowError) as error:
        raise MeshError(
            f"{path}: not a readable OFF file ({str(error)[:100]}). It is damaged, cut short, or of another kind."
        ) from None


def _read(path: Path, options: ReadOptions) -> MeshData:
    return read_off(path)


FORMAT = Format(read_mesh=_read)
