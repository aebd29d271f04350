"""Step 5 of a frame: cloth that is too close to something is moved away from it."""

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
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim.bodies import MovingBodies
from warpgarment.sim.surface import Surface, distance_to_keep
from warpgarment.sim.timing import Timings

from .finite import keep_finite

SHALLOW = 1e-4  # metres: collisions are repeated while anything of a garment is deeper


class Contact:
    """Collision refinement of a batch, repeated for garments of which anything is still deep in a body.

    Which garments these are is decided on the device. The others are on no body in a later pass, so their vertices
    touch nothing and cost next to nothing; the CPU leaves out passes that no garment needs.

    Args:
        packed: The batch.
        surface: Its edges and faces, of which the depth is measured.
        bodies: The bodies.
        body_of_vertex: Body of each vertex, int32 [V].
        epsilon: Distance that each vertex keeps from the body [m], float32 [V].
        sources: What finds contacts; the list may grow until the first frame.
        passes: Largest number of refinements in a frame; 0 leaves them out.
        timings: Where the stage adds up how long it took, as "collision".

    Attributes:
        early_exit: Whether the host looks after each pass if another is needed. On a GPU it is cheaper to do a pass
            than to wait for the answer.
        solver: None where there are no passes.
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
        """Where the vertices at t [V,3], with these features [F,34], would be at t+1 had they moved with the body.

        Returns:
            Positions [m], shape [V,3], see `carried`; None where there are no passes.
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
        """Positions at t+1. Differentiable in `vertices` for the contacts that were found.

        Args:
            vertices: Positions before contact [m], shape [V,3].
            next_body: Bodies at t+1 [m], shape [U,3].
            finite: Which garments are still simulated, bool [B].
            origin: Where the vertices come from, see `origin`; None: all leave the body by the nearest way.
            measure: Whether the depth of the result is wanted. Otherwise it is that before the last pass.

        Returns:
            Positions [V,3]; finite [B]; depth of the deepest point of each garment in its body [m], shape [B], 0 for
            garments that are not finite; and the solver's report on all passes: iterations, components stopped by the
            limit and their largest error, float64 [3].
        """
        owner = self._packed.garment_of_vertex.long()
        with self._timings("collision"):
            bodies, on_body, epsilon = self._bodies.at(next_body), self._body_of_vertex, self._epsilon
            pending, depth = finite, vertices.new_zeros(self._packed.count)
            report = vertices.new_zeros(3, dtype=torch.float64)
            for number in range(self._passes if self._sources else 0):
                if number:
                    inside = self._surface.depth(vertices, bodies, on_body)
                    depth = torch.where(pending, inside.garments, depth)
                    pending = finite & pending & (depth > SHALLOW)
                    if self.early_exit and not pending.any():
                        return vertices, finite, depth, report
                    on_body = torch.where(pending[owner], self._body_of_vertex, -1)
                    epsilon = distance_to_keep(epsilon, inside.missing, vertices, bodies, on_body)
                assert self.solver is not None
                frame = ContactFrame(bodies, on_body, self._packed.garment_of_vertex, epsilon, origin)
                refined = self.solver.solve(vertices, self._contacts(vertices, frame))
                report = _together(report, self.solver.summary())
                refined = torch.where(pending[owner][:, None], refined, vertices)
                vertices, finite = keep_finite(self._packed, refined, vertices, finite)
            if measure:
                inside = self._surface.depth(vertices, bodies, on_body)
                depth = torch.where(pending, inside.garments, depth)
        return vertices, finite, depth, report

    def depth(self, vertices: torch.Tensor, body: torch.Tensor) -> torch.Tensor:
        """How deep each garment is in its body, between its vertices too [m], at least 0; [V,3], [U,3] -> [B]."""
        return self._surface.depth(vertices, self._bodies.at(body), self._body_of_vertex).garments

    @torch.no_grad()
    def _contacts(self, vertices: torch.Tensor, frame: ContactFrame) -> Contacts:
        """One contact at each vertex, of all sources."""
        found = [one_for_each_vertex(s.find(vertices, frame), f"contact source {s.name!r}") for s in self._sources]
        return nearest(found, vertices)


def _together(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Two reports of solves as one: iterations and stopped components add up, of errors the largest counts."""
    return torch.cat([one[:2] + other[:2], torch.maximum(one[2:], other[2:])])
