"""Long rollouts: motions of any length without jumps, and figures that need no recording of that length.

A recorded motion is played forth and back. Near its ends, the time s that is shown slows down and turns round in 2w
frames with constant acceleration,

    s(tau) = L - w/2 + tau - tau^2 / 2w        0 <= tau <= 2w        L the last frame

so the speed is continuous (and, since w is even, forward passes show whole recorded frames again, in which the recorded
garment can be compared). Between recorded frames body vertices follow a cubic spline.

The anchor of a garment is the body beneath it: the body vertices nearest to its pins, or to the whole garment if it has
no pins. The mean of a garment that keeps its place follows the rigid motion of the anchor (Kabsch) once the garment has
settled: recorded dresses, too, sink by some centimetres when they start to move.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.training.rollouts import kabsch

TURN = 12  # w: number of frames in which the motion slows down
SETTLING = 60  # number of frames after the start in which a garment may settle to its place and speed
STILL = 0.5 * 0.02**2  # energy below which a garment counts as still [J/kg], that of 2 cm/s
_COLUMNS = 6000  # coordinates interpolated at once


@dataclass(frozen=True)
class Limits:
    """Limits of a good long rollout.

    Attributes:
        mean_m: Distance of the garment's mean from its place in the recording, or from the place to which the anchor
            moves it after settling [m].
        energy_growth: Kinetic energy relative to the body's, last third of the frames over the first third.
        stretch: Extension of the longest edge as a share of its rest length; 1 means twice as long.
        penetration_m: Depth of the deepest vertex of all frames [m].
        inside: Mean share of vertices inside the body.
    """

    mean_m: float = 0.05
    energy_growth: float = 1.5
    stretch: float = 1.0
    penetration_m: float = 0.02
    inside: float = 0.02


def there_and_back(frames: int, total: int, turn: int = TURN) -> tuple[np.ndarray, np.ndarray]:
    """Times of a recording of `frames` frames, played forth and back for `total` frames.

    Args:
        frames: Number of frames of the recording.
        total: Wanted number of frames.
        turn: Number of frames w in which the motion slows down, even; a short recording gets fewer.

    Returns:
        Times in frames of the recording, float64 [total], starting at 0 with full speed; whether a whole frame is shown
        forward at full speed, bool [total].

    Raises:
        ValueError: The recording has fewer than 4 frames.
    """
    last = frames - 1
    if last < 3:
        raise ValueError(f"{frames} frames are too few to play forth and back")
    w = max(2, min(turn, last // 2) // 2 * 2)
    even = last - w  # number of frames at full speed
    t = np.arange(total, dtype=np.float64)
    phase = (t - w / 2) % (2 * even + 4 * w)
    tau = phase - even
    up = w / 2 + phase
    turning = last - w / 2 + tau - tau**2 / (2 * w)
    down = last - w / 2 - (tau - 2 * w)
    tau = phase - 2 * even - 2 * w
    turning_again = w / 2 - tau + tau**2 / (2 * w)
    times = np.select(
        [phase < even, phase < even + 2 * w, phase < 2 * even + 2 * w], [up, turning, down], turning_again
    )
    begins = t < w / 2  # the recording begins at full speed
    return np.where(begins, t, np.clip(times, 0.0, last)), begins | (phase <= even)


def extended(body: BodyMotion, total: int, turn: int = TURN) -> tuple[BodyMotion, np.ndarray, np.ndarray]:
    """A motion played forth and back for `total` frames; returns it with the two results of `there_and_back`."""
    times, forward = there_and_back(body.frames, total, turn)
    recorded = np.asarray(body.vertices).reshape(body.frames, -1)
    vertices = np.empty((total, recorded.shape[1]), np.float32)
    for first in range(0, recorded.shape[1], _COLUMNS):
        part = slice(first, first + _COLUMNS)
        vertices[:, part] = CubicSpline(np.arange(body.frames), recorded[:, part].astype(np.float64))(times)
    whole = times == np.round(times)
    vertices[whole] = recorded[times[whole].astype(int)]  # exactly as recorded
    return BodyMotion(vertices.reshape(total, -1, 3), body.faces, body.fps), times, forward


def walk(frames: int, seed: int = 0) -> tuple[BodyMotion, np.ndarray]:
    """The bundled body, from its rest pose into a procedural walk.

    Args:
        frames: Number of frames.
        seed: Seed of the walk.

    Returns:
        The part of the body with which garments collide, and the rigid transform [3,4], in metres, that moves a garment
        made for the rest pose to the first frame.
    """
    from warpgarment.bodies.rest import bundled_body
    from warpgarment.bodies.skeleton import arms_abducted, blended_in, facing_forward, posed
    from warpgarment.training.generate.recipes import BLEND, FPS
    from warpgarment.training.motions.procedural import procedural

    body = bundled_body()
    poses = arms_abducted(body, procedural(body, "walk", max(frames - BLEND, 1), seed=seed, fps=FPS), 15.0)
    vertices, transforms = posed(body, blended_in(body, facing_forward(poses), BLEND))
    motion = BodyMotion(vertices, body.faces, FPS).submesh(body.collider_faces())
    return motion, transforms[0, 0].astype(np.float64)


class Anchor:
    """The part of a body that a garment moves with.

    Args:
        garment: Garment with its pins.
        vertices: Vertices of the garment in frame `frame` [m], shape [V,3].
        body: Motion of the body.
        frame: Index of a frame of the body.
    """

    def __init__(self, garment: Garment, vertices: np.ndarray, body: BodyMotion, frame: int) -> None:
        place = np.asarray(vertices, np.float64)
        self.share = vertex_areas(garment)
        self.start = np.asarray(body.vertices[frame], np.float64)
        self.mean = self.share @ place
        tree = cKDTree(self.start)
        self.beneath = np.unique(tree.query(place)[1])
        self.tied = np.unique(tree.query(place[garment.pins])[1]) if len(garment.pins) > 2 else self.beneath

    def place(self, mean: np.ndarray, body_vertices: np.ndarray) -> np.ndarray:
        """A garment's mean, moved with the anchor back to the anchor's first frame.

        Args:
            mean: Mean of the garment's vertices [m], shape [3].
            body_vertices: Vertices of the body in that frame [m], shape [U,3].

        Returns:
            Position in the anchor's first frame [m], shape [3].
        """
        now = np.asarray(body_vertices, np.float64)
        rotation, translation = kabsch(self.start[self.tied], now[self.tied])
        return rotation.T @ (mean - translation)


def figures(
    garment: Garment,
    vertices: np.ndarray,
    before: np.ndarray,
    body: BodyMotion,
    first: int,
    recorded_mean: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Figures of every frame of a rollout; NaN from the first frame that is not finite.

    Args:
        garment: Garment at rest.
        vertices: Predicted positions [m], shape [T,V,3].
        before: Positions in the newest known frame [m], shape [V,3].
        body: Motion of the body; its frame `first` is that of vertices[0].
        first: Index of that frame of the body, at least 1.
        recorded_mean: Mean of the recorded garment in every frame [m], [T,3]; NaN where it is not known.

    Returns:
        Curves by name, float64 [T] each: `mean_to_anchor_m`; `mean_drift_m`, the distance from the place at which the
        mean settled (its average over the first third of the frames, without the first two seconds);
        `mean_to_recording_m`; `energy` and `body_energy` [J/kg] in coordinates that travel with the body beneath;
        `stretch` (longest edge over rest length, less one); `penetration_m`; `inside`.
    """
    anchor = Anchor(garment, before, body, first - 1)
    i, j = garment.edges.T
    rest = np.linalg.norm(garment.vertices[i].astype(np.float64) - garment.vertices[j], axis=1)
    meshes = BodyMeshes(torch.from_numpy(np.array(body.vertices[first])), torch.from_numpy(np.array(body.faces)))
    curves = {name: np.full(len(vertices), np.nan) for name in FIGURES}
    previous, places = np.asarray(before, np.float64), np.full((len(vertices), 3), np.nan)
    for t, positions in enumerate(vertices):
        if not np.isfinite(positions).all():
            break
        now, body_now = positions.astype(np.float64), np.asarray(body.vertices[first + t], np.float64)
        body_velocity = body.fps * (body_now - body.vertices[first + t - 1])[anchor.beneath]
        travel = body_velocity.mean(axis=0)
        velocity = body.fps * (now - previous) - travel
        mean = anchor.share @ now
        places[t] = anchor.place(mean, body_now)
        if recorded_mean is not None:
            curves["mean_to_recording_m"][t] = np.linalg.norm(mean - recorded_mean[t])
        curves["energy"][t] = 0.5 * anchor.share @ (velocity**2).sum(axis=1)
        curves["body_energy"][t] = 0.5 * ((body_velocity - travel) ** 2).sum(axis=1).mean()
        curves["stretch"][t] = (np.linalg.norm(now[i] - now[j], axis=1) / rest).max() - 1.0
        meshes.update(torch.from_numpy(np.array(body.vertices[first + t])))
        distance = meshes.query(torch.from_numpy(np.ascontiguousarray(positions, np.float32))).distance.numpy()
        curves["penetration_m"][t] = max(0.0, -float(distance.min()))
        curves["inside"][t] = (distance < 0).mean()
        previous = now
    curves["mean_to_anchor_m"] = np.linalg.norm(places - anchor.mean, axis=1)
    curves["mean_drift_m"] = np.linalg.norm(places - np.array_split(places[settled(len(places))], 3)[0].mean(0), axis=1)
    return curves


FIGURES = (
    "mean_to_anchor_m", "mean_drift_m", "mean_to_recording_m", "energy", "body_energy", "stretch", "penetration_m",
    "inside",
)  # fmt: skip


def settled(frames: int) -> slice:
    """The frames of a rollout that are not part of its start; all frames of a short one."""
    return slice(SETTLING if frames > 3 * SETTLING else 0, None)


def energy_growth(curves: dict[str, np.ndarray]) -> float:
    """Kinetic energy relative to the body's in the last third of the frames over that in the first third.

    The first two seconds of a longer rollout are left out, since its start has another speed.
    """
    counted = settled(len(curves["energy"]))
    thirds = [np.array_split(curves[name][counted] + STILL, 3) for name in ("energy", "body_energy")]
    first, last = (thirds[0][k].sum() / thirds[1][k].sum() for k in (0, -1))
    return float(last / first)


def judged(curves: dict[str, np.ndarray], limits: Limits | None = None) -> dict[str, dict[str, float | bool]]:
    """The verdict: for each limit the value, the limit, and whether it is kept. NaN keeps no limit.

    The mean is compared with the recording if that is known in any frame, otherwise with the anchor, after settling.
    """
    limits = limits or Limits()
    with_recording = np.isfinite(curves["mean_to_recording_m"]).any()
    drift = curves["mean_drift_m"][settled(len(curves["mean_drift_m"]))]
    distance = curves["mean_to_recording_m"] if with_recording else drift
    finite = bool(np.isfinite(curves["energy"]).all())
    values = {
        "mean_m": np.nanmax(distance) if finite else np.nan,
        "energy_growth": energy_growth(curves),
        "stretch": curves["stretch"].max(),
        "penetration_m": curves["penetration_m"].max(),
        "inside": curves["inside"].mean(),
    }
    return {
        name: {"value": float(value), "limit": getattr(limits, name), "kept": bool(value <= getattr(limits, name))}
        for name, value in values.items()
    }


def vertex_areas(garment: Garment) -> np.ndarray:
    """Share of each vertex in the area at rest, which is its share of the mass; [V], with sum one."""
    area = np.asarray(igl.doublearea(garment.vertices.astype(np.float64), garment.faces.astype(np.int64)))
    share = np.bincount(garment.faces.ravel(), np.repeat(area, 3), minlength=len(garment.vertices))
    return share / share.sum()
