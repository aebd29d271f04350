"""The first teacher: Newton's VBD cloth around a moving body, one garment at a time.

The body is a triangle mesh whose points are set and whose tree is refitted every substep. Cloth is simulated in a frame
that moves with the body's smoothed centroid: self-contact caps how far a vertex may move per detection, so a running
garment would otherwise trail behind its body. The frame's acceleration is added to gravity. Air drag always acts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
import warp as wp
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from warpgarment.errors import MissingExtra
from warpgarment.garment import Garment

AIR_DENSITY = wp.constant(1.225)  # kg/m^3


@dataclass(frozen=True)
class ClothSettings:
    """Newton VBD settings that gave clean drapes at 25 to 50 mm edges. SI units.

    Attributes:
        substeps, iterations: Per frame and per substep.
        density: Mass per area [kg/m^2].
        stretch, shear_damping: Membrane stiffness [N/m] (both Lame parameters) and damping.
        bend, bend_damping: Bending stiffness [N m] and damping.
        contact_stiffness, contact_damping, friction: Body contact.
        margin: Thickness added to the body [m].
        contact_gap: Distance at which body contact is looked for [m].
        radius: Particle radius as a share of the edge length; coarse faces let the body poke through otherwise.
        self_margin, self_gap: Self-contact distance and search gap [m].
        drag, lift: Coefficients of the air forces per face.
        settle: Frames simulated in the first pose before the motion starts.
    """

    substeps: int = 10
    iterations: int = 5
    density: float = 0.2
    stretch: float = 1e3
    shear_damping: float = 1e-2
    bend: float = 1e-3
    bend_damping: float = 1e-4
    contact_stiffness: float = 1e4
    contact_damping: float = 0.1
    friction: float = 0.2
    margin: float = 3e-3
    contact_gap: float = 0.03
    radius: float = 0.19
    self_margin: float = 4e-3
    self_gap: float = 12e-3
    drag: float = 1.2
    lift: float = 0.6
    settle: int = 15

    def as_dict(self) -> dict[str, float]:
        """Plain values for a manifest."""
        return asdict(self)


@wp.kernel(enable_backward=False)
def _set_body(
    # In:
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    share: float,
    fps: float,
    origin: wp.vec3,
    origin_velocity: wp.vec3,
    # Out:
    points: wp.array[wp.vec3],
    velocities: wp.array[wp.vec3],
):
    i = wp.tid()
    points[i] = wp.lerp(before[i], after[i], share) - origin
    velocities[i] = (after[i] - before[i]) * fps - origin_velocity


@wp.kernel(enable_backward=False)
def _set_pins(
    # In:
    pin: wp.array[int],
    face: wp.array[int],
    barycentric: wp.array[wp.vec3],
    height: wp.array[float],
    points: wp.array[wp.vec3],
    velocities: wp.array[wp.vec3],
    triangles: wp.array2d[int],
    # Out:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    i = wp.tid()
    a = triangles[face[i], 0]
    b = triangles[face[i], 1]
    c = triangles[face[i], 2]
    w = barycentric[i]
    normal = wp.normalize(wp.cross(points[b] - points[a], points[c] - points[a]))
    position[pin[i]] = w[0] * points[a] + w[1] * points[b] + w[2] * points[c] + height[i] * normal
    velocity[pin[i]] = w[0] * velocities[a] + w[1] * velocities[b] + w[2] * velocities[c]


@wp.kernel(enable_backward=False)
def _air_forces(
    # In:
    triangles: wp.array2d[int],
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    air_velocity: wp.vec3,
    drag: float,
    lift: float,
    # Out:
    force: wp.array[wp.vec3],
):
    t = wp.tid()
    i = triangles[t, 0]
    j = triangles[t, 1]
    k = triangles[t, 2]
    cross = wp.cross(position[j] - position[i], position[k] - position[i])
    area = 0.5 * wp.length(cross)
    wind = air_velocity - (velocity[i] + velocity[j] + velocity[k]) / 3.0
    speed = wp.length(wind)
    if speed < 1.0e-6 or area < 1.0e-12:
        return
    normal = wp.normalize(cross)
    if wp.dot(normal, wind) < 0.0:
        normal = -normal
    cosine = wp.dot(normal, wind) / speed
    across = normal - wind * (cosine / speed)
    pressure = 0.5 * AIR_DENSITY * area * speed * speed
    total = pressure * (drag * cosine * wind / speed + lift * cosine * across)
    wp.atomic_add(force, i, total / 3.0)
    wp.atomic_add(force, j, total / 3.0)
    wp.atomic_add(force, k, total / 3.0)


def simulate(
    garment: Garment,
    edge: float,
    body_frames: np.ndarray,
    body_faces: np.ndarray,
    *,
    fps: float = 30.0,
    settings: ClothSettings | None = None,
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0),
    device: str | None = "cpu",
) -> Iterator[np.ndarray]:
    """Simulates a garment that starts clear of the body in its first frame, one frame per iteration.

    Args:
        garment: Rest mesh, placed on the body's first frame; its pins are tied to the body's surface.
        edge: Typical edge length of the garment [m].
        body_frames: Body vertices [m], shape [T, U, 3], Y up.
        body_faces: Shape [G, 3]; no vertex need be used by a face.
        fps: Frames per second of the body.
        settings: Solver settings.
        wind: Velocity of the air [m/s].
        device: Warp device.

    Yields:
        Garment vertices, float32 [V, 3]: T frames, of which the first is the settled drape. The caller stops early by
        leaving the loop.
    """
    try:
        import newton
    except ImportError as error:
        raise MissingExtra("physics", "Simulating cloth with Newton") from error
    options = settings or ClothSettings()
    used, faces = np.unique(body_faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    frames = np.ascontiguousarray(body_frames[:, used], dtype=np.float32)
    frames = np.concatenate([np.repeat(frames[:1], options.settle + 1, axis=0), frames[1:]])

    model, body_mesh = _build_model(newton, garment, edge, frames[0], faces, options, device)
    solver = newton.solvers.SolverVBD(
        model,
        iterations=options.iterations,
        particle_enable_self_contact=True,
        particle_self_contact_margin=options.self_margin,
        particle_self_contact_gap=options.self_gap,
        friction_epsilon=1e-2,
    )
    collisions = newton.CollisionPipeline(model, soft_contact_gap=options.contact_gap)
    contacts, control = collisions.contacts(), model.control()
    now, later = model.state(), model.state()

    count = len(frames)
    centroid = gaussian_filter1d(frames.mean(1).astype(np.float64), 2.0, axis=0, mode="nearest")
    path = CubicSpline(np.arange(count) + 1.0, centroid)
    substep = 1.0 / options.substeps
    dt = substep / fps

    def origin(at: float) -> np.ndarray:
        return path(np.clip(at, 1.0, count))

    body = [wp.array(f, dtype=wp.vec3, device=device) for f in frames]
    triangles = wp.array(faces, dtype=int, device=device)
    pins = _bind_pins(garment, frames[0], faces, device)
    for state in (now, later):
        state.particle_q.assign((garment.vertices - origin(1.0)).astype(np.float32))

    graphs: dict[int, object] = {}
    for frame in range(count):
        before, after = body[max(frame - 1, 0)], body[frame]
        for step in range(options.substeps):
            at = frame + (step + 1) * substep
            here, last, previous = origin(at), origin(at - substep), origin(at - 2 * substep)
            frame_velocity = (here - last) / dt
            acceleration = (here - 2 * last + previous) / dt**2
            gravity = np.array([0.0, -9.81, 0.0]) - acceleration
            model.gravity.assign(np.tile(gravity.astype(np.float32), (model.gravity.shape[0], 1)))
            wp.launch(
                _set_body,
                dim=len(used),
                inputs=[before, after, (step + 1) * substep, fps, wp.vec3(*here), wp.vec3(*frame_velocity)],
                outputs=[body_mesh.points, body_mesh.velocities],
                device=device,
            )
            body_mesh.refit()
            now.clear_forces()
            if pins:
                wp.launch(
                    _set_pins,
                    dim=len(pins[0]),
                    inputs=[*pins, body_mesh.points, body_mesh.velocities, triangles],
                    outputs=[now.particle_q, now.particle_qd],
                    device=device,
                )
            air = np.asarray(wind, dtype=np.float64) - frame_velocity
            wp.launch(
                _air_forces,
                dim=len(garment.faces),
                inputs=[model.tri_indices, now.particle_q, now.particle_qd, wp.vec3(*air), options.drag, options.lift],
                outputs=[now.particle_f],
                device=device,
            )
            if frame == 0 and step == 0:  # compiles; a graph can only be captured of what is loaded
                collisions.collide(now, contacts)
                solver.step(now, later, control, contacts, dt)
            else:
                if id(now) not in graphs:
                    with wp.ScopedCapture(device=device) as capture:
                        collisions.collide(now, contacts)
                        solver.step(now, later, control, contacts, dt)
                    graphs[id(now)] = capture.graph
                wp.capture_launch(graphs[id(now)])
            now, later = later, now
        vertices = (now.particle_q.numpy() + origin(frame + 1.0)).astype(np.float32)
        if frame >= options.settle:
            yield vertices


def _build_model(newton, garment, edge, body_points, body_faces, options, device):
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*v) for v in garment.vertices.tolist()],
        indices=garment.faces.ravel().tolist(),
        scale=1.0,
        density=options.density,
        particle_radius=options.radius * edge,
        tri_ke=options.stretch,
        tri_ka=options.stretch,
        tri_kd=options.shear_damping,
        edge_ke=options.bend,
        edge_kd=options.bend_damping,
    )
    shape = builder.add_shape_mesh(
        body=-1,
        mesh=newton.Mesh(body_points, body_faces.ravel(), compute_inertia=False),
        cfg=newton.ModelBuilder.ShapeConfig(
            ke=options.contact_stiffness, kd=options.contact_damping, mu=options.friction, margin=options.margin
        ),
    )
    builder.color(include_bending=True)
    model = builder.finalize(device=device)
    model.soft_contact_ke = options.contact_stiffness
    model.soft_contact_kd = options.contact_damping
    model.soft_contact_mu = options.friction
    if len(garment.pins):
        flags = model.particle_flags.numpy()
        flags[garment.pins] &= ~int(newton.ParticleFlags.ACTIVE)
        model.particle_flags = wp.array(flags, device=device)
    for box, by in ((model.shape_collision_aabb_lower, -5.0), (model.shape_collision_aabb_upper, 5.0)):
        grown = box.numpy()  # contacts are culled against the first pose otherwise
        grown[shape] += by
        box.assign(grown)
    return model, model.shape_source[shape].mesh


def _bind_pins(garment: Garment, body_points: np.ndarray, body_faces: np.ndarray, device) -> list[wp.array]:
    """Nearest face, barycentric coordinates and height above it for each pin; empty without pins."""
    if not len(garment.pins):
        return []
    import igl

    points = garment.vertices[garment.pins].astype(np.float64)
    triangles = body_points.astype(np.float64)[body_faces]
    _, face, closest = igl.point_mesh_squared_distance(
        points, body_points.astype(np.float64), body_faces.astype(np.int64)
    )
    corners = triangles[face]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = ((points - closest) * normal).sum(1)
    foot = points - normal * height[:, None]
    weights = np.asarray(igl.barycentric_coordinates(foot, corners[:, 0], corners[:, 1], corners[:, 2])).reshape(-1, 3)
    return [
        wp.array(garment.pins.astype(np.int32), dtype=int, device=device),
        wp.array(np.asarray(face, dtype=np.int32), dtype=int, device=device),
        wp.array(weights.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(height.astype(np.float32), dtype=float, device=device),
    ]
