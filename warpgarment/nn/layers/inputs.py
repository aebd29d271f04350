r"""What LayersNet sees: states, directions and descriptors of each outfit, in a frame that moves with its body.

An outfit is all garments on one body. Its root r is the mean of the body's vertices, its heading G turns the garments
to heading zero (heading.py; the identity with `heading="world"`), from M = integral of the deformation gradient over
the cloth. Lengths are metres, times are frames; x' = G (x - r) with r of the same frame and G of frame t:

    garment state, 12   x'(t), x'(t) - x'(t-1), x'(t-1), x'(t-1) - x'(t-2)
    body state, 12      the same one frame ahead: y'(t+1), ..., y'(t) - y'(t-1)
    gravity, 6          G (g - acceleration of r) at t+1 and t, in the statistics of accelerations
    wind, 22            for t+1 and t: G (velocity of r) [m/s], G (acceleration of r) [10 m/s^2], the direction as a
                        quaternion, the speed [5 m/s]
    attributes, 5       log10 of density, stretch, shear, bend and friction over those of a common cloth

The output is an acceleration a from t to t+1, which is added to where the cloth goes by itself:

    x(t+1) = base + G^T a
    base = G^T (x'(t) + (x'(t) - x'(t-1))) + r(t+1)             "inertia": cloth moves on as it moved
    base = s(t+1) + u(t) + KEPT (u(t) - u(t-1))                 "body": cloth moves on as it moved about the body

s(t) is where the garment would be at t as smooth skin of its body, R(t) how it would be turned (kernels/features/
skin.py), and u(t') = R(t+1) R(t')^T (x(t') - s(t')). With "body" a garment's state has 6 numbers more, G u(t) and
G (u(t) - u(t-1)); those of bodies are zero. An outfit that is carried along, or turned about the vertical, moves in the
same way.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from warpgarment.kernels.features.outdoor import attributes
from warpgarment.kernels.features.skin import Skin
from warpgarment.nn.heading import rotation_about_up, yaw
from warpgarment.nn.inputs import FrameInputs

from .cloth import ClothLayout
from .turns import quaternions, unit

GRAVITY = 9.81  # m/s^2
KEPT = 0.75  # share of the motion about the body that is kept in a frame at 30 a second; nine outfits' was 0.55 to 0.87
ROOT_ACCELERATION, AIR_SPEED = 10.0, 5.0  # m/s^2 and m/s that are one in the wind's descriptor


class Seen(NamedTuple):
    """A frame of B garments of O outfits, as the network sees it."""

    heading: torch.Tensor  # [O,3,3] G
    base: torch.Tensor  # [V,3] where vertices go by themselves, in world space [m]
    vertices: torch.Tensor  # [V,12] states of garments
    offsets: torch.Tensor  # [V,6] those about the body; [V,0] with "inertia"
    body: torch.Tensor  # [U,12] states of bodies
    normals: torch.Tensor  # [U,3] unit normals of bodies at t+1, turned by G
    gravity: torch.Tensor  # [O,2,3] at t+1 and t [m/frame^2]
    wind: torch.Tensor  # [B,2,11]
    air: torch.Tensor  # [B,3] velocity of the air at t+1, turned by G [m/s]
    attributes: torch.Tensor  # [B,5]; NaN for a garment without a material
    outfit_of_vertex: torch.Tensor  # int64 [V]
    outfit_of_body: torch.Tensor  # int64 [U]
    outfit_of_garment: torch.Tensor  # int64 [B]


def seen(inputs: FrameInputs, cloth: ClothLayout, *, fps: float, canonical: bool, carried_by: str) -> Seen:
    """The frame in the form above.

    Args:
        inputs: The batch; needs `previous`, `previous_body` and `bodies`. Without `materials` no garment has a
            material, without `wind` the air is still.
        cloth: Patches of the batch.
        fps: Frames per second.
        canonical: Whether outfits are turned to heading zero.
        carried_by: Where cloth goes by itself, "inertia" or "body"; the latter needs `skin`.
    """
    assert inputs.previous is not None
    assert inputs.previous_body is not None
    assert inputs.bodies is not None
    on = inputs.bodies
    outfits = len(on.vertex_offsets) - 1
    of_garment = on.body_of_garment.long()
    of_vertex, of_body = of_garment[cloth.garment_of_vertex], on.body_of_vertex.long()
    x = [inputs.vertices, *inputs.previous]
    y = [inputs.next_body, inputs.body, *inputs.previous_body]  # t+1 ... t-2
    root = [_mean(part, of_body, outfits) for part in y]
    relative = [part - r[of_vertex] for part, r in zip(x, root[1:], strict=True)]
    heading = _heading(relative[0], cloth.gradient, of_vertex, outfits) if canonical else _no_turn(relative[0], outfits)

    turn_of_vertex = heading[of_vertex]
    garments = [_turned(part, turn_of_vertex) for part in relative]
    if carried_by == "body":
        assert inputs.skin is not None
        goes, about = _about(inputs.skin, x, y, turn_of_vertex)
    else:
        on_its_way = garments[0] + (garments[0] - garments[1])
        goes, about = _turned(on_its_way, turn_of_vertex.mT) + root[0][of_vertex], garments[0][:, :0]
    bodies = [_turned(part - r[of_body], heading[of_body]) for part, r in zip(y[:3], root[:3], strict=True)]
    normals = _turned(_normals(inputs.next_body, on.faces), heading[of_body])

    speed = [root[0] - root[1], root[1] - root[2], root[2] - root[3]]
    pull = [speed[0] - speed[1], speed[1] - speed[2]]  # accelerations at t+1 and t
    down = relative[0].new_zeros(3)
    down[1] = -GRAVITY / fps**2  # a kernel, no copy from the host
    gravity = torch.stack([_turned(down - part, heading) for part in pull], dim=1)

    count, turn = len(of_garment), heading[of_garment]
    air = x[0].new_zeros((2, count, 3)) if inputs.wind is None else inputs.wind.to(x[0].dtype)
    wind = []
    for k in range(2):
        direction = _turned(air[k], turn)
        wind.append(
            torch.cat(
                [
                    _turned(speed[k][of_garment], turn) * fps,
                    _turned(pull[k][of_garment], turn) * (fps**2 / ROOT_ACCELERATION),
                    quaternions(direction),
                    air[k].square().sum(-1, keepdim=True).sqrt() / AIR_SPEED,
                ],
                dim=1,
            )
        )
    return Seen(
        heading=heading,
        base=goes,
        vertices=_state(garments),
        offsets=about,
        body=_state(bodies),
        normals=normals,
        gravity=gravity,
        wind=torch.stack(wind, dim=1),
        air=_turned(air[0], turn),
        attributes=attributes(inputs.materials, x[0], count),
        outfit_of_vertex=of_vertex,
        outfit_of_body=of_body,
        outfit_of_garment=of_garment,
    )


def positions(seen: Seen, acceleration: torch.Tensor) -> torch.Tensor:
    """Positions at t+1 in world space [m], [V,3], from accelerations in the frame of the outfit [m/frame^2], [V,3]."""
    return moved(seen.base, acceleration, seen.heading[seen.outfit_of_vertex])


def moved(base: torch.Tensor, acceleration: torch.Tensor, heading: torch.Tensor) -> torch.Tensor:
    """The formula above for any points.

    Args:
        base: Where they go by themselves [m], shape [N,3].
        acceleration: Accelerations in the frame of the outfit [m/frame^2], shape [N,3].
        heading: G of each point, shape [N,3,3].
    """
    return base + _turned(acceleration, heading.mT)


def acceleration(seen: Seen, after: torch.Tensor) -> torch.Tensor:
    """The inverse of `positions`: accelerations that lead to positions, [V,3] -> [V,3]."""
    return _turned(after - seen.base, seen.heading[seen.outfit_of_vertex])


def _about(
    skin: Skin, x: list[torch.Tensor], y: list[torch.Tensor], heading: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The base and the state about the body, [V,3] and [V,6].

    Args:
        skin: The garments as bound to their bodies.
        x: Garments at t, t-1, ... [m], [V,3] each.
        y: Bodies at t+1, t, t-1, ... [m], [U,3] each.
        heading: G of each vertex, shape [V,3,3].
    """
    next_turn, next_place = skin(y[0])
    u = []
    for cloth, body in zip(x[:2], y[1:3], strict=True):
        turn, place = skin(body)
        u.append(_turned(_turned(cloth - place, turn.mT), next_turn))
    motion = u[0] - u[1]
    state = torch.cat([_turned(u[0], heading), _turned(motion, heading)], dim=1)
    return next_place + u[0] + KEPT * motion, state


def _state(parts: list[torch.Tensor]) -> torch.Tensor:
    """Positions of three frames, newest first, as states [*,12]."""
    new, old, older = parts
    return torch.cat([new, new - old, old, old - older], dim=1)


def _turned(vectors: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
    """Vectors [N,3] or [3], each by its rotation [N,3,3]."""
    return (rotation @ vectors[..., None])[..., 0]


def _mean(values: torch.Tensor, owner: torch.Tensor, count: int) -> torch.Tensor:
    """Means [count,3] of the rows of each owner; summed in float64, since second differences in time are taken."""
    sums = values.new_zeros((count, 4), dtype=torch.float64)
    sums = sums.index_add(0, owner, torch.cat([values.double(), torch.ones_like(values[:, :1]).double()], dim=1))
    return (sums[:, :3] / sums[:, 3:]).to(values.dtype)


def _heading(relative: torch.Tensor, gradient: torch.Tensor, owner: torch.Tensor, count: int) -> torch.Tensor:
    """G of each outfit, [O,3,3]."""
    outer = relative[:, :, None] * gradient[:, None, :].to(relative.dtype)
    total = relative.new_zeros((count, 3, 3)).index_add(0, owner, outer)
    return rotation_about_up(-yaw(total[:, None]))


def _no_turn(like: torch.Tensor, count: int) -> torch.Tensor:
    return torch.eye(3, dtype=like.dtype, device=like.device).expand(count, 3, 3)


def _normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Unit normals of vertices, from those of their faces weighted by area, [U,3]; zero without faces."""
    corners = vertices[faces.long()]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = torch.zeros_like(vertices).index_add(0, faces.long().flatten(), cross.repeat_interleave(3, dim=0))
    return unit(summed * 1e3)  # of areas near 1e-4 m^2
