"""A body in motion: any triangle mesh whose vertices move."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.checks import (
    checked_faces,
    checked_fps,
    checked_positions,
    complain,
    far_from_origin,
    no_area,
    repeated_vertices,
    to_numpy,
)
from warpgarment.geometry.orientation import turned_outward
from warpgarment.io.surface.record import Surface

from .clock import Clock, between

if TYPE_CHECKING:
    from warpgarment.io.source import Source


class BodyMotion:
    """A deforming triangle mesh that a garment collides with.

    The mesh may be open, in several parts, and intersect itself. Which side is outside is decided from the first frame
    (`geometry/orientation.py`): faces that look inwards are turned round, with a warning that says how many. Faces
    without area are ignored by the distance queries; their number in the first frame is `degenerate_faces`.

    Attributes:
        vertices: Positions [m], Y up, float32, shape [T,V,3].
        faces: Vertex indices, counter-clockwise seen from outside, int32, shape [F,3].
        fps: Frames per second.
        start: Time of the first frame [s].
        last: When the last frame is reached, in frames after the first: T - 1, or less where resampling put the end of
            the motion on a frame that comes a little later. See `Clock`.
        source: How its file was read (`warpgarment.io.source.Source`); None for a motion made of arrays.
        surface: Polygons, texture coordinates, materials and groups of the file it was loaded from, for `save`; None:
            triangles alone. They are lost where faces are left out.

    Args:
        vertices: Positions [m], shape [T,V,3]; NumPy, torch or nested lists.
        faces: Vertex indices, integers, shape [F,3], in either winding.
        fps: Frames per second, positive.
        start: Time of the first frame [s]: 1001 / 24 for a shot of 24 frames a second that starts at frame 1001.
        last: As above; None: T - 1.

    Raises:
        MeshError: The arrays have other shapes, no frames or no faces, numbers that are not finite (named by frame),
            indices out of range, no face with an area, a rate that is not positive, or a time that is none.

    Warns:
        UserWarning: Faces were turned round; or the body is so far from the origin that float32 cannot tell its shape.
    """

    source: Source | None = None
    surface: Surface | None = None

    def __init__(self, vertices: Any, faces: Any, fps: float = 30.0, *, start: float = 0.0, last: float | None = None):
        self.vertices = checked_positions(vertices, frames=True)
        self.faces = checked_faces(faces, self.vertices.shape[1])
        _, self.fps, self.start, self.last = Clock.checked(len(self.vertices), fps, start, last)
        flat = repeated_vertices(self.faces) | no_area(self.vertices[0], self.faces)
        self.degenerate_faces = int(np.count_nonzero(flat))
        if flat.all():
            complain(flat, "faces", "have no area in the first frame", "A body needs a surface.")
        reach = np.maximum(self.vertices.max(axis=(1, 2)), -self.vertices.min(axis=(1, 2)))
        worst = int(reach.argmax())
        what = f"the body in frame {worst}" if worst else "the body"
        far = far_from_origin(to_numpy(vertices)[worst], self.faces, what)
        if far:
            warnings.warn(far, UserWarning, stacklevel=2)
        self.faces = turned_outward(self.vertices[0], self.faces, "the body")

    @classmethod
    def _derived(
        cls, vertices: np.ndarray, faces: np.ndarray, clock: Clock, degenerate_faces: int, surface: Surface | None
    ) -> BodyMotion:
        """A motion of vertices and faces that another one has checked and turned outwards."""
        motion = cls.__new__(cls)
        motion.vertices, motion.faces, motion.degenerate_faces = vertices, faces, degenerate_faces
        _, motion.fps, motion.start, motion.last = clock
        motion.surface = surface
        return motion

    def __repr__(self) -> str:
        frames, count = self.vertices.shape[:2]
        return f"BodyMotion({frames:,} frames at {self.fps:g} fps, {count:,} vertices, {len(self.faces):,} faces)"

    def __len__(self) -> int:
        return self.frames

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.vertices)

    @property
    def clock(self) -> Clock:
        """When the frames are."""
        return Clock.checked(self.frames, self.fps, self.start, self.last)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        *,
        unit: str | None = None,
        fps: float | None = None,
        collider: bool = True,
        mesh: str | None = None,
        up: str | None = None,
        shape: Any = None,
        rest: bool = False,
    ) -> BodyMotion:
        """Reads a motion, with the time of its first frame where the file has it.

        - ``.npz`` with `vertices` [T,V,3], `faces` [F,3] and `fps`;
        - ``.npz`` with `rest_vertices`, `faces`, `bone_indices`, `bone_weights`, `bone_transforms`, `fps` and, if
          parts such as hands are no colliders, `collider_faces` (bool, [F]);
        - ``.abc``: a mesh of an Alembic archive (extra ``alembic``);
        - ``.pc2`` or ``.mdd`` with a mesh of the same name beside it (``.obj``, else ``.ply``); MDD says its times;
        - ``.usd``, ``.usda``, ``.usdc``, ``.usdz``: a mesh with time samples;
        - ``.bvh``, or ``.npz`` of AMASS: the motion of a skeleton, which moves the body `shape`;
        - a folder of ``.obj`` files with the same faces, at the numbers in their names;
        - any mesh file that `Garment.load` reads, as a single frame.

        Args:
            path: File or folder.
            unit: Length unit of the file: "m", "dm", "cm", "mm" or "in". None keeps the numbers, except that
                USD files are converted by their own `metersPerUnit` and `upAxis`.
            fps: Frames per second, in place of the file's rate. None takes that, or 30, with a warning, if it has none.
                For a point cache with a sample every n frames, or a folder with a file every n frames, these frames
                are meant.
            collider: Whether only the file's `collider_faces` are kept, if it has any.
            mesh: Name of the mesh to read where a file holds several: a prim of USD, an object or group of OBJ, a node
                or mesh of glTF. "*" reads everything in OBJ and glTF as one.
            up: Axis that points up in the file, "y" or "z". None is Y, except that USD files say it themselves.
            shape: The body on a skeleton: "bundled" (None), which is in the package; "anny", or with its values
                "anny,height=0.7,weight=0.3" (extra ``bodies``); an .npz of SMPL, SMPL-H or SMPL-X; or a `RestBody`. Its
                feet stand at height 0, except that models of SMPL's family take AMASS as it is. See docs/bodies.md.
            rest: Read that body at rest, as garments are modelled on it; other files are read as ever.

        Raises:
            MeshError: The file is not of its kind or truncated, its arrays do not fit each other, or the constructor
                refuses them.
            FileNotFoundError: There is no such file.
            UsageError: The body is not known, or the file has one of its own.
            MissingExtra: A package that the format or the body needs is not installed.
        """
        from warpgarment.io.files import rate_of, read_motion, start_of
        from warpgarment.io.source import source_of

        path = Path(path)
        data = read_motion(path, unit=unit, mesh=mesh, up=up, shape=shape, rest=rest)
        rate = rate_of(path, data, fps)
        try:
            motion = cls(data.vertices, data.faces, rate, start=start_of(data, rate), last=data.last)
            if data.surface is not None:
                data.surface.check_vertices(motion.vertices.shape[1])
                motion.surface = data.surface.following(data.faces, motion.faces)
            if collider and data.collider_faces is not None:
                motion = motion.submesh(data.collider_faces)
            motion.source = source_of(
                path, unit=unit, mesh=mesh, up=up, fps=fps, file_fps=data.fps, frames=motion.frames, data=data
            )
            return motion
        except MeshError as error:
            raise MeshError(f"{path}: {error}") from None

    def save(self, path: str | os.PathLike) -> None:
        """Writes the motion as .npz, .usd (.usda, .usdc), .abc, .glb, .pc2 or .mdd with .obj, or a folder of .obj.

        The output is written completely or not at all, with the time of the first frame as `GarmentMotion.save` has it.

        Args:
            path: File or folder to write; its suffix decides the format. With a slash at the end it is a folder.
        """
        from warpgarment.io.data import MotionData
        from warpgarment.io.files import write_motion

        name = Path(path).stem or "body"
        write_motion(path, MotionData.of(self.vertices, self.faces, self.clock, name=name, surface=self.surface))

    def resampled(self, fps: float, frames: int | None = None) -> BodyMotion:
        """The motion at another rate, with positions interpolated linearly in time.

        It starts with the first frame and lasts to the last one, which the last new frame holds wherever that comes: it
        has ceil((T - 1) fps' / fps) + 1 frames. Resampled to the first rate again it has the first frames again, the
        last one unchanged.

        Args:
            fps: New frames per second.
            frames: Largest number of new frames; None for all.

        Raises:
            MeshError: The rate is not positive, or so much higher than the motion's that the frames would fill memory.
        """
        if checked_fps(fps) == self.fps:
            return self
        clock, places = self.clock.resampled(fps, frames, points=self.vertices.shape[1])
        return self._derived(between(self.vertices, places), self.faces, clock, self.degenerate_faces, self.surface)

    def on_clock(self, clock: Clock) -> BodyMotion:
        """The motion at the frames of another clock, in a straight line between its own; before and after it stands
        still."""
        vertices = between(self.vertices, self.clock.places(clock.times))
        return self._derived(vertices, self.faces, clock, self.degenerate_faces, self.surface)

    def submesh(self, face_mask: Any) -> BodyMotion:
        """The motion of some faces only, without the vertices that belong to none of them.

        Args:
            face_mask: Mask of the faces to keep, bool, shape [F].

        Raises:
            MeshError: The mask has another shape or keeps nothing.
        """
        mask = to_numpy(face_mask)
        if mask.dtype != bool or mask.shape != (len(self.faces),):
            raise MeshError(f"face_mask must be bool [{len(self.faces):,}], got {mask.dtype} {list(mask.shape)}.")
        if not mask.any():
            raise MeshError("face_mask keeps no face.")
        used, faces = np.unique(self.faces[mask], return_inverse=True)
        faces = faces.reshape(-1, 3).astype(np.int32)
        vertices = self.vertices[:, used]
        flat = repeated_vertices(faces) | no_area(vertices[0], faces)
        return self._derived(vertices, faces, self.clock, int(np.count_nonzero(flat)), None)


def read_body(path: str | os.PathLike, shape: Any = None, **options: Any) -> BodyMotion:
    """Reads the motion of a body: `BodyMotion.load` with the body on a skeleton as second argument.

    ``wg.read_body("walk.bvh", "anny,height=0.7")``

    Args:
        path: File or folder.
        shape: The body that a BVH or AMASS file moves, see `BodyMotion.load`.
        options: Further arguments of `BodyMotion.load`.

    Raises:
        MeshError, UsageError, MissingExtra, FileNotFoundError: As of `BodyMotion.load`.
    """
    return BodyMotion.load(path, shape=shape, **options)
