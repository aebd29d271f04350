"""A garment's rest mesh and the quantities that are computed from it once."""

from __future__ import annotations

import os
import warnings
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_matrix

from warpgarment.errors import MeshError
from warpgarment.geometry.checks import (
    REMEDY,
    check_rest_mesh,
    checked_faces,
    checked_pins,
    checked_positions,
    complain,
    directed_edges,
    far_from_origin,
    no_area,
    to_numpy,
)
from warpgarment.geometry.clean import clean_mesh
from warpgarment.geometry.orientation import agreeing
from warpgarment.geometry.seams import REMEDY as SEWING
from warpgarment.geometry.seams import coinciding_borders
from warpgarment.io.disk.cache import remembered
from warpgarment.io.surface.record import Surface

from .simulated import Simulated

if TYPE_CHECKING:
    from warpgarment.geometry.pooled_geodesics import PooledGeodesics
    from warpgarment.io.source import Source


POOLED = 10_000  # with more faces the network's weights are pooled: F x F of them would take 400 MB
KEPT = 1_000  # from this number of faces on, distances are kept on disk; for fewer faces they are computed quickly


class Garment:
    """A garment at rest, checked when made: an oriented 2-manifold, open or closed, of one or more pieces.

    Attributes:
        vertices: Rest positions [m], Y up, float32, shape [V,3].
        faces: Vertex indices, counter-clockwise seen from outside, int32, shape [F,3].
        pins: Vertices that stay tied to the body's surface, int32, shape [P], sorted; empty if there are none.
        name: Name of the garment, for messages and file names.
        source: How its file was read (`warpgarment.io.source.Source`); None for a garment made of arrays.
        surface: Polygons, texture coordinates, materials and groups, as the garment's file has them; a rollout hands
            them on to its result. None: nothing but the triangles.

    Borders of panels that lie at the same place stay open unless they are joined (`clean=True`, `cleaned`), and small
    loose pieces such as buttons ride on the cloth: see `simulated`.

    The cached properties (`edges`, `components`, `face_frames`, `geodesics`, `pooled_geodesics`, `laplacian`) are
    computed from these arrays once: do not change the arrays, make a new garment instead.

    Args:
        vertices: Rest positions [m], shape [V,3]; NumPy, torch or nested lists.
        faces: Vertex indices, integers, shape [F,3].
        pins: Vertices to tie to the body's surface, integers, shape [P]; None for none.
        name: Name of the garment, any text.
        surface: Polygons that name these vertices, with their looks; None for none.

    Raises:
        MeshError: The arrays have other shapes or are empty, or there are numbers that are not finite, indices out of
            range, faces with a vertex twice or without area (relative to the mesh's size), faces given twice, edges of
            more than two faces, many neighbours that disagree on the outside (a few faces are turned round, with a
            warning), or vertices without a face. The error names the element, the count and the remedy.
    """

    source: Source | None = None
    surface: Surface | None = None
    _joined: tuple[Garment, np.ndarray] | None = None  # a mesh with its seams joined, and where each vertex went [V]

    def __init__(self, vertices: Any, faces: Any, *, pins: Any = None, name: str = "", surface: Surface | None = None):
        self.vertices = checked_positions(vertices)
        given = checked_faces(faces, len(self.vertices), remedy=REMEDY)
        self.faces = agreeing(self.vertices, given, f"garment {name!r}" if name else "the garment")
        far = far_from_origin(vertices, self.faces, f"garment {name!r}" if name else "the garment")
        if far:
            complain(no_area(self.vertices, self.faces), "faces", "have no area", far)
            _warn(far)
        check_rest_mesh(self.vertices, self.faces)
        self.pins = checked_pins(pins, len(self.vertices))
        self.name = str(name)
        self.surface = None if surface is None else surface.following(given, self.faces)
        if self.surface is not None:
            self.surface.check_vertices(len(self.vertices))

    def __repr__(self) -> str:
        pins = f", {len(self.pins):,} pins" if len(self.pins) else ""
        return f"Garment({self.name!r}, {len(self.vertices):,} vertices, {len(self.faces):,} faces{pins})"

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        unit: str | None = None,
        *,
        clean: bool = False,
        mesh: str | None = None,
        up: str | None = None,
        pins: Any = None,
    ) -> Garment:
        """Reads a garment from .obj, .ply, .off, .stl, .glb, .gltf, .npz or .usd (.usda, .usdc, .usdz).

        Polygons become triangles. Vertices are never split at texture seams or normals: those of .obj, .ply, .off,
        .npz and .usd files come in the file's number and order. Formats that repeat vertices for every face (.stl) or
        seam (.glb, .gltf) have vertices at exactly the same place joined again.

        Pattern panels, whose seams have vertices of their own on both sides, are recognised by open borders at the same
        place: with `clean` their seams are joined, without it they open, after a warning.

        Args:
            path: File to read.
            unit: Length unit of the file: "m", "dm", "cm", "mm" or "in". None keeps the numbers, except that
                USD files are converted by their own `metersPerUnit` and `upAxis`.
            clean: Whether seams are joined, and a mesh that the constructor would refuse is repaired, as by
                `cleaned_from` with `keep`: the vertices stay those of the file, in their order.
            mesh: Name of the mesh to read where a file holds several: a prim of USD, an object or group of OBJ, a node
                or mesh of glTF. "*" reads everything in OBJ and glTF as one.
            up: Axis that points up in the file, "y" or "z". None is Y, except that USD files say it themselves.
            pins: Vertices of the file to tie to the body's surface, integers, shape [P]; None for those of the file.

        Raises:
            MeshError: The file is not of its kind, is truncated, or holds a mesh that the constructor refuses.
            FileNotFoundError: There is no such file.

        Warns:
            UserWarning: The garment is larger than 10 m or smaller than 5 cm, so that the unit is probably wrong; what
                `clean` has changed; and as `simulated`.
        """
        from warpgarment.io.files import read_mesh
        from warpgarment.io.source import source_of

        path = Path(path)
        data = read_mesh(path, unit=unit, mesh=mesh, up=up)
        try:
            held = data.pins if pins is None else pins
            told: dict[str, Any] = {"pins": held, "name": data.name or path.stem, "surface": data.surface}
            garment = (
                cls.cleaned_from(data.vertices, data.faces, **told, keep=True)
                if clean
                else cls(data.vertices, data.faces, **told)
            )
            garment.simulated  # noqa: B018  # what is said of it is said where it is read
            garment.source = source_of(path, unit=unit, mesh=mesh, up=up)
            return garment
        except MeshError as error:
            raise MeshError(f"{path}: {error}") from None

    def save(self, path: str | os.PathLike) -> None:
        """Writes the garment as .obj, .ply, .npz, .glb (.gltf) or .usd (.usda, .usdc), completely or not at all.

        Only .npz files keep the pins. Polygons, texture coordinates, materials and groups that were read are written
        where the format has them; a warning says what is left out. The materials of an .obj lie in a .mtl beside it.

        Args:
            path: File to write; its suffix decides the format.
        """
        from warpgarment.io.data import MeshData
        from warpgarment.io.files import write_mesh

        write_mesh(Path(path), MeshData(self.vertices, self.faces, self.pins, self.name, self.surface))

    @classmethod
    def cleaned_from(
        cls,
        vertices: Any,
        faces: Any,
        *,
        pins: Any = None,
        name: str = "",
        keep: bool = False,
        surface: Surface | None = None,
    ) -> Garment:
        """A garment from a mesh that the constructor refuses, or whose seams are open.

        Vertices of open borders that are at the same place (within 5 % of the mean edge length) are joined, wherever
        an edge has no more than two faces after it; vertices inside a surface never are. Vertices that are not finite
        are removed with their faces; faces with indices out of range, with a vertex twice or without area, and repeated
        faces are removed; where more than two faces share an edge, the largest two stay; neighbours that disagree on
        the outside are flipped to agree with the majority; vertices without a face are removed. Pins and surface follow
        their vertices; of the surface those polygons stay that have a face left.

        Args:
            vertices: Rest positions [m], shape [V,3].
            faces: Vertex indices, shape [F,3].
            pins: Vertices to tie to the body's surface, as indices before cleaning, shape [P]; None for none.
            name: Name of the garment, any text.
            keep: Whether the garment has all finite vertices that were given, in their order, and what is simulated has
                the joined ones only. Vertices without a face are carried by the cloth nearest to them.
            surface: Polygons that name vertices before cleaning; None for none.

        Raises:
            MeshError: Nothing is left, or the arrays have another shape.

        Warns:
            UserWarning: Something was joined, removed or turned round: how much.
        """
        cleaned = clean_mesh(vertices, faces)
        what = f"garment {name!r}" if name else "the garment"
        given = checked_pins(pins, len(cleaned.went))
        new_pins = cleaned.went[given]
        if surface is not None:
            surface.check_vertices(len(cleaned.went))
            surface = surface.left_of(to_numpy(faces), cleaned.rows, cleaned.corners)
        shown = None if surface is None else surface.renumbered(cleaned.went)
        garment = cls(cleaned.vertices, cleaned.faces, pins=new_pins[new_pins >= 0], name=name, surface=shown)
        _warn(cleaned.message(what))
        if keep and len(cleaned.went) > len(cleaned.vertices):
            all_vertices = np.asarray(to_numpy(vertices), dtype=np.float32)
            garment = garment._with_all(all_vertices, cleaned.corners, cleaned.went, given, surface)
        return garment

    def _with_all(
        self, vertices: np.ndarray, faces: np.ndarray, went: np.ndarray, pins: np.ndarray, surface: Surface | None
    ) -> Garment:
        """A garment of vertices [U,3] before cleaning, of which this one is simulated; `went` [U] as in `Cleaned`."""
        finite = np.isfinite(vertices).all(axis=1)
        number = np.cumsum(finite) - 1
        if not finite.all():
            _warn(f"{np.count_nonzero(~finite):,} of {len(finite):,} vertices are not finite and left out.")
        whole = type(self).__new__(type(self))
        whole.vertices, whole.faces = np.ascontiguousarray(vertices[finite]), number[faces].astype(np.int32)
        whole.pins, whole.name = number[pins[went[pins] >= 0]].astype(np.int32), self.name
        whole.surface = None if surface is None else surface.renumbered(np.where(finite, number, -1))
        whole._joined = self, went[finite]
        return whole

    def transformed(self, matrix: Any, shift: Any = (0.0, 0.0, 0.0), *, pins: Any = None) -> Garment:
        """The garment at another place, in another size, or turned; seams that are joined stay so.

        Args:
            matrix: Rotation times scale, [3,3]; a point p goes to matrix @ p + shift.
            shift: [m], [3].
            pins: Vertices to tie to the body's surface, integers, shape [P]; None for those that it has.

        Raises:
            MeshError: As of the constructor, such as where the garment becomes too small for float32.
        """
        linear, offset = np.asarray(matrix, np.float64), np.asarray(shift, np.float64)
        if not np.linalg.det(linear) > 0:
            raise MeshError("matrix mirrors the garment or flattens it. Give a rotation times a positive scale.")
        moved = checked_positions(self.vertices.astype(np.float64) @ linear.T + offset)
        held = self.pins if pins is None else checked_pins(pins, len(moved))
        if self._joined is None:
            other = type(self)(moved, self.faces, pins=held, name=self.name, surface=self.surface)
        else:
            garment, went = self._joined
            other = type(self).__new__(type(self))
            other.vertices, other.faces, other.pins, other.name = moved, self.faces, held, self.name
            joined = went[held]
            other._joined = garment.transformed(linear, offset, pins=joined[joined >= 0]), went
            other.surface = self.surface
        other.source = self.source
        return other

    def cleaned(self, *, keep: bool = False) -> Garment:
        """A cleaned copy: joins open borders at the same place, such as the two sides of a seam; see `cleaned_from`."""
        told: dict[str, Any] = {"pins": self.pins, "name": self.name, "surface": self.surface}
        return self.cleaned_from(self.vertices, self.faces, **told, keep=keep)

    @cached_property
    def simulated(self) -> Simulated:
        """What is simulated: this garment with its seams joined and without small loose pieces, and the way back.

        Warns:
            UserWarning: There are small loose pieces, which the cloth carries; or open borders at the same place, which
                may be seams that were not joined.
        """
        what = f"garment {self.name!r}" if self.name else "the garment"
        if self._joined is not None:
            result = Simulated(self.vertices, *self._joined)
        else:
            seams = coinciding_borders(self.vertices, self.faces)
            if seams.sides:
                _warn(f"{what}: {seams.found()}. If they are the sides of seams, {SEWING} As they are, they open.")
            _warn(seams.unjoined())
            result = Simulated(self.vertices, self, np.arange(len(self.vertices)))
        _warn(result.message(what))
        return result

    @cached_property
    def edges(self) -> np.ndarray:
        """Undirected edges, lower index first, sorted, int32, shape [E,2]."""
        return np.unique(np.sort(directed_edges(self.faces), axis=1), axis=0)

    @cached_property
    def components(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Connected pieces, numbered by their lowest vertex.

        Piece of each vertex, int32 [V]; piece of each face, int32 [F]; number of pieces. Panels whose seams are joined
        are one piece; a vertex without a face has -1.
        """
        from warpgarment.kernels.mesh.laplacian import components

        if self._joined is not None:
            garment, went = self._joined
            of_vertex, of_face, count = garment.components
            return np.where(went >= 0, of_vertex[went], -1).astype(np.int32), of_face, count
        return components(len(self.vertices), self.faces)

    @cached_property
    def face_frames(self) -> np.ndarray:
        """Columns e1, e2 (the edges from a face's first vertex [m]) and the unit normal, float32, shape [F,3,3]."""
        corners = self.vertices.astype(np.float64)[self.faces]
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normal = np.cross(e1, e2)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.stack([e1, e2, normal], axis=2).astype(np.float32)

    @cached_property
    def geodesics(self) -> np.ndarray:
        """Distances over the surface between face centroids [m], float32, shape [F,F]; see `face_geodesics`.

        From 1,000 faces on they are kept on disk; see `warpgarment.io.disk.cache.remembered`.
        """
        from warpgarment.geometry.geodesics import VERSION, face_geodesics

        count = len(self.faces)
        if count < KEPT:
            return face_geodesics(self.vertices, self.faces)
        return remembered(
            f"geodesics-{VERSION}",
            [self.vertices, self.faces],
            {"distances": ("float32", (count, count))},
            lambda: {"distances": face_geodesics(self.vertices, self.faces)},
        )["distances"]

    @property
    def pools(self) -> bool:
        """Whether the network's geodesic weights are pooled, as for garments of more than 10,000 faces."""
        return len(self.faces) > POOLED

    @cached_property
    def pooled_geodesics(self) -> PooledGeodesics:
        """Distances between some thousand centres, and from them to all faces; kept on disk like `geodesics`."""
        from warpgarment.geometry.pooled_geodesics import CENTRES, NEAR, VERSION, PooledGeodesics, pooled_geodesics

        count = len(self.faces)
        expected = {
            "distances": ("float32", (None, None)),
            "nearest": ("int32", (count, NEAR)),
            "weight": ("float32", (count, NEAR)),
        }
        arrays = remembered(
            f"pooled-{VERSION}",
            [self.vertices, self.faces, CENTRES],
            expected,
            lambda: pooled_geodesics(self.vertices, self.faces)._asdict(),
        )
        return PooledGeodesics(**arrays)

    @cached_property
    def laplacian(self) -> csr_matrix:
        """Cotangent Laplacian of the rest mesh, positive semi-definite, without unit, float64, shape [V,V]."""
        from warpgarment.kernels.mesh.laplacian import cotangent_laplacian

        return cotangent_laplacian(self.vertices, self.faces)


def _warn(message: str) -> None:
    if message:
        warnings.warn(message, UserWarning, stacklevel=3)
