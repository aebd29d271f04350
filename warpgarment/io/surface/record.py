"""The surface of a mesh as its file has it: polygons, texture coordinates, materials and groups.

Simulation needs triangles and nothing else; whoever gets the result back needs the rest. The record travels beside the
triangles from the reader to the writer. It names vertices of the mesh that was read, so it stays true while they move.
Normals are not in it: they change with the motion, and programs that show a mesh compute them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.polygons import triangulate_counts

NONE = -1  # label of a polygon without one; texture coordinate of a corner without one
LONGEST = 200  # characters of a name that are kept
_WRONG = (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RuntimeError)  # USD has the last


class Coordinates(NamedTuple):
    """A set of texture coordinates.

    Attributes:
        name: Of the set; empty where the format has none.
        values: Pairs u, v, with v = 0 at the lower edge of the picture, float32 [N,2].
        corners: The pair of each corner of the polygons, end to end; -1 for a corner without one, int32 [C].
    """

    name: str
    values: np.ndarray
    corners: np.ndarray


class Material(NamedTuple):
    """What is kept of a material.

    Attributes:
        name: Its name.
        color: Base colour, red, green and blue as the file has them; None where it does not say.
        opacity: 1 is opaque; None where the file does not say.
        texture: File of the base colour's picture: absolute, or as the file names it. It is never opened.
        embedded: Whether the picture is inside the file; then it is not kept.
    """

    name: str
    color: tuple[float, float, float] | None = None
    opacity: float | None = None
    texture: str | None = None
    embedded: bool = False


class Labels(NamedTuple):
    """Names of parts, and the part of each polygon: an index of `names`, or -1 for none, int32 [P]."""

    names: tuple[str, ...]
    of_polygon: np.ndarray

    @property
    def used(self) -> list[int]:
        """Parts that have polygons, in the order in which they first appear."""
        found, first = np.unique(self.of_polygon, return_index=True)
        return [int(k) for k in found[np.argsort(first)] if k != NONE]

    @property
    def whole(self) -> bool:
        """Whether all polygons are of one part."""
        return len(self.used) == 1 and bool((self.of_polygon >= 0).all())


@dataclass(frozen=True, eq=False)
class Surface:
    """Polygons of a mesh with what is known of their looks.

    Attributes:
        counts: Corners of each polygon, three or more, int32 [P].
        corners: Vertices of the corners, end to end, int32 [C].
        coordinates: Sets of texture coordinates.
        materials: Materials, numbered by `material`.
        material: Material of each polygon, an index of `materials` or -1, int32 [P]; None: -1 for all.
        objects: Objects of the polygons, such as by the `o` lines of OBJ; None: no names.
        groups: Groups of the polygons. A name of several words, as in OBJ, is several groups; None: no names.

    Raises:
        MeshError: Arrays of other shapes, an index out of range, or texture coordinates that are not finite. Colours
            and opacities that are not are taken for ones that the file does not say.
    """

    counts: np.ndarray
    corners: np.ndarray
    coordinates: tuple[Coordinates, ...] = ()
    materials: tuple[Material, ...] = ()
    material: np.ndarray = None  # type: ignore[assignment]  # an array in every instance
    objects: Labels = None  # type: ignore[assignment]
    groups: Labels = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        counts = _whole(self.counts, "counts of corners", 3, 2**31)
        corners = _whole(self.corners, "vertices of corners", 0, 2**31, int(counts.sum(dtype=np.int64)))
        put("counts", counts)
        put("corners", corners)
        sets = []
        for name, values, places in self.coordinates:
            with np.errstate(over="ignore"):
                pairs = np.ascontiguousarray(values, dtype=np.float32)
            if pairs.ndim != 2 or pairs.shape[1] != 2:
                raise MeshError(f"texture coordinates of shape {list(pairs.shape)} are no pairs.")
            bad = np.count_nonzero(~np.isfinite(pairs).all(axis=1))
            if bad:
                raise MeshError(f"{bad:,} of {len(pairs):,} texture coordinates are not finite.")
            places = _whole(places, "texture coordinates of corners", NONE, len(pairs), len(corners))
            sets.append(Coordinates(clean_name(name), pairs, places))
        put("coordinates", tuple(sets))
        put("materials", tuple(map(_sound, self.materials)))
        put("material", _labels(self.material, len(self.materials), len(counts), "materials"))
        for kind in ("objects", "groups"):
            labels = getattr(self, kind) or Labels((), None)  # type: ignore[arg-type]
            names = tuple(map(clean_name, labels.names))
            put(kind, Labels(names, _labels(labels.of_polygon, len(names), len(counts), kind)))

    def __repr__(self) -> str:
        return (
            f"Surface({len(self.counts):,} polygons, {len(self.coordinates)} sets of texture coordinates, "
            f"{len(self.materials)} materials)"
        )

    @property
    def says_nothing(self) -> bool:
        """Whether there is nothing that triangles alone would not say."""
        named = (self.material >= 0).any() or self.objects.used or self.groups.used
        return not (self.coordinates or named or (self.counts != 3).any())

    @property
    def polygon_of_corner(self) -> np.ndarray:
        """The polygon of each corner, int [C]."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @property
    def polygon_of_triangle(self) -> np.ndarray:
        """The polygon of each triangle that `triangulate_counts` makes, int [sum of (corners - 2)]."""
        return np.repeat(np.arange(len(self.counts)), self.counts - 2)

    def _permuted(self, order: np.ndarray, **more: Any) -> Surface:
        """The surface with other corners: for each new one the old."""
        sets = tuple(one._replace(corners=one.corners[order]) for one in self.coordinates)
        return replace(self, **{"corners": self.corners[order], "coordinates": sets, **more})

    def turned(self, polygons: np.ndarray) -> Surface:
        """The surface with some polygons turned round, bool [P]; the first corner stays the first."""
        if not polygons.any():
            return self
        starts = np.repeat(np.cumsum(self.counts) - self.counts, self.counts)
        within, count = np.arange(len(self.corners)) - starts, np.repeat(self.counts, self.counts)
        turn = polygons[self.polygon_of_corner]
        return self._permuted(np.where(turn, starts + (count - within) % count, starts + within))

    def following(self, before: np.ndarray, after: np.ndarray) -> Surface:
        """The surface with those polygons turned round whose triangles were.

        Args:
            before: Triangles as they were made of the polygons [F,3].
            after: The same with some turned round [F,3].
        """
        turned = (np.asarray(before) != np.asarray(after)).any(axis=1)
        owner = self.polygon_of_triangle
        if not turned.any() or len(turned) != len(owner):
            return self
        polygons = np.zeros(len(self.counts), dtype=bool)
        polygons[owner[turned]] = True
        return self.turned(polygons)

    def left_of(self, before: np.ndarray, rows: np.ndarray, after: np.ndarray) -> Surface | None:
        """The surface of a mesh of which some triangles are left, maybe turned round: polygons with one that is left.

        Args:
            before: Triangles as they were made of the polygons [F,3].
            rows: Which of them are left [F'].
            after: Those [F',3], as `before` has them or turned round.

        Returns:
            The surface, unchanged where the triangles are not those of the polygons; None where nothing of it is left.
        """
        owner = self.polygon_of_triangle
        if len(before) != len(owner):
            return self
        whole = np.array(before)
        whole[rows] = after
        found, left = self.following(before, whole), np.bincount(owner[rows], minlength=len(self.counts)) > 0
        return found if left.all() else found.only(left) if left.any() else None

    def only(self, polygons: np.ndarray) -> Surface:
        """Some polygons [P], bool, with the same vertices."""
        kept = np.flatnonzero(polygons[self.polygon_of_corner])
        return self._permuted(
            kept,
            counts=self.counts[polygons],
            material=self.material[polygons],
            objects=self.objects._replace(of_polygon=self.objects.of_polygon[polygons]),
            groups=self.groups._replace(of_polygon=self.groups.of_polygon[polygons]),
        )

    def renumbered(self, new: np.ndarray) -> Surface | None:
        """The surface of a mesh whose vertices were joined or removed.

        Polygons that name a vertex that is no more, and those that have fewer than three corners left, go; of corners
        that follow each other at one vertex, the first stays.

        Args:
            new: Index of each old vertex among the new ones [V]; -1 where it was removed.

        Returns:
            The surface; None where nothing of it is left.
        """
        moved, owner = np.asarray(new)[self.corners], self.polygon_of_corner
        starts = np.cumsum(self.counts) - self.counts
        before = np.arange(len(moved)) - 1
        before[starts] = starts + self.counts - 1
        distinct = moved != moved[before]
        left = np.add.reduceat(distinct.astype(np.int64), starts)
        whole = (np.minimum.reduceat(moved, starts) >= 0) & (left >= 3)
        if not whole.any():
            return None
        kept = np.flatnonzero(distinct & whole[owner])
        found = self._permuted(np.arange(len(moved)), corners=np.maximum(moved, 0))
        smaller = np.bincount(owner[kept], minlength=len(whole)).astype(np.int32)
        # polygons that go keep three corners until they do, so that every count is one of a polygon
        smaller = np.where(whole, smaller, 3)
        gone = np.flatnonzero((np.arange(len(moved)) - starts[owner] < 3) & ~whole[owner])
        order = np.sort(np.concatenate([kept, gone]))
        return found._permuted(order, counts=smaller).only(whole)

    def triangles(self, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Corners of triangles, [F,3]: those of the faces where these were made of the polygons, otherwise new ones.

        Args:
            vertices: Positions [V,3], for the cut of concave polygons.
            faces: Triangles that were made of the polygons, in their order, or others.
        """
        owner, count = self.polygon_of_triangle, int(max(self.corners.max(), np.max(faces))) + 1
        if len(owner) == len(faces):
            keys = self.polygon_of_corner * count + self.corners
            order = np.argsort(keys, kind="stable")
            wanted = owner[:, None] * count + faces
            found = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(order) - 1)]
            if (keys[found] == wanted).all():
                return found
        return triangulate_counts(vertices[self.corners], self.counts, np.arange(len(self.corners)))

    def check_vertices(self, count: int) -> None:
        """Raises MeshError where a corner names a vertex beyond the last of `count`."""
        if len(self.corners) and self.corners.max() >= count:
            raise MeshError(f"its surface names vertex {int(self.corners.max()):,}, and there are {count:,}.")


def of_triangles(faces: np.ndarray) -> Surface:
    """The surface of triangles [F,3] of which nothing more is known."""
    return Surface(np.full(len(faces), 3), np.asarray(faces).reshape(-1))


def worth_keeping(where: object, make: Callable[[], Surface | None]) -> Surface | None:
    """A surface that a reader makes; None where it says nothing that the triangles do not.

    Nothing in it takes part in a simulation, so a damaged one is left out, with a warning, and the mesh is read.

    Args:
        where: The file, and its mesh, for the warning.
        make: What makes it; errors of Python are taken for damage.
    """
    try:
        found = make()
    except (MeshError, *_WRONG) as error:
        warnings.warn(
            f"{where}: its texture coordinates, materials and groups will not be in outputs, as they are damaged: "
            f"{str(error)[:200]}",
            UserWarning,
            stacklevel=6,
        )
        return None
    return None if found is None or found.says_nothing else found


def members(label: np.ndarray) -> dict[int, np.ndarray]:
    """For each label that occurs in [N], -1 included, where it does, in order."""
    order = np.argsort(label, kind="stable")
    found, starts = np.unique(label[order], return_index=True)
    return dict(zip(found.tolist(), np.split(order, starts[1:]), strict=True))


def say_left_out(path: object, surface: Surface | None, *, sets: int = 0, polygons: str = "", keeps: str = "") -> None:
    """Warns, in one line, of what an output cannot hold of a surface.

    Args:
        path: The output.
        surface: What it is made of; None: triangles.
        sets: How many sets of texture coordinates it holds.
        polygons: What becomes of polygons with more than three corners; empty: they stay.
        keeps: What else it holds: "materials", "names of materials" without colours and pictures, "objects" and
            "groups", of which others are left out.
    """
    if surface is None:
        return
    lost = []
    if len(surface.coordinates) > sets:
        lost.append("texture coordinates" if sets == 0 else f"all but {sets} of {len(surface.coordinates)} sets of "
                    "texture coordinates")  # fmt: skip
    there = {
        "materials": (surface.material >= 0).any(),
        "objects": surface.objects.used and not surface.objects.whole,  # of a single one the name may go
        "groups": surface.groups.used,
    }
    lost += [kind for kind, some in there.items() if some and kind not in keeps]
    if "names of materials" in keeps:
        if any(
            (one.color, one.opacity, one.texture) != (None, None, None) or one.embedded for one in surface.materials
        ):
            lost.append("colours and pictures of materials")
    elif "materials" in keeps and any(material.embedded for material in surface.materials):
        lost.append("pictures that were inside the input")
    said = f"left out: {', '.join(lost)}" if lost else ""
    if polygons and (surface.counts != 3).any():
        said += f"{'; ' if said else ''}{polygons}"
    if said:
        warnings.warn(f"{path}: {said}.", UserWarning, stacklevel=5)


def clean_name(text: object) -> str:
    """A name as one line that can be written everywhere: no control characters, of bounded length."""
    plain = str(text).encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return "".join(letter if letter.isprintable() else "_" for letter in plain[:LONGEST]).strip()


def unique_names(names: Sequence[str]) -> list[str]:
    """Names that differ: a name that was there already gets a number."""
    seen: dict[str, int] = {}
    found = []
    for name in names:
        base = unique = name or "unnamed"
        while unique in seen:
            seen[base] += 1
            unique = f"{base}_{seen[base]}"
        seen[unique] = 0
        found.append(unique)
    return found


def _sound(material: Material) -> Material:
    """A material with a name of one line, without numbers that float32 cannot hold."""
    name, color, opacity, *_ = material
    with np.errstate(over="ignore"):
        color = color if color is not None and np.isfinite(np.array(color, np.float32)).all() else None
        opacity = opacity if opacity is not None and np.isfinite(np.array(opacity, np.float32)) else None
    return material._replace(name=clean_name(name), color=color, opacity=opacity)


def _whole(array: Any, what: str, least: int, end: int, count: int | None = None) -> np.ndarray:
    """Whole numbers from `least` on and below `end`, int32 [N]."""
    found = np.asarray(array)
    if found.ndim != 1 or (found.size and found.dtype.kind not in "iu") or (count is not None and len(found) != count):
        wanted = "" if count is None else f", and {count:,} are needed"
        raise MeshError(f"{what}: {found.dtype} of shape {list(found.shape)}{wanted}.")
    if found.size and (found.min() < least or found.max() >= end):
        wrong = found[(found < least) | (found >= end)]
        raise MeshError(f"{what}: {len(wrong):,} are out of range (first: {int(wrong[0])}, and there are {end:,}).")
    return np.ascontiguousarray(found, dtype=np.int32)


def _labels(array: Any, names: int, polygons: int, what: str) -> np.ndarray:
    if array is None:
        return np.full(polygons, NONE, dtype=np.int32)
    return _whole(array, f"{what} of polygons", NONE, names, polygons)
