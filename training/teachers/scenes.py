"""Requirements on scenes, and the parts of their simulation that all teachers share."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from . import ClothScene, Moving, TeacherError


def check_scenes(scenes: Sequence[ClothScene]) -> None:
    """Refuses scenes that would be simulated wrongly or read outside of arrays.

    Raises:
        TeacherError: A scene is not valid; the error names the scene, the cloth, the fault and the remedy.
    """
    for number, scene in enumerate(scenes):
        where = f"scene {number}: " if len(scenes) > 1 else ""
        if not scene.cloths:
            raise TeacherError(f"{where}there is no cloth to simulate")
        for k, cloth in enumerate(scene.cloths):
            name = f"{where}cloth {k} ({cloth.garment.name or 'no name'})"
            start, rest = np.asarray(cloth.first), cloth.garment.vertices
            if start.shape != rest.shape:
                raise TeacherError(f"{name} starts from shape {list(start.shape)}, its rest mesh is {list(rest.shape)}")
            if not np.isfinite(start).all():
                raise TeacherError(f"{name}: {(~np.isfinite(start)).any(1).sum():,} start positions are not finite")
            if cloth.velocity is not None and np.shape(cloth.velocity) != rest.shape:
                raise TeacherError(
                    f"{name} has velocities of shape {list(np.shape(cloth.velocity))}, its rest mesh is "
                    f"{list(rest.shape)}"
                )
            if cloth.velocity is not None and not np.isfinite(cloth.velocity).all():
                wrong = (~np.isfinite(cloth.velocity)).any(1).sum()
                raise TeacherError(f"{name}: {wrong:,} velocities are not finite")
            if not cloth.edge > 0:
                raise TeacherError(f"{name}: its edge length must be positive, got {cloth.edge}")
        if (scene.body_frames is None) != (scene.body_faces is None):
            raise TeacherError(f"{where}give both body_frames and body_faces, or neither")
        if len(scene) < 1:
            raise TeacherError(f"{where}there are no frames; set `frames` where there is no body")
        if scene.fps <= 0 or scene.settle < 0:
            raise TeacherError(f"{where}fps {scene.fps} must be positive and settle {scene.settle} at least 0")
        if scene.goes_on and (scene.settle or any(cloth.velocity is None for cloth in scene.cloths)):
            raise TeacherError(f"{where}a scene that goes on needs velocities of all its cloths, and settle 0")
        if scene.body_frames is not None:
            _check_body(where, np.asarray(scene.body_frames), np.asarray(scene.body_faces))
        if scene.wind is not None and np.shape(scene.wind) != (len(scene), 3):
            raise TeacherError(f"{where}wind has shape {list(np.shape(scene.wind))}, needed is {[len(scene), 3]}")


def _check_body(where: str, frames: np.ndarray, faces: np.ndarray) -> None:
    if frames.ndim != 3 or frames.shape[2] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise TeacherError(
            f"{where}body frames must have shape [T, U, 3] and faces [G, 3], not {frames.shape} and {faces.shape}"
        )
    if faces.min() < 0 or faces.max() >= frames.shape[1]:
        raise TeacherError(
            f"{where}body faces name vertices {faces.min()} to {faces.max()}, the body has {frames.shape[1]:,}"
        )
    bad = ~np.isfinite(frames).all((1, 2))
    if bad.any():
        raise TeacherError(
            f"{where}{bad.sum():,} of {len(frames):,} body frames are not finite (first: {bad.argmax()})"
        )


def side_by_side(
    scenes: Sequence[ClothScene],
    alike: Callable[[ClothScene], Hashable],
    run: Callable[[list[ClothScene]], Iterator[list[Moving]]],
) -> Iterator[list[Moving | None]]:
    """Simulates scenes that can share a run in one, and the runs frame by frame beside each other.

    Args:
        scenes: The scenes.
        alike: Function whose results are equal for scenes that can share a run.
        run: Function that simulates such scenes, until the longest ends.

    Yields:
        For every frame, that of each scene, or None once a scene has ended.
    """
    groups: dict[Hashable, list[int]] = {}
    for number, scene in enumerate(scenes):
        groups.setdefault(alike(scene), []).append(number)
    running = [(members, run([scenes[m] for m in members])) for members in groups.values()]
    for frame in range(max(map(len, scenes), default=0)):
        shown: list[Moving | None] = [None] * len(scenes)
        for members, stream in running:
            for m, moving in zip(members, next(stream, [None] * len(members)), strict=True):
                shown[m] = moving if frame < len(scenes[m]) else None
        yield shown


def used_body(scene: ClothScene) -> tuple[np.ndarray, np.ndarray]:
    """The body without unused vertices: positions [m], float32 [T, U', 3], and faces, int32 [G, 3]; empty if there is
    no body."""
    if scene.body_frames is None or scene.body_faces is None:
        return np.zeros((len(scene), 0, 3), np.float32), np.zeros((0, 3), np.int32)
    used, faces = np.unique(scene.body_faces, return_inverse=True)
    frames = np.ascontiguousarray(np.asarray(scene.body_frames)[:, used], dtype=np.float32)
    return frames, faces.reshape(-1, 3).astype(np.int32)


def start_of(scenes: Sequence[ClothScene]) -> list[Moving]:
    """Positions and velocities from which scenes go on."""
    found = []
    for scene in scenes:
        points = np.concatenate([cloth.first for cloth in scene.cloths]).astype(np.float32)
        speeds = [np.zeros_like(c.first) if c.velocity is None else c.velocity for c in scene.cloths]
        found.append(Moving(points, np.concatenate(speeds).astype(np.float32)))
    return found


class MovingFrame:
    """Coordinates that move with the body's centroid, smoothed over time; without a body they rest at the origin.

    Time is counted in frames of the simulation, which has `settle` + T of them: at time t + 1, frame t is reached.

    Args:
        body_frames: Body vertices in every frame [m], float32 [T, U, 3].
        settle: Number of frames before the first one, in which the body stands still.
    """

    def __init__(self, body_frames: np.ndarray, settle: int):
        self._count = settle + len(body_frames)
        self._path = None
        if body_frames.shape[1] and self._count > 1:
            means = body_frames.mean(1).astype(np.float64)
            means = np.concatenate([np.repeat(means[:1], settle, axis=0), means])
            centroid = gaussian_filter1d(means, 2.0, axis=0, mode="nearest")
            self._path = CubicSpline(np.arange(self._count) + 1.0, centroid)
        elif body_frames.shape[1]:
            self._fixed = body_frames[0].mean(0).astype(np.float64)
        else:
            self._fixed = np.zeros(3)

    def origin(self, at: np.ndarray | float) -> np.ndarray:
        """Position of the origin at some times [m], shape [..., 3]."""
        if self._path is None:
            return np.broadcast_to(self._fixed, (*np.shape(at), 3))
        return self._path(np.clip(at, 1.0, self._count))


def bound_to_body(points: np.ndarray, body_points: np.ndarray, body_faces: np.ndarray) -> tuple[np.ndarray, ...]:
    """Places of points on a body: nearest face, int [P]; barycentric coordinates, [P, 3]; height above it [m], [P].

    Args:
        points: Points [m], shape [P, 3].
        body_points: Vertices of the body [m], shape [U, 3].
        body_faces: Vertex indices of the body, shape [G, 3].
    """
    import igl

    points, body_points = points.astype(np.float64), body_points.astype(np.float64)
    _, face, closest = igl.point_mesh_squared_distance(points, body_points, body_faces.astype(np.int64))
    corners = body_points[body_faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = ((points - closest) * normal).sum(1)
    foot = points - normal * height[:, None]
    weights = np.asarray(igl.barycentric_coordinates(foot, corners[:, 0], corners[:, 1], corners[:, 2])).reshape(-1, 3)
    return np.asarray(face), weights, height
