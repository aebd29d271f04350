"""The bodies of a Newton model as closed triangle meshes that follow `State.body_q`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import newton
import numpy as np
import torch
import warp as wp

from warpgarment.errors import MeshError

from .axes import to_y_up
from .primitives import PRIMITIVES

_MESHES = ("MESH", "CONVEX_MESH")


class ShapeCollider:
    """What the shapes of each world's bodies look like to a garment: one mesh per world, a closed piece for each shape.

    Pieces overlap at joints, as limbs of other bodies do: the inside of the mesh is the inside of any of them.

    Args:
        model: The model.
        shapes: Numbers of the shapes that garments collide with; None: those of moving bodies that collide with
            particles (`newton.ShapeFlags.COLLIDE_PARTICLES`). Shapes of the ground, or of no world, never do.

    Attributes:
        faces: Faces of each world's mesh as its own vertex indices, [G,3], counter-clockwise seen from outside.
        counts: Number of vertices of each world's mesh.

    Raises:
        MeshError: A world has no such shape, or one of a kind that has no inside (a plane, a height field).
    """

    def __init__(self, model: newton.Model, shapes: Sequence[int] | None = None) -> None:
        names = ("body", "world", "flags", "type", "scale", "transform")
        of_body, of_world, flags, kinds, scales, placed = (getattr(model, f"shape_{name}").numpy() for name in names)
        moving = (of_body >= 0) & ((flags & int(newton.ShapeFlags.COLLIDE_PARTICLES)) != 0)
        chosen = np.flatnonzero(moving) if shapes is None else np.asarray(list(shapes), dtype=int)
        worlds = max(1, model.world_count)
        of_world = np.maximum(of_world, 0) if model.world_count <= 1 else of_world
        self.faces: list[np.ndarray] = []
        self.counts: list[int] = []
        points, bodies = [], []
        for world in range(worlds):
            parts, start = [], 0
            for shape in chosen[of_world[chosen] == world]:
                vertices, faces = _mesh(model, int(shape), kinds[shape], scales[shape])
                points.append(_placed(vertices, placed[shape]))
                bodies.append(np.full(len(vertices), of_body[shape]))
                parts.append(faces + start)
                start += len(vertices)
            if not parts:
                raise MeshError(f"world {world} has no shape that a garment could be worn on. Name them with shapes=.")
            self.faces.append(np.concatenate(parts))
            self.counts.append(start)
        self._axis = int(model.up_axis)
        device = torch.device(wp.device_to_torch(model.device))
        self._points = torch.tensor(np.concatenate(points), dtype=torch.float32, device=device)
        self._bodies = torch.tensor(np.concatenate(bodies), dtype=torch.int64, device=device)

    def at(self, state: Any) -> torch.Tensor:
        """Vertices of all worlds' meshes with the bodies where `state.body_q` has them [m], Y up, packed, [U,3]."""
        placed = wp.to_torch(state.body_q, requires_grad=False)[self._bodies]
        return to_y_up(_rotated(self._points, placed[:, 3:]) + placed[:, :3], self._axis)

    def split(self, packed: torch.Tensor) -> list[np.ndarray]:
        """Vertices of each world's mesh [m], of packed ones [U,3], on the host."""
        return [part.cpu().numpy() for part in packed.split(self.counts)]


def _mesh(model: newton.Model, shape: int, kind: int, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    name = newton.GeoType(int(kind)).name
    if name in PRIMITIVES:
        return PRIMITIVES[name](scale)
    if name in _MESHES:
        source: Any = model.shape_source[shape]
        return np.asarray(source.vertices) * scale, np.asarray(source.indices).reshape(-1, 3)
    raise MeshError(
        f"shape {shape} ({model.shape_label[shape]}) is a {name.lower()}, which has no inside. Leave it out of shapes=."
    )


def _placed(vertices: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """Vertices of a shape in the frame of its body."""
    points = torch.tensor(vertices, dtype=torch.float64)
    turn = torch.tensor(transform[3:], dtype=torch.float64).expand(len(points), 4)
    return _rotated(points, turn).numpy() + transform[:3]


def _rotated(points: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """Points [U,3] turned by unit quaternions [U,4], whose real part is last."""
    axis, real = turns[:, :3], turns[:, 3:]
    twice = 2.0 * torch.linalg.cross(axis, points)
    return points + real * twice + torch.linalg.cross(axis, twice)
