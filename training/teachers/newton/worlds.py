"""Several cloth scenes as worlds of one Newton model, and all data that are written into it during the simulation.

Arrays are packed over worlds: bodies end to end, cloths end to end. Each body is a mesh of its own whose points are a
slice of one array, so that one launch moves all bodies; each mesh then needs a refit of its own. Only the number of
these launches grows with the number of worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpgarment.training.teachers import ClothScene, Moving
from warpgarment.training.teachers.scenes import MovingFrame, bound_to_body, start_of, used_body

from .kernels import set_bodies_kernel, set_pins_kernel
from .settings import _mean_friction, layer_friction

if TYPE_CHECKING:
    from .settings import NewtonSettings

REACH = 5.0  # distance from a body's first pose within which contact with the body is detected [m]


class Worlds:
    """Scenes of equal frame rate, settling time and friction between layers, side by side in one model.

    Args:
        newton: The module `newton`.
        scenes: Scenes, one per world.
        settings: Settings of the teacher.
        device: Warp device.

    Attributes:
        model: Newton's model.
        starts: First particle of each world, and the number of particles, int [W + 1].
        gravity: Current gravity of each world [m/s^2], vec3 [W], a view of the uploaded values.
        air: Current velocity of the air in each world [m/s], vec3 [W], a view of the uploaded values.
    """

    def __init__(self, newton: Any, scenes: Sequence[ClothScene], settings: NewtonSettings, device: wp.Device):
        self.scenes, self.device, self._substeps = list(scenes), device, settings.substeps
        self._settle, self._fps = scenes[0].settle, scenes[0].fps
        bodies = [used_body(scene) for scene in scenes]
        self._bodies = [frames for frames, _ in bodies]
        self._frames = [MovingFrame(frames, scene.settle) for (frames, _), scene in zip(bodies, scenes, strict=True)]
        self.starts = np.cumsum([0] + [int(scene.starts[-1]) for scene in scenes])
        body_starts = np.cumsum([0] + [frames.shape[1] for frames in self._bodies])

        root = newton.ModelBuilder(up_axis=newton.Axis.Y)
        groups: list[list[np.ndarray]] = []
        shapes: dict[int, Any] = {}
        for w, (scene, (frames, faces)) in enumerate(zip(scenes, bodies, strict=True)):
            builder, mesh = _world(newton, scene, frames[0], faces, settings)
            if mesh is not None:
                shapes[w] = mesh
            for color, group in enumerate(builder.particle_color_groups):
                while len(groups) <= color:
                    groups.append([])
                groups[color].append(np.asarray(group) + self.starts[w])
            root.add_world(builder)
        # Newton would merge small colors of one world with large ones of another. The order within a world, and with
        # it the result, must not depend on other worlds.
        root.set_coloring([np.concatenate(group) for group in groups])
        self.model = model = root.finalize(device=device)
        model.soft_contact_ke, model.soft_contact_kd = settings.contact_stiffness, settings.contact_damping
        model.soft_contact_mu = layer_friction(scenes[0], settings)
        for box, by in ((model.shape_collision_aabb_lower, -REACH), (model.shape_collision_aabb_upper, REACH)):
            if shapes:
                box.assign(box.numpy() + np.float32(by))  # otherwise contacts are culled against the first pose

        count = int(body_starts[-1])
        with wp.ScopedDevice(device):
            self._before, self._after = (wp.zeros(count, dtype=wp.vec3) for _ in range(2))
            self._points, self._velocities = (wp.zeros(count, dtype=wp.vec3) for _ in range(2))
            self._body_world: wp.array = wp.array(np.repeat(np.arange(len(scenes)), np.diff(body_starts)), dtype=int)
            rows = len(scenes) * self._substeps
            self._origin, self._origin_velocity, self._gravity, self._air = (
                wp.zeros(rows, dtype=wp.vec3) for _ in range(4)
            )
            self._pins = self._bound_pins(newton, bodies, body_starts)
        self._points.assign(np.concatenate([frames[0] for frames in self._bodies]))
        self._meshes = []
        for w, source in shapes.items():
            mesh, part = source.mesh, slice(int(body_starts[w]), int(body_starts[w + 1]))
            mesh.points, mesh.velocities = self._points[part], self._velocities[part]
            self._meshes.append(mesh)

    @property
    def has_bodies(self) -> bool:
        """Whether any world has a body."""
        return bool(self._meshes)

    def place(self, *states: Any) -> None:
        """Writes the start of the cloths into states of the model. The moving coordinates are at rest then."""
        begin = start_of(self.scenes)
        shifts = [frame.origin(1.0) for frame in self._frames]
        parts = [(one.vertices - shift).astype(np.float32) for one, shift in zip(begin, shifts, strict=True)]
        for state in states:
            state.particle_q.assign(np.concatenate(parts))
            state.particle_qd.assign(np.concatenate([one.velocities for one in begin]))

    def begin_frame(self, frame: int) -> None:
        """Uploads the motion of bodies, moving coordinates and winds during a frame of the simulation."""
        self._before, self._after = self._after, self._before
        shown = [self._body_at(frames, frame) for frames in self._bodies]
        self._after.assign(np.concatenate(shown))
        if frame == 0:
            self._before.assign(np.concatenate(shown))
        share = 1.0 / self._substeps
        dt = share / self._fps
        at = frame + (np.arange(self._substeps) + 1) * share
        rows: dict[str, list[np.ndarray]] = {name: [] for name in ("origin", "velocity", "gravity", "air")}
        for scene, path in zip(self.scenes, self._frames, strict=True):
            here, last, previous = (path.origin(at - back * share) for back in range(3))
            velocity = (here - last) / dt
            rows["origin"].append(here)
            rows["velocity"].append(velocity)
            rows["gravity"].append(np.asarray(scene.gravity) - (here - 2 * last + previous) / dt**2)
            rows["air"].append(self._wind(scene, frame, at - frame) - velocity)
        for name, target in (
            ("origin", self._origin),
            ("velocity", self._origin_velocity),
            ("gravity", self._gravity),
            ("air", self._air),
        ):
            target.assign(np.stack(rows[name], 1).reshape(-1, 3).astype(np.float32))

    def begin_substep(self, step: int, state: Any) -> wp.array:
        """Moves bodies and pins to the end of a substep; returns the velocity of the air in each world [m/s]."""
        worlds = len(self.scenes)
        part = slice(step * worlds, (step + 1) * worlds)
        wp.copy(self.model.gravity, self._gravity, src_offset=step * worlds, count=worlds)
        if self._meshes:
            share = (step + 1) * (1.0 / self._substeps)
            wp.launch(
                set_bodies_kernel,
                dim=len(self._points),
                inputs=[self._before, self._after, self._body_world, share, self._fps]
                + [self._origin[part], self._origin_velocity[part]],
                outputs=[self._points, self._velocities],
                device=self.device,
            )
        for mesh in self._meshes:
            mesh.refit()  # Warp silently skips this inside a captured CPU graph
        self._place_pins(state)
        return self._air[part]

    def _place_pins(self, state: Any) -> None:
        """Writes the positions and velocities of the pins that are tied to bodies."""
        if self._pins:
            wp.launch(
                set_pins_kernel,
                dim=len(self._pins[0]),
                inputs=[*self._pins, self._points, self._velocities],
                outputs=[state.particle_q, state.particle_qd],
                device=self.device,
            )

    def end_frame(self, frame: int, state: Any) -> list[Moving]:
        """Vertices [m] and velocities [m/s] of each world at the end of a frame; those of the last substep."""
        self._place_pins(state)  # the solver leaves pins where they are, but without their velocities
        points, speeds = state.particle_q.numpy(), state.particle_qd.numpy()
        origin_velocities = self._origin_velocity.numpy()[-len(self.scenes) :]
        worlds = []
        for w, path in enumerate(self._frames):
            part = slice(self.starts[w], self.starts[w + 1])
            vertices = (points[part] + path.origin(frame + 1.0)).astype(np.float32)
            worlds.append(Moving(vertices, speeds[part] + origin_velocities[w]))
        return worlds

    def put_aside(self, world: int, *states: Any) -> None:
        """Removes a world that has become NaN from the simulation: its particles rest at their start positions."""
        part = slice(int(self.starts[world]), int(self.starts[world + 1]))
        flags = self.model.particle_flags.numpy()
        flags[part] = 0
        self.model.particle_flags.assign(flags)
        first = np.concatenate([cloth.first for cloth in self.scenes[world].cloths])
        for state in states:
            for array, value in ((state.particle_q, first - self._frames[world].origin(1.0)), (state.particle_qd, 0.0)):
                held = array.numpy()
                held[part] = value
                array.assign(held)

    def _body_at(self, frames: np.ndarray, frame: int) -> np.ndarray:
        """Body vertices in a frame [m], [U, 3]; a body stands still before its first frame and after its last."""
        return frames[np.clip(frame - self._settle, 0, len(frames) - 1)]

    def _wind(self, scene: ClothScene, frame: int, share: np.ndarray) -> np.ndarray:
        """Velocity of the air at shares of the time between the previous frame and this one [m/s], [S, 3]."""
        if scene.wind is None:
            return np.zeros((len(share), 3))
        wind = np.asarray(scene.wind, dtype=np.float64)
        before, after = (wind[np.clip(f - self._settle, 0, len(wind) - 1)] for f in (frame - 1, frame))
        return before + (after - before) * share[:, None]

    def _bound_pins(self, newton: Any, bodies: list, body_starts: np.ndarray) -> list[wp.array]:
        """Clears the flag of every pinned particle; returns the arrays that tie pinned particles to bodies."""
        flags = self.model.particle_flags.numpy()
        parts: list[tuple[np.ndarray, ...]] = []
        for w, (scene, (frames, faces)) in enumerate(zip(self.scenes, bodies, strict=True)):
            for cloth, start in zip(scene.cloths, scene.starts[:-1] + self.starts[w], strict=True):
                pins = cloth.garment.pins
                if not len(pins):
                    continue
                flags[pins + start] &= ~int(newton.ParticleFlags.ACTIVE)
                if len(faces):
                    face, weights, height = bound_to_body(np.asarray(cloth.first)[pins], frames[0], faces)
                    parts.append((pins + start, faces[face] + body_starts[w], weights, height))
        self.model.particle_flags.assign(flags)
        if not parts:
            return []
        pin, corner, weights, height = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return [
            wp.array(pin.astype(np.int32), dtype=int),
            wp.array(corner.astype(np.int32), dtype=wp.vec3i),
            wp.array(weights.astype(np.float32), dtype=wp.vec3),
            wp.array(height.astype(np.float32), dtype=float),
        ]


def _world(
    newton: Any, scene: ClothScene, body_points: np.ndarray, body_faces: np.ndarray, settings: NewtonSettings
) -> tuple[Any, Any]:
    """A builder that holds a scene, colored; and its body's mesh, None without a body."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    for cloth in scene.cloths:
        material = cloth.material
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0, 0.0, 0.0),
            rot=wp.quat_identity(),
            vel=wp.vec3(0.0, 0.0, 0.0),
            vertices=[wp.vec3(*v) for v in cloth.garment.vertices.tolist()],
            indices=cloth.garment.faces.ravel().tolist(),
            scale=1.0,
            density=material.density,
            particle_radius=settings.radius * cloth.edge,
            tri_ke=material.shear,
            tri_ka=material.stretch,
            tri_kd=material.damping * material.shear,
            edge_ke=material.bend,
            edge_kd=settings.bend_damping,
        )
    mesh = None
    if len(body_faces):
        # meshes with velocities are never merged, even if two bodies are alike in their first pose
        mesh = newton.Mesh(body_points, body_faces.ravel(), compute_inertia=False, enable_surface_velocity=True)
        # Newton takes the geometric mean of the cloths' coefficient and the shape's
        friction = _mean_friction(scene) ** 2 / max(layer_friction(scene, settings), 1e-9)
        contact = newton.ModelBuilder.ShapeConfig(
            ke=settings.contact_stiffness, kd=settings.contact_damping, mu=friction, margin=settings.margin
        )
        builder.add_shape_mesh(body=-1, mesh=mesh, cfg=contact)
    builder.color(include_bending=True)
    return builder, mesh
