"""What OBJ files say of looks (`vt`, `usemtl`, `mtllib`, beside `o` and `g`), in lines and out of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError

from .mtl import library_beside, material_names, mtl_text, read_libraries
from .record import NONE, Coordinates, Labels, Material, Surface, clean_name, of_triangles

NO_MATERIAL = ("none", "(null)", "null", "")  # what exporters write where there is none
NOTHING = "none"
OBJ_KEEPS = "materials, objects, groups"


class Looks:
    """Texture coordinates and materials of an OBJ file, gathered line by line.

    What is wrong with a line is kept until somebody asks for the surface: a mesh is read without them.
    """

    def __init__(self) -> None:
        self._values: list[tuple[float, float]] = []
        self._corners: list[int] = []
        self._libraries: list[str] = []
        self._materials = {"": 0}
        self._of_polygon: list[int] = []
        self._current = 0
        self._wrong = ""

    def line(self, number: int, line: str) -> None:
        """A line that is neither a vertex nor a face."""
        key, rest = (*line.split(None, 1), "")[:2]
        if key == "vt":
            try:
                words = rest.split()
                self._values.append((float(words[0]), float(words[1]) if len(words) > 1 else 0.0))
            except (ValueError, IndexError):
                self._values.append((0.0, 0.0))
                self._wrong = self._wrong or f"line {number} holds no texture coordinates"
        elif key == "usemtl":
            name = clean_name(rest)
            name = "" if name.lower() in NO_MATERIAL else name
            self._current = self._materials.setdefault(name, len(self._materials))
        elif key == "mtllib":
            self._libraries.append(rest.strip())

    def face(self, words: list[str]) -> None:
        """The corners of a polygon, `a`, `a/b`, `a//c` or `a/b/c`."""
        self._of_polygon.append(self._current)
        count = len(self._values)
        for word in words:
            text = word.partition("/")[2].partition("/")[0]
            if not text:
                self._corners.append(NONE)
                continue
            try:
                index = int(text)
            except ValueError:
                index = 0
            index = index - 1 if index > 0 else count + index if index < 0 else NONE - 1
            if not NONE < index < 2**31:
                self._wrong = self._wrong or f"corner {word!r} names no texture coordinates"
                index = NONE
            self._corners.append(index)

    def surface(self, path: Path, counts: np.ndarray, corners: np.ndarray, objects: Labels, groups: Labels) -> Surface:
        """What was gathered, with the polygons of the file.

        Args:
            path: The file, to whose folder the names of material libraries are relative.
            counts: Corners of each polygon [P].
            corners: Vertices of the corners [C].
            objects: By the `o` lines.
            groups: By the `g` lines.

        Raises:
            MeshError: A line that could not be read, or a corner names texture coordinates that are not there.
        """
        places = np.array(self._corners, dtype=np.int64)
        if self._wrong:
            raise MeshError(f"{self._wrong}.")
        beyond = np.count_nonzero(places >= len(self._values))
        if beyond:
            raise MeshError(
                f"{beyond:,} of {len(places):,} corners name texture coordinates beyond the {len(self._values):,} of "
                "the file."
            )
        sets = [Coordinates("", np.array(self._values, dtype=np.float32), places)] if (places >= 0).any() else []
        known = read_libraries(path, self._libraries)
        names = list(self._materials)[1:]
        materials = tuple(known.get(name, Material(name)) for name in names)
        return Surface(counts, corners, tuple(sets), materials, np.array(self._of_polygon) - 1, objects, groups)


def without_unused(surface: Surface) -> Surface:
    """The surface with the materials and texture coordinates that polygons have, and no others."""
    used, material = np.unique(surface.material, return_inverse=True)
    materials = tuple(surface.materials[k] for k in used if k != NONE)
    sets = []
    for name, values, corners in surface.coordinates:
        pairs, places = np.unique(corners, return_inverse=True)
        none = int((pairs == NONE).any())
        sets.append(Coordinates(name, values[pairs[none:]], places.reshape(-1) - none))
    return replace(
        surface,
        coordinates=tuple(one for one in sets if len(one.values)),
        materials=materials,
        material=material.reshape(-1) - int((used == NONE).any()),
    )


class Around(NamedTuple):
    """An OBJ file's text without its vertices, the same in all frames."""

    head: str
    tail: str

    def of(self, vertices: np.ndarray) -> str:
        """The text with positions [V,3]; nine digits give every float32 back."""
        return self.head + "".join([f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices.tolist()]) + self.tail


def has_materials(surface: Surface | None) -> bool:
    """Whether an OBJ file of this surface needs a library."""
    return surface is not None and bool((surface.material >= 0).any())


def text_around(surface: Surface, name: str = "", library: str = "") -> Around:
    """Everything but the vertices: library, names, texture coordinates, materials and polygons.

    Args:
        surface: The surface; of several sets of texture coordinates the first is written.
        name: Its first word is the object's, where the surface has no names of objects.
        library: File of the materials.
    """
    name = (name.split() or [""])[0]
    one = surface.objects.used
    whole = not one or surface.objects.whole
    title = surface.objects.names[one[0]] if one and whole else "" if one else name
    head = [f"mtllib {library}"] if library else []
    head += [f"o {title}"] if title else []
    tail, faces = _polygons(surface)
    kinds = (
        ("o", surface.objects.names, surface.objects.of_polygon, name or "mesh"),
        ("g", surface.groups.names, surface.groups.of_polygon, "default"),
        ("usemtl", material_names(surface), surface.material, NOTHING),
    )
    above: dict[int, list[str]] = {}
    for key, names, of_polygon, nameless in kinds[1:] if whole else kinds:
        for k in np.flatnonzero(np.diff(of_polygon, prepend=NONE)).tolist():
            label = int(of_polygon[k])
            above.setdefault(k, []).append(f"{key} {names[label] if label >= 0 else nameless}")
    for k, face in enumerate(faces):
        tail += above.get(k, ())
        tail.append(face)
    return Around("".join(f"{line}\n" for line in head), "\n".join(tail) + "\n")


def _polygons(surface: Surface) -> tuple[list[str], list[str]]:
    """Lines of the texture coordinates, and of the polygons."""
    vertices = (surface.corners.astype(np.int64) + 1).tolist()
    pairs, words = [], list(map(str, vertices))
    first = np.cumsum(surface.counts) - surface.counts
    if surface.coordinates:
        _, values, places = surface.coordinates[0]
        pairs = [f"vt {u:.9g} {v:.9g}" for u, v in values.tolist()]
        whole = np.minimum.reduceat(places, first)[surface.polygon_of_corner] >= 0  # readers want all corners or none
        words = [
            f"{a}/{t + 1}" if has else str(a)
            for a, t, has in zip(vertices, places.tolist(), whole.tolist(), strict=True)
        ]
    pieces = zip(first.tolist(), surface.counts.tolist(), strict=True)
    return pairs, [f"f {' '.join(words[at : at + n])}" for at, n in pieces]


def obj_files(
    path: Path, vertices: np.ndarray, faces: np.ndarray, name: str, surface: Surface | None
) -> dict[Path, str]:
    """Texts of an OBJ file, and before it of its library, where there are materials.

    Args:
        path: The OBJ file.
        vertices: Positions [V,3].
        faces: Triangles [F,3], written where there is no surface.
        name: Of the object.
        surface: The polygons; None: triangles.
    """
    library = library_beside(path) if has_materials(surface) else None
    text = text_around(surface or of_triangles(faces), name, library.name if library else "")
    files = {} if library is None or surface is None else {library: mtl_text(surface, path.parent)}
    return files | {path: text.of(vertices)}
