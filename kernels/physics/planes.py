"""Contact planes of cloth with a moving body, as inputs of a solve (vertices.py)."""

from __future__ import annotations

from typing import NamedTuple

import torch

from warpgarment.kernels.collision.body_contacts import contacts
from warpgarment.kernels.sdf import BodyMeshes

from .solver import ImplicitSolver


class Planes(NamedTuple):
    """Planes that vertices keep away from."""

    normal: torch.Tensor
    """Unit normals, float64 [V,3]; zero for none."""
    offset: torch.Tensor
    """Places along the normals [m], float64 [V]."""
    distance: torch.Tensor
    """Distances to keep [m], float64 [V]."""
    way: torch.Tensor
    """Motion of the surface during the step [m], float64 [V,3]."""


def planes_of(
    points: torch.Tensor,
    meshes: BodyMeshes,
    before: torch.Tensor,
    keep: torch.Tensor,
    within: torch.Tensor,
    body_of_vertex: torch.Tensor | None = None,
) -> Planes:
    """Planes of points at the surfaces of bodies.

    Args:
        points: Positions [m], float64 [V,3].
        meshes: The bodies at the end of a step.
        before: Positions of their vertices at its start [m], float32 [U,3].
        keep: Distance to keep [m], float32 [V].
        within: Distance at which contact is detected [m], float32 [V].
        body_of_vertex: Body of each vertex, int32 [V]; None if there is one body.
    """
    guess, now = points.float(), meshes.vertices
    query = meshes.query(guess, body_of_vertex, within=within)
    found = contacts(guess, query.distance, query.face, meshes, within, body_of_vertex=body_of_vertex)
    assert isinstance(found.distance, torch.Tensor)
    distance = torch.minimum(keep, found.distance).double()
    corner = meshes.faces.long()[query.face.clamp(min=0).long()]
    weights = _barycentric(query.closest.double(), now[corner].double())
    way = (weights[:, :, None] * (now - before)[corner]).sum(1)
    there = (found.normal != 0).any(1)
    return Planes(
        found.normal,
        (found.normal * found.anchor).sum(1),
        torch.where(there, distance, 0.0),
        torch.where(there[:, None], way, 0.0),
    )


def touch(solver: ImplicitSolver, planes: Planes) -> None:
    """Gives the solver planes to keep away from."""
    for name in ("normal", "offset", "distance"):
        getattr(solver, name).copy_(getattr(planes, name))


def pressed(solver: ImplicitSolver, points: torch.Tensor) -> torch.Tensor:
    """Force with which planes of the last solve push each vertex [N], float64 [V]."""
    gap = solver.distance - ((solver.normal * points).sum(1) - solver.offset)
    return torch.where((solver.normal != 0).any(1), gap.clamp(min=0.0), 0.0) * solver.contact


def _barycentric(point: torch.Tensor, corner: torch.Tensor) -> torch.Tensor:
    """Barycentric coordinates of points [V,3] in the planes of triangles [V,3,3]; a third each where there is none."""
    a, b, p = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], point - corner[:, 0]
    aa, ab, bb, pa, pb = ((x * y).sum(1) for x, y in ((a, a), (a, b), (b, b), (p, a), (p, b)))
    size = aa * bb - ab * ab
    second, third = (bb * pa - ab * pb) / size, (aa * pb - ab * pa) / size
    weights = torch.stack([1.0 - second - third, second, third], 1)
    return torch.where(weights.isfinite().all(1, keepdim=True), weights, 1.0 / 3.0)
