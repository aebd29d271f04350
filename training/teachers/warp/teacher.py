"""The Warp teacher: implicit steps of the project's own cloth (`warpgarment.kernels.physics`)."""

from __future__ import annotations

import importlib.metadata
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
import warp as wp

from warpgarment.errors import UsageError
from warpgarment.kernels.launch import as_warp, torch_stream
from warpgarment.kernels.physics import ImplicitSolver, PhysicsCloth, Sheet
from warpgarment.kernels.physics.planes import pressed, touch
from warpgarment.kernels.wind import add_air_forces
from warpgarment.training.teachers import ClothScene, Moving
from warpgarment.training.teachers.scenes import check_scenes, side_by_side, start_of

from .bodies import MovingBodies
from .meeting import meeting_of
from .settings import WarpSettings


class WarpTeacher:
    """Simulates cloth with implicit steps that converge.

    On a CPU equal scenes give equal bits.

    Args:
        settings: Settings; None for the defaults.
        device: Torch device, such as "cpu" or "cuda:0"; None for the CPU.

    Raises:
        UsageError: There is no such device.
    """

    name = "warp"

    def __init__(self, settings: WarpSettings | None = None, device: str | None = "cpu") -> None:
        self._settings = settings or WarpSettings()
        self._device = torch.device(device or "cpu")
        if self._device.type == "cuda" and not torch.cuda.is_available():
            raise UsageError(f"there is no device {device!r} to simulate on. Torch sees the CPU only.")

    def settings(self) -> dict[str, Any]:
        """Settings and versions, as plain values."""
        versions = {name: importlib.metadata.version(name) for name in ("warp-lang",)}
        return {"teacher": self.name, **versions, **asdict(self._settings)}

    def simulate(self, scene: ClothScene) -> Iterator[np.ndarray]:
        """Yields T frames, float32 [V, 3], cloths end to end; the first is the settled drape.

        Raises:
            TeacherError: The scene cannot be simulated; the message has the reason.
        """
        check_scenes([scene])
        for (frame,) in self._run([scene]):
            yield frame.vertices

    def simulate_many(self, scenes: Sequence[ClothScene]) -> Iterator[list[np.ndarray | None]]:
        """Simulates several scenes at once; those of equal frame rate and settling time in one batch.

        Yields:
            For every frame, the vertices of each scene [m], float32 [V, 3], or None once a scene has ended.

        Raises:
            TeacherError: A scene cannot be simulated; the message has its number and the reason.
        """
        for shown in self.simulate_moving(scenes):
            yield [None if frame is None else frame.vertices for frame in shown]

    def simulate_moving(self, scenes: Sequence[ClothScene]) -> Iterator[list[Moving | None]]:
        """As :meth:`simulate_many`, with velocities: those from which the next step starts."""
        check_scenes(scenes)
        return side_by_side(scenes, lambda scene: (scene.fps, scene.settle, scene.goes_on), self._run)

    def _run(self, scenes: list[ClothScene]) -> Iterator[list[Moving]]:
        """Frames of scenes of equal frame rate and settling time that all go on, or do not, until the longest ends."""
        options, device = self._settings, self._device
        starts = np.cumsum([0] + [int(scene.starts[-1]) for scene in scenes])
        step = 1.0 / scenes[0].fps / options.substeps
        cloth, held, keep, friction = _cloth(scenes, starts, options, device)
        scene_of_vertex = np.repeat(np.arange(len(scenes)), np.diff(starts))
        bodies = MovingBodies(scenes, scene_of_vertex, keep, options.contact_gap, device)
        first = np.concatenate([c.first for scene in scenes for c in scene.cloths])
        points = torch.from_numpy(first).to(device).double()
        meeting = meeting_of(scenes, cloth.faces, points, options.self_margin) if options.self_contact else None
        solver = ImplicitSolver(
            cloth,
            inertia=(1.0 if options.scheme == "euler" else 2.25) / step**2,
            iterations=options.iterations,
            held=held,
            contact=options.contact_stiffness,
            slip=options.slip * step,
            memory=options.memory,
            tolerance=options.tolerance,
            damping_step=step,
            keep_pairs=True,
            pairs=meeting.contacts if meeting else None,
            pair_distance=options.self_margin,
            pair_stiffness=options.self_stiffness,
            pair_friction=torch.from_numpy(friction[cloth.faces[:, 0].cpu().numpy()]).to(device),
        )
        motion = _Motion(points, options.scheme, step)
        air = _Air(cloth, scene_of_vertex, options, device)
        gravity = torch.tensor(np.stack([s.gravity for s in scenes])[scene_of_vertex], device=device).double()
        still = torch.from_numpy(held).to(device)[:, None]
        coefficient = torch.from_numpy(friction).to(device)
        settle, begun = scenes[0].settle, 0
        if scenes[0].goes_on:
            moving, begun = start_of(scenes), 1
            motion.velocity = torch.from_numpy(np.concatenate([one.velocities for one in moving])).to(device).double()
            if bodies.any:  # the first step takes the pressure from here
                touch(solver, bodies.planes(points, 1.0, 1.0 / options.substeps))
            yield moving
        for frame in range(begun, settle + max(map(len, scenes))):
            bodies.begin_frame(frame)
            for number in range(options.substeps):
                share = (number + 1) / options.substeps
                wind = np.stack([_wind(scene, frame, share) for scene in scenes])
                points, speed = motion.points, motion.velocity
                acceleration = gravity + air.acceleration(points, speed, wind)
                target = motion.target(acceleration)
                guess = motion.guess()
                pinned, held_at = bodies.pins(share)
                target, guess = (torch.where(still, points, wanted) for wanted in (target, guess))
                target[pinned], guess[pinned] = held_at, held_at
                if bodies.any:
                    planes = bodies.planes(guess, share, 1.0 / options.substeps)
                    solver.friction.copy_(coefficient * pressed(solver, points))
                    touch(solver, planes)
                    solver.anchor.copy_(points + planes.way)
                solver.target.copy_(target)
                solver.positions.copy_(points)
                solver.remember()
                solver.positions.copy_(guess)
                if meeting:
                    meeting.find(points, guess)
                end = solver.solve()
                motion.advance(meeting.safe(end) if meeting else end.clone())
            if frame >= settle:
                at, going = (t.float().cpu().numpy() for t in (motion.points, motion.velocity))
                yield [Moving(at[a:b], going[a:b]) for a, b in itertools.pairwise(starts)]


class _Motion:
    """Positions and velocities of a scheme of time integration; see solver.py."""

    def __init__(self, points: torch.Tensor, scheme: str, step: float) -> None:
        self.points, self.velocity, self._step = points, torch.zeros_like(points), step
        self._second = scheme == "bdf2"
        self._before: tuple[torch.Tensor, torch.Tensor] | None = None

    def target(self, acceleration: torch.Tensor) -> torch.Tensor:
        h = self._step
        if not self._second:
            return self.points + h * self.velocity + h * h * acceleration
        earlier, slower = self._before or (self.points, self.velocity)
        return (
            (4.0 * self.points - earlier) / 3.0
            + (h / 9.0) * (8.0 * self.velocity - 2.0 * slower)
            + (4.0 * h * h / 9.0) * acceleration
        )

    def guess(self) -> torch.Tensor:
        return self.points + self._step * self.velocity

    def advance(self, points: torch.Tensor) -> None:
        now = points
        if self._second:
            earlier = self._before[0] if self._before else self.points
            velocity = (3.0 * now - 4.0 * self.points + earlier) / (2.0 * self._step)
        else:
            velocity = (now - self.points) / self._step
        self._before = (self.points, self.velocity)
        self.points, self.velocity = now, velocity


class _Air:
    """Acceleration by the air."""

    def __init__(
        self, cloth: PhysicsCloth, scene_of_vertex: np.ndarray, options: WarpSettings, device: torch.device
    ) -> None:
        self._cloth, self._device, self._options = cloth, device, options
        self._world = torch.from_numpy(scene_of_vertex.astype(np.int32)).to(device)
        self._mass = cloth.mass[:, None].clamp(min=1e-12)

    def acceleration(self, points: torch.Tensor, velocity: torch.Tensor, wind: np.ndarray) -> torch.Tensor:
        if not (self._options.drag or self._options.lift):
            return torch.zeros_like(points)
        force = torch.zeros(points.shape, dtype=torch.float32, device=self._device)
        air = torch.from_numpy(wind.astype(np.float32)).to(self._device)
        with torch_stream(self._device):
            add_air_forces(
                as_warp(self._cloth.faces, wp.int32),
                as_warp(points.float(), wp.vec3),
                as_warp(velocity.float(), wp.vec3),
                as_warp(self._world, wp.int32),
                as_warp(air, wp.vec3),
                as_warp(force, wp.vec3),
                drag=self._options.drag,
                lift=self._options.lift,
            )
        return force.double() / self._mass


def _wind(scene: ClothScene, frame: int, share: float) -> np.ndarray:
    """Velocity of the air at a share of the time between the previous frame and this one [m/s], [3]."""
    if scene.wind is None:
        return np.zeros(3)
    wind = np.asarray(scene.wind, dtype=np.float64)
    before, after = (wind[np.clip(f - scene.settle, 0, len(wind) - 1)] for f in (frame - 1, frame))
    return before + (after - before) * share


def _cloth(
    scenes: list[ClothScene], starts: np.ndarray, options: WarpSettings, device: torch.device
) -> tuple[PhysicsCloth, np.ndarray, np.ndarray, np.ndarray]:
    """Physics of all cloths; which vertices are pinned, distances to keep from bodies [m] and friction, each [V]."""
    sheets, rest, faces, owner = [], [], [], []
    held, keep, friction = (np.zeros(starts[-1], dtype) for dtype in (bool, float, float))
    first = 0
    for scene in scenes:
        for cloth in scene.cloths:
            garment, material = cloth.garment, cloth.material
            part = slice(first, first + len(garment.vertices))
            held[garment.pins + first] = True
            keep[part] = options.margin + options.radius * cloth.edge
            friction[part] = material.friction
            sheets.append(
                Sheet.isotropic(
                    material.density,
                    material.stretch,
                    material.shear,
                    material.bend,
                    material.damping,
                    options.bend_damping,
                )
            )
            rest.append(garment.vertices)
            faces.append(garment.faces + first)
            owner.append(np.full(len(garment.faces), len(sheets) - 1))
            first = part.stop
    packed = PhysicsCloth.build(
        np.concatenate(rest), np.concatenate(faces), starts, sheets, np.concatenate(owner), device
    )
    return packed, held, keep, friction


def make(device: str | None) -> WarpTeacher:
    """The teacher as `generate` uses it; see `teachers.make_teacher`."""
    return WarpTeacher(device=device)
