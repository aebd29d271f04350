"""Step 5 of a frame: moves cloth away from a body, or other contact source, to which it is too close."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch

from warpgarment.kernels.collision.body_contacts import BodyContacts
from warpgarment.kernels.collision.contact_set import (
    ContactFrame,
    Contacts,
    ContactSource,
    nearest,
    one_for_each_vertex,
)
from warpgarment.kernels.collision.solver import CollisionSolver
from warpgarment.kernels.features.carry import carried, face_at_each_vertex
from warpgarment.kernels.replay.pieces import Pieces
from warpgarment.kernels.replay.recording import recording
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.vertex_depth import Measured
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


class Pass(NamedTuple):
    """A batch between two passes."""

    vertices: torch.Tensor  # [V,3] [m]
    finite: torch.Tensor  # bool [B]
    pending: torch.Tensor  # bool [B], garments that the next pass moves
    on_body: torch.Tensor  # int32 [V], body of each vertex in the last pass; -1 for none
    epsilon: torch.Tensor  # [V], distance that vertices kept in it [m]
    report: torch.Tensor | None = None  # float64 [3] of the solves; None before the first
    depth: torch.Tensor | None = None  # [B] of the garments [m]; with `missing` None before it is measured
    missing: torch.Tensor | None = None  # [V], see `SurfaceDepth`
    at: torch.Tensor | None = None  # [V,3], positions at which vertices were measured last [m]; see `Measured`
    inside: torch.Tensor | None = None  # [V], depth of each vertex there
    clear: torch.Tensor | None = None  # [V], ball around each vertex without surface

    @property
    def measured(self) -> Measured | None:
        """Where vertices were measured last, and what was found."""
        if self.at is None or self.inside is None or self.clear is None:
            return None
        return Measured(self.at, self.inside, self.clear)


FIELDS = len(Pass._fields)


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
        pieces: Runs the parts of a pass.
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
        self.pieces = Pieces()

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
        if self.pieces.on and not self._replays:
            vertices, origin = self.pieces.kept(vertices), None if origin is None else self.pieces.kept(origin)
        with self._timings("collision"):
            state = Pass(vertices, finite, finite, self._body_of_vertex, self._epsilon)
            passes = self._passes if self._sources else 0
            if passes and self._replays:
                self._bodies.placed = None  # a replay moves them, and an interrupt may leave them anywhere
            for number in range(passes):
                state, *found = self._run("contacts", self._find, number, state, next_body, origin)
                if not number:
                    self._bodies.placed = next_body
                (state,) = self._run("refinement", self._refine, number, state, *found)
                if number + 1 < passes:
                    (state,) = self._run("depth", self._deepest, number, state)
                    if self.early_exit and not state.pending.any():
                        assert state.depth is not None
                        assert state.report is not None
                        return state.vertices, state.finite, state.depth, state.report
            bodies, vertices = self._bodies.at(next_body), state.vertices
            depth = vertices.new_zeros(self._packed.count) if state.depth is None else state.depth
            report = vertices.new_zeros(3, dtype=torch.float64) if state.report is None else state.report
            if passes:
                vertices = self._out(vertices, bodies, state.pending, origin)
            if measure:
                inside = self._surface.depth(vertices, bodies, state.on_body, state.measured)
                depth = torch.where(state.pending, inside.garments, depth)
        return vertices, state.finite, depth, report

    @property
    def _replays(self) -> bool:
        """Whether parts of a pass are pieces: other sources than the body may do anything, and keep what they get."""
        return self.pieces.on and all(type(source) is BodyContacts for source in self._sources)

    def _run(self, name: str, part: Callable[..., tuple[Any, ...]], number: int, state: Pass, *more: Any) -> Any:
        """Runs a part of a pass, whose first result is a `Pass`."""
        if not self._replays:
            return part(number, state, *more)

        def flat(*tensors: Any) -> tuple[Any, ...]:
            after, *rest = part(number, Pass(*tensors[:FIELDS]), *tensors[FIELDS:])
            return (*after, *rest)

        results = self.pieces((name, number), flat, (*state, *more))
        return (Pass(*results[:FIELDS]), *results[FIELDS:])

    def _find(self, number: int, state: Pass, next_body: torch.Tensor, origin: torch.Tensor | None) -> tuple[Any, ...]:
        """Contacts of a pass; the first one moves the bodies."""
        on_body, epsilon, vertices = state.on_body, state.epsilon, state.vertices
        bodies = self._bodies.moved if number else self._bodies.at(next_body)
        if number:
            assert state.missing is not None
            if not self._all(state.pending):
                on_body = torch.where(state.pending[self._packed.owner], self._body_of_vertex, -1)
            epsilon = distance_to_keep(epsilon, state.missing, vertices, bodies, on_body)
        else:
            _, inside, clear = self._surface.measured(vertices, bodies, on_body)
            state = state._replace(at=vertices, inside=inside, clear=clear)
        frame = ContactFrame(bodies, on_body, self._packed.garment_of_vertex, epsilon, origin, state.clear)
        found = self._contacts(vertices, frame)
        return (state._replace(on_body=on_body, epsilon=epsilon), found.normal, found.anchor, found.distance)

    def _refine(
        self, number: int, state: Pass, normal: torch.Tensor, anchor: torch.Tensor, distance: torch.Tensor
    ) -> tuple[Pass]:
        """Positions after the contacts of a pass."""
        assert self.solver is not None
        refined = self.solver.solve(state.vertices, Contacts(normal, anchor, distance))
        report = self.solver.summary(state.report)
        if not self._all(state.pending):
            refined = torch.where(state.pending[self._packed.owner][:, None], refined, state.vertices)
        vertices, finite = keep_finite(self._packed, refined, state.vertices, state.finite)
        return (state._replace(vertices=vertices, finite=finite, report=report),)

    def _deepest(self, number: int, state: Pass) -> tuple[Pass]:
        """Depth after a pass, and which garments need another one."""
        inside = self._surface.depth(state.vertices, self._bodies.moved, state.on_body, state.measured)
        depth = inside.garments if state.depth is None else torch.where(state.pending, inside.garments, state.depth)
        pending = state.finite & state.pending & (depth > SHALLOW)
        found = {"depth": depth, "missing": inside.missing, "inside": inside.depth, "clear": inside.clear}
        return (state._replace(pending=pending, at=state.vertices, **found),)

    def _all(self, garments: torch.Tensor) -> bool:
        """Whether all garments are chosen, where the host may ask."""
        return self.early_exit and not recording() and bool(garments.all())

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
            on_body = torch.where(pending[self._packed.owner], self._body_of_vertex, -1)
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
