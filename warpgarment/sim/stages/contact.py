"""Step 5 of a frame: moves cloth away from a body, or other contact source, to which it is too close."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from warpgarment.kernels.collision.contact_set import (
    ContactFrame,
    Contacts,
    ContactSource,
    nearest,
    one_for_each_vertex,
)
from warpgarment.kernels.collision.solver import CollisionSolver
from warpgarment.kernels.features.carry import carried, face_at_each_vertex
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.surface_depth import SurfaceDepth
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim.bodies import MovingBodies
from warpgarment.sim.surface import Surface, distance_to_keep
from warpgarment.sim.timing import Timings

from .finite import keep_finite

SHALLOW = 1e-4  # metres: collisions are repeated while anything of a garment is deeper
STRAIGHT = 2
"""How often, at the end, vertices that are still inside are placed outside without their neighbours."""
CLEAR = 5e-4
"""Distance from the surface at which they are placed [m]."""


class Contact:
    """Collision refinement of a batch, repeated for garments that still have a point deep in a body.

    These garments are selected on the device. In a later pass the others have no body, so their vertices have no
    contacts and cost little time. On a CPU, passes that no garment needs are left out.

    Args:
        packed: The batch.
        surface: Edges and faces of the batch, to measure their depth.
        bodies: The bodies.
        body_of_vertex: Body of each vertex, int32 [V].
        epsilon: Distance that each vertex keeps from the body [m], float32 [V].
        sources: Objects that find contacts; more may be appended before the first frame.
        passes: Largest number of refinements in a frame; 0 leaves them out.
        timings: Times of the stages, to which this one adds its own as "collision".

    Attributes:
        early_exit: Whether the host checks after each pass if another one is needed. On a GPU it does not: a pass takes
            less time than waiting for that result.
        solver: Solver of the refinement; None without passes.
    """

    def __init__(
        self,
        packed: PackedGarments,
        surface: Surface,
        bodies: MovingBodies,
        *,
        body_of_vertex: torch.Tensor,
        epsilon: torch.Tensor,
        sources: Sequence[ContactSource],
        passes: int,
        timings: Timings,
    ) -> None:
        self._packed, self._surface, self._bodies, self._timings = packed, surface, bodies, timings
        self._body_of_vertex, self._epsilon, self._sources, self._passes = body_of_vertex, epsilon, sources, passes
        self._face_of_vertex = face_at_each_vertex(packed.faces, len(packed.rest_vertices))
        self.early_exit = packed.faces.device.type == "cpu"
        self.solver = CollisionSolver(packed.rest_vertices, packed.faces) if passes else None

    def origin(self, vertices: torch.Tensor, features: torch.Tensor) -> torch.Tensor | None:
        """Positions at t+1 of vertices that would move with the body; see `carried`.

        Args:
            vertices: Garments at t [m], shape [V,3].
            features: Features at t, shape [F,34].

        Returns:
            Positions [m], shape [V,3]; None without passes.
        """
        if not self._passes:
            return None
        with self._timings("collision"):
            return carried(vertices, self._packed.faces, self._face_of_vertex, features)

    def __call__(
        self,
        vertices: torch.Tensor,
        next_body: torch.Tensor,
        finite: torch.Tensor,
        origin: torch.Tensor | None = None,
        *,
        measure: bool = True,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Positions at t+1 after contact. Differentiable in `vertices`, with the contacts held fixed.

        Args:
            vertices: Positions before contact [m], shape [V,3].
            next_body: Bodies at t+1 [m], shape [U,3].
            finite: Which garments are still simulated, bool [B].
            origin: Positions from which vertices are followed, to find where they entered a body, see `origin`. None
                moves every vertex out by the shortest way.
            measure: Whether the depth of the result is measured. Otherwise the depth before the last pass is returned.

        Returns:
            Positions [V,3]; finite [B]; depth of the deepest point of each garment in its body [m], shape [B], 0 for
            garments that are not finite; and the solver's report on all passes, float64 [3]: iterations, number of
            components stopped by the limit, and their largest error.
        """
        owner = self._packed.garment_of_vertex.long()
        with self._timings("collision"):
            bodies, on_body, epsilon = self._bodies.at(next_body), self._body_of_vertex, self._epsilon
            pending, depth = finite, vertices.new_zeros(self._packed.count)
            report = vertices.new_zeros(3, dtype=torch.float64)
            measured: tuple[torch.Tensor, SurfaceDepth] | None = None
            for number in range(self._passes if self._sources else 0):
                if number:
                    inside = self._surface.depth(vertices, bodies, on_body, measured)
                    measured = vertices, inside
                    depth = torch.where(pending, inside.garments, depth)
                    pending = finite & pending & (depth > SHALLOW)
                    if self.early_exit and not pending.any():
                        return vertices, finite, depth, report
                    if not (self.early_exit and pending.all()):
                        on_body = torch.where(pending[owner], self._body_of_vertex, -1)
                    epsilon = distance_to_keep(epsilon, inside.missing, vertices, bodies, on_body)
                assert self.solver is not None
                frame = ContactFrame(bodies, on_body, self._packed.garment_of_vertex, epsilon, origin)
                refined = self.solver.solve(vertices, self._contacts(vertices, frame))
                summary = self.solver.summary()
                report = _together(report, summary) if number else summary
                if not (self.early_exit and pending.all()):
                    refined = torch.where(pending[owner][:, None], refined, vertices)
                vertices, finite = keep_finite(self._packed, refined, vertices, finite)
            if self._sources and self._passes:
                vertices = self._out(vertices, bodies, pending, origin)
            if measure:
                inside = self._surface.depth(vertices, bodies, on_body, measured)
                depth = torch.where(pending, inside.garments, depth)
        return vertices, finite, depth, report

    def _out(
        self, vertices: torch.Tensor, bodies: BodyMeshes, pending: torch.Tensor, origin: torch.Tensor | None
    ) -> torch.Tensor:
        """Places vertices that are still inside after the last pass outside, each by itself.

        Near two parts of a body that are close together or overlap, neighbours pull a vertex from one into the other in
        each pass.

        Args:
            vertices: Positions [m], shape [V,3].
            bodies: The bodies in the same frame.
            pending: Garments of which anything is inside, bool [B].
            origin: Where the vertices come from, see `origin`.

        Returns:
            Positions [m], shape [V,3].
        """
        owner = self._packed.garment_of_vertex
        for _ in range(STRAIGHT):
            on_body = torch.where(pending[owner.long()], self._body_of_vertex, -1)
            found = self._contacts(vertices, ContactFrame(bodies, on_body, owner, self._epsilon, origin))
            missing = (found.normal * (found.anchor - vertices)).sum(1)
            inside = missing > 0
            if self.early_exit and not inside.any():
                return vertices
            way = torch.where(inside, missing + CLEAR, 0.0)
            vertices = (vertices + way[:, None] * found.normal).float()
        return vertices

    def depth(self, vertices: torch.Tensor, body: torch.Tensor) -> torch.Tensor:
        """Depth of the deepest point of each garment in its body [m], at least 0; [V,3], [U,3] -> [B]."""
        return self._surface.depth(vertices, self._bodies.at(body), self._body_of_vertex).garments

    @torch.no_grad()
    def _contacts(self, vertices: torch.Tensor, frame: ContactFrame) -> Contacts:
        """One contact at each vertex: of those that the sources found, the one with the largest gap."""
        found = [one_for_each_vertex(s.find(vertices, frame), f"contact source {s.name!r}") for s in self._sources]
        return nearest(found, vertices)


def _together(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Joins two reports of solves: sums of iterations and stopped components, and the largest error."""
    return torch.cat([one[:2] + other[:2], torch.maximum(one[2:], other[2:])])
