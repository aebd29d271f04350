"""Force of the air on cloth: drag along the relative wind and lift across it, per face, gathered on the vertices.

Each face is a flat plate that the air meets under the angle θ between its normal and the wind. Both forces grow with
the area it shows to the wind, A cos θ (Keckeisen, Kimmerle, Thomaszewski and Wacker 2004, "Modelling Effects of Wind
Fields in Cloth Animations"; lift taken along the component of the normal across the wind, so that its length is sin θ):

    w = u − (v_i + v_j + v_k) / 3,    ŵ = w / |w|,    cos θ = n·ŵ,    n turned so that cos θ ≥ 0
    f = ½ ρ A |w|² (C_D cos θ ŵ + C_L cos θ (n − cos θ ŵ)),    a third of it on each corner

    | symbol   | code                          | what                                                            |
    | -------- | ----------------------------- | --------------------------------------------------------------- |
    | u        | air                           | velocity of the air [m/s], one per world                        |
    | v        | velocities                    | velocities of the vertices [m/s]                                |
    | ρ        | density                       | density of the air [kg/m^3]                                     |
    | A, n     | area, normal                  | current area of the face [m^2], its unit normal                 |
    | C_D, C_L | drag, lift                    | coefficients; C_D is 1.2 for a plate met head-on                |
    | f        | force                         | force on the face [N]                                           |

For wind head-on, f = ½ ρ C_D A |w|² ŵ. For wind along the face, and for a face at rest relative to the air, f = 0.
Front and back of a face count alike. The coefficients do not depend on the angle in any other way, faces do not shelter
each other, and the cloth does not move the air.
"""

from __future__ import annotations

import torch
import warp as wp

from . import compiling
from .launch import as_warp, expect, torch_stream
from .operator import allocate

wp.set_module_options(compiling.options())

AIR_DENSITY = 1.225
"""Density of air at sea level and 15 °C [kg/m^3]."""
DRAG, LIFT = 1.2, 0.6
"""Default coefficients of drag and lift, without unit."""

SLOWEST = wp.constant(1.0e-6)  # m/s; a slower wind has no direction
SMALLEST = wp.constant(1.0e-12)  # m^2; a smaller face has no normal


@wp.func
def plate_force(cross: wp.vec3, wind: wp.vec3, density: float, drag: float, lift: float):
    """Force on a face [N]; `cross` is the cross product of two of its edges [m^2]."""
    area = 0.5 * wp.length(cross)
    speed = wp.length(wind)
    if speed < SLOWEST or area < SMALLEST:
        return wp.vec3(0.0)
    normal = wp.normalize(cross)
    if wp.dot(normal, wind) < 0.0:
        normal = -normal
    cosine = wp.dot(normal, wind) / speed
    across = normal - wind * (cosine / speed)
    pressure = 0.5 * density * area * speed * speed
    return pressure * (drag * cosine * wind / speed + lift * cosine * across)


@wp.kernel(enable_backward=False)
def air_force_kernel(
    # In:
    faces: wp.array2d[wp.int32],
    vertices: wp.array[wp.vec3],
    velocities: wp.array[wp.vec3],
    world: wp.array[wp.int32],
    air: wp.array[wp.vec3],
    density: float,
    drag: float,
    lift: float,
    # Out:
    force: wp.array[wp.vec3],  # accumulated
):
    t = wp.tid()
    i = faces[t, 0]
    j = faces[t, 1]
    k = faces[t, 2]
    cross = wp.cross(vertices[j] - vertices[i], vertices[k] - vertices[i])
    wind = air[world[i]] - (velocities[i] + velocities[j] + velocities[k]) / 3.0
    total = plate_force(cross, wind, density, drag, lift)
    wp.atomic_add(force, i, total / 3.0)
    wp.atomic_add(force, j, total / 3.0)
    wp.atomic_add(force, k, total / 3.0)


def add_air_forces(
    faces: wp.array,
    vertices: wp.array,
    velocities: wp.array,
    world: wp.array,
    air: wp.array,
    force: wp.array,
    *,
    drag: float = DRAG,
    lift: float = LIFT,
    density: float = AIR_DENSITY,
) -> None:
    """Adds the force of the air to the forces that a simulation holds in a Warp array; checks and copies nothing.

    Args:
        faces: Vertex indices, int32 [F, 3].
        vertices: Vertex positions [m], vec3 [V].
        velocities: Vertex velocities [m/s], vec3 [V].
        world: World of each vertex, int32 [V]; a face is in the world of its first vertex.
        air: Velocity of the air in each world [m/s], vec3 [W].
        force: Forces on the vertices, to which those of the air are added [N], vec3 [V].
        drag, lift: Coefficients of drag and lift, without unit.
        density: Density of the air [kg/m^3].
    """
    if not faces.shape[0]:
        return
    inputs = [faces, vertices, velocities, world, air, density, drag, lift]
    wp.launch(air_force_kernel, dim=faces.shape[0], inputs=inputs, outputs=[force], device=force.device)


def air_forces(
    vertices: torch.Tensor,
    velocities: torch.Tensor,
    faces: torch.Tensor,
    air: torch.Tensor,
    *,
    world: torch.Tensor | None = None,
    drag: float = DRAG,
    lift: float = LIFT,
    density: float = AIR_DENSITY,
) -> torch.Tensor:
    """Force of the air on every vertex of a packed batch of garments; without gradients.

    On a CPU the forces at a vertex are summed in a fixed order, so that equal inputs give equal bits; on a GPU the
    order varies. The checks of indices wait for a GPU.

    Args:
        vertices: Vertex positions [m], float32 [V, 3].
        velocities: Vertex velocities [m/s], float32 [V, 3].
        faces: Packed vertex indices, int32 [F, 3].
        air: Velocity of the air in each world [m/s], float32 [W, 3].
        world: World of each vertex, int32 [V]; None if there is one world only.
        drag, lift: Coefficients of drag and lift, without unit.
        density: Density of the air [kg/m^3].

    Returns:
        Force on each vertex [N], float32 [V, 3].

    Raises:
        TypeError: An argument has another dtype.
        ValueError: An argument has another shape or device, or an index of a vertex or world is out of range.
    """
    device = vertices.device if isinstance(vertices, torch.Tensor) else None
    expect("vertices", vertices, (None, 3))
    expect("velocities", velocities, tuple(vertices.shape), device=device)
    expect("faces", faces, (None, 3), torch.int32, device)
    expect("air", air, (None, 3), device=device)
    if world is None:
        if len(air) != 1:
            raise ValueError(f"world is needed to choose among the air of {len(air)} worlds")
        world = torch.zeros(len(vertices), dtype=torch.int32, device=device)
    expect("world", world, (len(vertices),), torch.int32, device)
    _in_range("faces", faces, len(vertices), "vertices")
    _in_range("world", world, len(air), "worlds")
    force = allocate(vertices.shape, torch.float32, vertices.device).zero_()
    with torch_stream(vertices.device):
        add_air_forces(
            as_warp(faces, wp.int32),
            as_warp(vertices, wp.vec3),
            as_warp(velocities, wp.vec3),
            as_warp(world, wp.int32),
            as_warp(air, wp.vec3),
            as_warp(force, wp.vec3),
            drag=drag,
            lift=lift,
            density=density,
        )
    return force


def _in_range(name: str, indices: torch.Tensor, count: int, what: str) -> None:
    if not indices.numel():
        return
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= count:
        raise ValueError(f"{name} holds indices {low} to {high}, there are {count} {what}")
