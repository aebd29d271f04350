"""What of a Blender scene is simulated: a garment and a body, evaluated frame by frame, in metres with Y up."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

DEFORMS = {
    "ARMATURE", "CAST", "CLOTH", "CORRECTIVE_SMOOTH", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM",
    "LAPLACIANSMOOTH", "LATTICE", "MESH_CACHE", "MESH_DEFORM", "MESH_SEQUENCE_CACHE", "SHRINKWRAP", "SIMPLE_DEFORM",
    "SMOOTH", "SOFT_BODY", "SURFACE_DEFORM", "WARP", "WAVE",
}  # fmt: skip  # kinds of modifiers that move vertices and make none


class JobError(Exception):
    """Something that the user has to change, in a sentence."""


def y_up(points: np.ndarray) -> np.ndarray:
    """Positions with Z up [...,3] -> with Y up."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def z_up(points: np.ndarray) -> np.ndarray:
    """Positions with Y up [...,3] -> with Z up."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def placed(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Positions [...,3] after a transform [4,4]."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _coordinates(mesh: Any) -> np.ndarray:
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3).astype(np.float64)


def _triangles(mesh: Any) -> np.ndarray:
    mesh.calc_loop_triangles()
    flat = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", flat)
    return flat.reshape(-1, 3)


class Generative:
    """Switches off what a garment's modifiers add or take away, and what follows the first of these.

    The mesh cache takes the place of the garment's own vertices; subdivision and thickness are made of it afterwards.
    """

    def __init__(self, garment: Any) -> None:
        kinds = [modifier.type for modifier in garment.modifiers]
        first = next((k for k, kind in enumerate(kinds) if kind not in DEFORMS), len(kinds))
        self._shown = [(modifier, modifier.show_viewport) for modifier in garment.modifiers[first:]]

    def __enter__(self) -> None:
        for modifier, _ in self._shown:
            modifier.show_viewport = False

    def __exit__(self, *_: object) -> None:
        for modifier, shown in self._shown:
            modifier.show_viewport = shown


class Reader:
    """Reads a garment and a body from the frames of a scene, one frame at a time.

    Args:
        scene: The scene.
        garment: The garment's object.
        body: The body's object.
        pins: Name of the garment's vertex group that is tied to the body; empty for none.

    Attributes:
        frames: Frames that are read, those of the scene.
        world: Transform of the garment in each frame that has been read, [4,4] each.

    Raises:
        JobError: These are no two meshes with faces, or there is no such group.
    """

    def __init__(self, scene: Any, garment: Any, body: Any, pins: str = "") -> None:
        for kind, held in (("garment", garment), ("body", body)):
            if held is None or held.type != "MESH" or not len(held.data.polygons):
                raise JobError(f"There is no {kind}. Choose a mesh that has faces.")
        if garment == body:
            raise JobError("Garment and body are the same object. Choose two.")
        self._scene, self._garment, self._body = scene, garment, body
        self.frames = range(scene.frame_start, scene.frame_end + 1)
        self.world: list[np.ndarray] = []
        self._metres = scene.unit_settings.scale_length if scene.unit_settings.system != "NONE" else 1.0
        self._first: np.ndarray | None = None
        self._rest = np.zeros((0, 3))
        self._body_faces = np.zeros((0, 3), np.int32)
        self._positions: list[np.ndarray] = []
        self.pins = self._group(pins)

    @property
    def done(self) -> int:
        """Number of frames that have been read."""
        return len(self._positions)

    def _group(self, name: str) -> np.ndarray:
        if not name:
            return np.zeros(0, np.int32)
        group = self._garment.vertex_groups.get(name)
        if group is None:
            raise JobError(f"{self._garment.name} has no vertex group {name!r}. Choose one, or none.")
        index = group.index
        tied = [any(g.group == index and g.weight >= 0.5 for g in v.groups) for v in self._garment.data.vertices]
        return np.flatnonzero(tied).astype(np.int32)

    def read(self) -> bool:
        """Reads the next frame; returns whether there are more.

        Raises:
            JobError: A mesh has another number of vertices than in the first frame, or positions are not finite.
        """
        frame = self.frames[self.done]
        self._scene.frame_set(frame)
        if self._first is None:
            with Generative(self._garment):
                self._first = self._evaluated(self._garment, faces=False)[0]
            own = self._garment.data
            if len(self._first) != len(own.vertices):
                raise JobError(
                    f"{self._garment.name} has {len(own.vertices):,} vertices and {len(self._first):,} after its "
                    "modifiers. Move those that add vertices behind the others."
                )
            self._rest = y_up(placed(_coordinates(own), np.array(self._garment.matrix_world)))
        self.world.append(np.array(self._garment.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world))
        points, faces = self._evaluated(self._body, faces=not self._positions)
        if not self._positions:
            self._body_faces = faces
        elif len(points) != len(self._positions[0]):
            raise JobError(
                f"{self._body.name} has {len(points):,} vertices in frame {frame} and {len(self._positions[0]):,} in "
                f"frame {self.frames[0]}. Its modifiers must make as many in every frame."
            )
        if not np.isfinite(points).all():
            raise JobError(f"{self._body.name} has positions in frame {frame} that are not finite.")
        self._positions.append(points)
        return self.done < len(self.frames)

    def _evaluated(self, shown: Any, faces: bool) -> tuple[np.ndarray, np.ndarray]:
        """Positions in the world, Y up, and triangles of an object with its modifiers."""
        evaluated = shown.evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = evaluated.to_mesh()
        try:
            points = y_up(placed(_coordinates(mesh), np.array(evaluated.matrix_world)))
            return points, _triangles(mesh) if faces else np.zeros((0, 3), np.int32)
        finally:
            evaluated.to_mesh_clear()

    def arrays(self) -> dict[str, np.ndarray]:
        """What `worker.py` reads, in metres and seconds."""
        assert self._first is not None
        fps = self._scene.render.fps / self._scene.render.fps_base
        lengths = {"rest": self._rest, "first": self._first, "body": np.stack(self._positions)}
        scaled = {name: (self._metres * points).astype(np.float32) for name, points in lengths.items()}
        own = self._garment.data
        times = {"fps": np.array(fps), "start": np.array(self.frames[0] / fps)}
        return {**scaled, **times, "faces": _triangles(own), "pins": self.pins, "body_faces": self._body_faces}

    def local(self, vertices: np.ndarray) -> np.ndarray:
        """A result [T,V,3] in metres with Y up -> the garment's own coordinates in each frame, float32."""
        points = z_up(vertices.astype(np.float64)) / self._metres
        inverse = [np.linalg.inv(matrix) for matrix in self.world]
        return np.stack([placed(p, m) for p, m in zip(points, inverse, strict=True)]).astype(np.float32)
