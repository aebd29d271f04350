"""Long rollouts: motions of any length without jumps, and figures that need no recording of that length.

A recorded motion is played forth and back. Near its ends, the time s that is shown slows down and turns round in 2w
frames with constant acceleration,

    s(tau) = L - w/2 + tau - tau^2 / 2w        0 <= tau <= 2w        L the last frame

so the speed is continuous (and, w being even, forward passes show whole recorded frames again, where the recorded
garment can be compared with). Between recorded frames body vertices follow a cubic spline.

The anchor of a garment is the body beneath it: the body vertices nearest to its pins, or to all of it where nothing is
pinned. A garment that keeps its place has its mean where the rigid motion of the anchor (Kabsch) takes it, once it has
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

TURN = 12  # w: frames that slowing down takes
SETTLING = 60  # frames after the start that a garment may take to find its place and speed
STILL = 0.5 * 0.02**2  # J/kg, energy below which nothing moves: 2 cm/s
_COLUMNS = 6000  # coordinates interpolated at once


@dataclass(frozen=True)
class Limits:
    """What a good long rollout keeps.

    Attributes:
        mean_m: Distance of the garment's mean from where the recording has it, or the anchor takes it from where it
            settled [m].
        energy_growth: Kinetic energy relative to the body's, last third of the frames over the first third.
        stretch: Of the longest edge relative to its rest length: 1 is twice as long.
        penetration_m: Deepest vertex of all frames [m].
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
        frames: Of the recording.
        total: Wanted.
        turn: w, even; less where the recording is short.

    Returns:
        Times [frames], float64 [total], starting at 0 with full speed; and where a whole frame is shown at full
        speed forward, bool [total].

    Raises:
        ValueError: Fewer than 4 frames.
    """
    last = frames - 1
    if last < 3:
        raise ValueError(f"{frames} frames are too few to play forth and back")
    w = max(2, min(turn, last // 2) // 2 * 2)
    even = last - w  # frames at full speed
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
    """A motion played forth and back; returns it with what `there_and_back` gives."""
    times, forward = there_and_back(body.frames, total, turn)
    recorded = np.asarray(body.vertices).reshape(body.frames, -1)
    vertices = np.empty((total, recorded.shape[1]), np.float32)
    for first in range(0, recorded.shape[1], _COLUMNS):
        part = slice(first, first + _COLUMNS)
        vertices[:, part] = CubicSpline(np.arange(body.frames), recorded[:, part].astype(np.float64))(times)
    whole = times == np.round(times)
    vertices[whole] = recorded[times[whole].astype(int)]  # exactly what was recorded
    return BodyMotion(vertices.reshape(total, -1, 3), body.faces, body.fps), times, forward


def walk(frames: int, seed: int = 0) -> tuple[BodyMotion, np.ndarray]:
    """The bundled body, from its rest pose into a procedural walk.

    Returns:
        What garments collide with, and the rigid transform [3,4] that takes a garment made for the rest pose to the
        first frame.
    """
    from warpgarment.training.bodies.anny import bundled_body
    from warpgarment.training.bodies.skeleton import arms_abducted, blended_in, facing_forward, posed
    from warpgarment.training.generate.recipes import BLEND, FPS
    from warpgarment.training.motions.procedural import procedural

    body = bundled_body()
    poses = arms_abducted(body, procedural(body, "walk", max(frames - BLEND, 1), seed=seed, fps=FPS), 15.0)
    vertices, transforms = posed(body, blended_in(body, facing_forward(poses), BLEND))
    motion = BodyMotion(vertices, body.faces, FPS).submesh(body.collider_faces())
    return motion, transforms[0, 0].astype(np.float64)


class Anchor:
    """The part of a body that a garment goes with.

    Args:
        garment: With its pins.
        vertices: Where it is in `frame` [m], shape [V,3].
        body: Its motion.
        frame: Of the body.
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
        """Where a garment's mean [3] is as seen from the anchor: where it would be in the anchor's first frame [m]."""
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
    """Figures of every frame of a rollout; NaN from where it is not finite.

    Args:
        garment: At rest.
        vertices: Predicted positions [m], shape [T,V,3].
        before: The newest known frame, [V,3].
        body: Its motion; frame `first` is that of vertices[0].
        first: See `body`; at least 1.
        recorded_mean: Where the recorded garment's mean was [m], [T,3]; NaN where that is not known.

    Returns:
        float64 [T]: `mean_to_anchor_m`; `mean_drift_m`, the same from where the mean settled (its average over the
        first third of the frames, without the first two seconds); `mean_to_recording_m`; `energy` and `body_energy`
        [J/kg] in the frame that travels with the body beneath; `stretch` (longest edge over rest length, less one);
        `penetration_m`; `inside`.
    """
    anchor = Anchor(garment, before, body, first - 1)
    i, j = garment.edges.T
    rest = np.linalg.norm(garment.vertices[i].astype(np.float64) - garment.vertices[j], axis=1)
    meshes = BodyMeshes(torch.from_numpy(np.array(body.vertices[first])), torch.from_numpy(np.array(body.faces)))
    found = {name: np.full(len(vertices), np.nan) for name in FIGURES}
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
            found["mean_to_recording_m"][t] = np.linalg.norm(mean - recorded_mean[t])
        found["energy"][t] = 0.5 * anchor.share @ (velocity**2).sum(axis=1)
        found["body_energy"][t] = 0.5 * ((body_velocity - travel) ** 2).sum(axis=1).mean()
        found["stretch"][t] = (np.linalg.norm(now[i] - now[j], axis=1) / rest).max() - 1.0
        meshes.update(torch.from_numpy(np.array(body.vertices[first + t])))
        distance = meshes.query(torch.from_numpy(np.ascontiguousarray(positions, np.float32))).distance.numpy()
        found["penetration_m"][t] = max(0.0, -float(distance.min()))
        found["inside"][t] = (distance < 0).mean()
        previous = now
    found["mean_to_anchor_m"] = np.linalg.norm(places - anchor.mean, axis=1)
    found["mean_drift_m"] = np.linalg.norm(places - np.array_split(places[settled(len(places))], 3)[0].mean(0), axis=1)
    return found


FIGURES = (
    "mean_to_anchor_m", "mean_drift_m", "mean_to_recording_m", "energy", "body_energy", "stretch", "penetration_m",
    "inside",
)  # fmt: skip


def settled(frames: int) -> slice:
    """Frames of a rollout of so many that are not part of its start; all of a short one."""
    return slice(SETTLING if frames > 3 * SETTLING else 0, None)


def energy_growth(found: dict[str, np.ndarray]) -> float:
    """Kinetic energy relative to the body's in the last third of the frames over that in the first third.

    The first two seconds are left out where there is more: a start is not at the speed of the rest.
    """
    counted = settled(len(found["energy"]))
    thirds = [np.array_split(found[name][counted] + STILL, 3) for name in ("energy", "body_energy")]
    first, last = (thirds[0][k].sum() / thirds[1][k].sum() for k in (0, -1))
    return float(last / first)


def judged(found: dict[str, np.ndarray], limits: Limits | None = None) -> dict[str, dict[str, float | bool]]:
    """The verdict: for each limit the value, the limit, and whether it is kept. NaN keeps nothing.

    The mean is compared with the recording where that is known in any frame, else with the anchor, after settling.
    """
    limits = limits or Limits()
    with_recording = np.isfinite(found["mean_to_recording_m"]).any()
    drift = found["mean_drift_m"][settled(len(found["mean_drift_m"]))]
    distance = found["mean_to_recording_m"] if with_recording else drift
    finite = bool(np.isfinite(found["energy"]).all())
    values = {
        "mean_m": np.nanmax(distance) if finite else np.nan,
        "energy_growth": energy_growth(found),
        "stretch": found["stretch"].max(),
        "penetration_m": found["penetration_m"].max(),
        "inside": found["inside"].mean(),
    }
    return {
        name: {"value": float(value), "limit": getattr(limits, name), "kept": bool(value <= getattr(limits, name))}
        for name, value in values.items()
    }


def vertex_areas(garment: Garment) -> np.ndarray:
    """Share of each vertex in the area at rest, which is its share of the mass; [V], sums to one."""
    area = np.asarray(igl.doublearea(garment.vertices.astype(np.float64), garment.faces.astype(np.int64)))
    share = np.bincount(garment.faces.ravel(), np.repeat(area, 3), minlength=len(garment.vertices))
    return share / share.sum()
