"""Garments as cloth particles of a model."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from warpgarment.objects.garment import Garment

from .axes import from_y_up


def add_garment(
    builder: newton.ModelBuilder,
    garment: Garment,
    first_vertices: Any = None,
    *,
    density: float = 0.2,
    particle_radius: float = 0.005,
    color: tuple[float, float, float] | None = None,
) -> None:
    """Adds a garment's vertices and faces to a builder, as particles and triangles in their order.

    Args:
        builder: The builder of a world.
        garment: The garment, Y up, in metres.
        first_vertices: Its positions on the body in its first pose [m], shape [V,3], Y up; None: the rest positions.
        density: Mass per area [kg/m^2], for what else acts on the particles.
        particle_radius: Radius of the particles [m], for other solvers and viewers.
        color: Colour for viewers.
    """
    placed = np.asarray(garment.vertices if first_vertices is None else first_vertices, dtype=np.float32)
    if placed.shape != garment.vertices.shape:
        raise ValueError(f"first_vertices must have shape {list(garment.vertices.shape)}, got {list(placed.shape)}")
    upright: Any = wp.quat_identity()
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=upright,
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*map(float, point)) for point in from_y_up(placed, int(builder.up_axis))],
        indices=garment.faces.reshape(-1).tolist(),
        density=density,
        particle_radius=particle_radius,
        color=color,
        label=garment.name or None,
    )
