"""The Newton teacher: VBD cloth around moving bodies, one scene at a time or many worlds in one model.

A body is a triangle mesh whose points are set and whose tree is refitted every substep. Cloth is simulated in
coordinates that move with the body's smoothed centroid: self-contact limits the motion of a vertex to
0.425 (self_margin + self_gap) per detection, with two detections per substep, so that the garment of a runner would
otherwise trail behind the body. The acceleration of the coordinates is added to gravity, and their velocity is
subtracted from the wind. Their path depends on the whole motion: a longer clip gives other bits. Air drag acts in still
air, too; set `drag` and `lift` to 0 for a vacuum.

VBD stops before it has converged. With 10 substeps of 5 iterations a strip 0.6 m long hangs 0.9 % (34 mm edges) to
1.3 % (27 mm) too long, with 10 x 10 half of that, with 20 x 10 0.15 %, for any material: smaller differences in stretch
are not visible. `CONVERGED` is accurate for the small and soft sheets of :mod:`.checks`, at four times the cost.

Contact between layers is Newton's self-contact, which does not distinguish the cloths of particles. It keeps layers
`self_margin` apart if they start apart: rest meshes may lie anywhere, but in the start positions layers must not cross,
and the inner one must be at least 6 mm and outer ones at least 22 mm away from the body.

Friction against the body is one number per scene, the mean over the materials of its cloths. Friction between cloths is
that number, too, or `layer_friction`: Newton has one number for a whole model, so worlds in one model must share it.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import warp as wp

from warpgarment.errors import MissingExtra, UsageError
from warpgarment.kernels.wind import add_air_forces
from warpgarment.training.teachers import ClothScene, Moving
from warpgarment.training.teachers.scenes import check_scenes, side_by_side, start_of

from .settings import NewtonSettings, layer_friction
from .worlds import Worlds

LAYER_FRICTION = 0.2  # between cloths: Newton has one coefficient for all worlds it simulates at once


class NewtonTeacher:
    """Simulates cloth with Newton's VBD solver (extra `physics`).

    On a CPU equal scenes give equal bits. Beside other worlds they do so, too, until cloth touches cloth: the order in
    which Newton sums contact forces depends on a world's place in the model, which causes rounding differences (below
    1e-6 m in the first frames of a contact) that grow as all differences do in cloth. A GPU sums in any order.

    Args:
        settings: Settings of the solver; None for the defaults.
        device: Warp device, such as "cpu" or "cuda:0"; None for Warp's default.

    Raises:
        MissingExtra: Newton is not installed.
        UsageError: Warp has no such device.
    """

    name = "newton"

    def __init__(self, settings: NewtonSettings | None = None, device: str | None = "cpu"):
        try:
            import newton
        except ImportError as error:
            raise MissingExtra("physics", "Simulating cloth with Newton") from error
        there = [one.alias for one in wp.get_devices()]  # asking for one that is not there prints the driver's errors
        known = device is None or device in there or (device == "cuda" and len(there) > 1)
        if not known:
            raise UsageError(f"there is no device {device!r} to simulate on. Warp sees {', '.join(there)}.")
        self._newton, self._settings, self._device = newton, settings or NewtonSettings(), device

    def settings(self) -> dict[str, Any]:
        """Settings and versions, as plain values."""
        versions = {name: importlib.metadata.version(name) for name in ("newton", "warp-lang")}
        return {"teacher": self.name, **versions, **asdict(self._settings)}

    def simulate(self, scene: ClothScene) -> Iterator[np.ndarray]:
        """Yields T frames, float32 [V, 3], cloths end to end; the first is the settled drape.

        A scene that becomes NaN yields NaN from then on.

        Raises:
            TeacherError: The scene cannot be simulated; the message has the reason.
        """
        check_scenes([scene])
        for (frame,) in self._run([scene]):
            yield frame.vertices

    def simulate_many(self, scenes: Sequence[ClothScene]) -> Iterator[list[np.ndarray | None]]:
        """Simulates several scenes at once, each in a world of its own.

        Scenes with equal frame rate, settling time and friction between cloths (see `NewtonSettings.layer_friction`)
        are the worlds of one model, with one set of launches for all of them, except for the refit of each body; other
        scenes are simulated in models of their own. A world is simulated until the longest one in its model ends, so
        scenes should be of similar length.

        Yields:
            For every frame, the vertices of each scene [m], float32 [V, 3], or None once a scene has ended.

        Raises:
            TeacherError: A scene cannot be simulated; the message has its number and the reason.
        """
        for worlds in self.simulate_moving(scenes):
            yield [None if frame is None else frame.vertices for frame in worlds]

    def simulate_moving(self, scenes: Sequence[ClothScene]) -> Iterator[list[Moving | None]]:
        """As :meth:`simulate_many`, with velocities: those of the last substep, from which the next one starts."""
        check_scenes(scenes)

        def model(scene: ClothScene) -> tuple[float, int, bool, float]:
            return scene.fps, scene.settle, scene.goes_on, layer_friction(scene, self._settings)

        return side_by_side(scenes, model, self._run)

    def _run(self, scenes: list[ClothScene]) -> Iterator[list[Moving]]:
        """Frames of scenes that fit one model, until the longest ends."""
        newton, options, device = self._newton, self._settings, wp.get_device(self._device)
        worlds = Worlds(newton, scenes, options, device)
        model = worlds.model
        solver = newton.solvers.SolverVBD(
            model,
            iterations=options.iterations,
            particle_enable_self_contact=True,
            particle_self_contact_margin=options.self_margin,
            particle_self_contact_gap=options.self_gap,
            friction_epsilon=1e-2,
        )
        collisions = contacts = None
        if worlds.has_bodies:
            collisions = newton.CollisionPipeline(model, soft_contact_gap=options.contact_gap)
            contacts = collisions.contacts()
        control = model.control()
        now, later = model.state(), model.state()
        worlds.place(now, later)
        if any(cloth.start is not None for scene in scenes for cloth in scene.cloths):
            solver.rebuild_bvh(now)  # the solver's tree was built over the rest meshes
        dt = 1.0 / options.substeps / scenes[0].fps
        settle = scenes[0].settle

        def advance() -> None:
            if collisions is not None:
                collisions.collide(now, contacts)
            solver.step(now, later, control, contacts, dt)

        graphs: dict[int, Any] = {}
        aside: set[int] = set()
        begun = 0
        if scenes[0].goes_on:
            worlds.begin_frame(0)
            begun = 1
            yield start_of(scenes)
        for frame in range(begun, settle + max(map(len, scenes))):
            worlds.begin_frame(frame)
            for step in range(options.substeps):
                now.clear_forces()
                air = worlds.begin_substep(step, now)
                if options.drag or options.lift:
                    add_air_forces(
                        model.tri_indices,
                        now.particle_q,
                        now.particle_qd,
                        model.particle_world,
                        air,
                        now.particle_f,
                        drag=options.drag,
                        lift=options.lift,
                    )
                if frame == begun and step == 0:  # compiles the kernels; only loaded kernels can be captured in a graph
                    advance()
                else:
                    if id(now) not in graphs:
                        with wp.ScopedCapture(device=device) as capture:
                            advance()
                        graphs[id(now)] = capture.graph
                    wp.capture_launch(graphs[id(now)])
                now, later = later, now
            moving = worlds.end_frame(frame, now)
            for w, (vertices, velocities) in enumerate(moving):
                if w not in aside and not np.isfinite(vertices).all():
                    aside.add(w)
                    worlds.put_aside(w, now, later)
                if w in aside:
                    moving[w] = Moving(np.full_like(vertices, np.nan), np.full_like(velocities, np.nan))
            if frame >= settle:
                yield moving


def make(device: str | None) -> NewtonTeacher:
    """The teacher as `generate` uses it; see `teachers.make_teacher`."""
    return NewtonTeacher(NewtonSettings(layer_friction=LAYER_FRICTION), device=device)
