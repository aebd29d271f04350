"""Writers for files of data sets by others, byte by byte, for the tests of the readers; they use no code of these."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

STRIP = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1, 2, 0], [0, 2, 0]], dtype=np.float64) / 4.0
QUADS = ((0, 1, 2, 3), (3, 2, 4, 5))  # two squares, one above the other
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]])


def moving(vertices: np.ndarray, frames: int) -> np.ndarray:
    """Positions [T, V, 3] that 16-bit floats hold exactly: every vertex moves on its own path by eighths."""
    steps = np.arange(frames)[:, None, None] * (1 + np.arange(len(vertices))[None, :, None] % 3) * [[[1.0, -1.0, 2.0]]]
    return vertices[None] + steps / 8.0


def write_point_cache(path: Path, frames: np.ndarray, kind: str = "f", version: int = 1, samples: int | None = None):
    """Writes PC2 (kind "f") or PC16 (kind "e") with frames [T, V, 3]: header and numbers by struct."""
    count = len(frames) if samples is None else samples
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", version, frames.shape[1], 0.0, 1.0, count)
    path.write_bytes(head + struct.pack(f"<{frames.size}{kind}", *frames.ravel()))


def write_obj(path: Path, vertices: np.ndarray, polygons) -> None:
    """Writes OBJ with texture coordinates at every corner, as Blender does."""
    lines = ["# a comment", *(f"v {x} {y} {z}" for x, y, z in np.asarray(vertices).tolist()), "vt 0 0", "s 1"]
    lines += ["f " + " ".join(f"{i + 1}/1" for i in polygon) for polygon in polygons]
    path.write_text("\n".join(lines) + "\n")


def write_usda(path: Path, meshes: dict[str, np.ndarray], fps: float = 24.0) -> None:
    """Writes USD as text, Z up and in centimetres: one mesh of TRIANGLES per name, with positions [T, V, 3]."""
    frames = len(next(iter(meshes.values())))
    lines = ["#usda 1.0", "(", '    upAxis = "Z"', "    metersPerUnit = 0.01", f"    timeCodesPerSecond = {fps}"]
    lines += ["    startTimeCode = 1", f"    endTimeCode = {frames}", ")"]
    for name, positions in meshes.items():
        lines += [f'def Mesh "{name}"', "{", f"    int[] faceVertexCounts = {[3] * len(TRIANGLES)}"]
        lines += [f"    int[] faceVertexIndices = {TRIANGLES.ravel().tolist()}", "    point3f[] points.timeSamples = {"]
        lines += [f"        {t}: {[tuple(p) for p in frame.tolist()]}," for t, frame in enumerate(positions, 1)]
        lines += ["    }", "}"]
    path.write_text("\n".join(lines) + "\n")


def mat_file(variables: dict[str, object]) -> bytes:
    """A MATLAB 5 file of numbers, text and structs, after "MAT-File Format", The MathWorks, chapter 1."""
    head = b"MATLAB 5.0 MAT-file, Platform: any".ljust(116) + bytes(8) + struct.pack("<H", 0x0100) + b"IM"
    return head + b"".join(_mat_array(name, value) for name, value in variables.items())


def _element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def _mat_array(name: str, value: object) -> bytes:
    if isinstance(value, dict):
        names = b"".join(key.encode().ljust(32, b"\0") for key in value)
        fields = _element(5, struct.pack("<i", 32)) + _element(1, names)
        return _mat_matrix(2, (1, 1), name, fields + b"".join(_mat_array("", v) for v in value.values()))
    if isinstance(value, str):
        return _mat_matrix(4, (1, len(value)), name, _element(4, struct.pack(f"<{len(value)}H", *map(ord, value))))
    array = np.atleast_2d(np.asarray(value, dtype=np.float64))
    numbers = array.ravel(order="F").tolist()
    return _mat_matrix(6, array.shape, name, _element(9, struct.pack(f"<{len(numbers)}d", *numbers)))


def _mat_matrix(kind: int, shape: tuple[int, ...], name: str, body: bytes) -> bytes:
    flags = _element(6, struct.pack("<II", kind, 0))
    dimensions = _element(5, struct.pack(f"<{len(shape)}i", *shape))
    return _element(14, flags + dimensions + _element(1, name.encode()) + body)
