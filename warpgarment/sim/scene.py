"""One batch of garments on bodies: what stays the same during a simulation, and the geometry around the network.

The stages of Algorithm 1, all on packed arrays: `features` before the network, `reconstruct` (singular values, Poisson)
and `push_out` (collisions) after it. A scene holds no garment positions; those are in `simulator.SimulationState`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.errors import MeshError
from warpgarment.kernels.collision.solver import CollisionSolver
from warpgarment.kernels.deformation.face_means import FaceMeans
from warpgarment.kernels.deformation.gradients import inverse_rest_frames
from warpgarment.kernels.deformation.next_frame import next_gradients
from warpgarment.kernels.features.carry import carried, face_at_each_vertex
from warpgarment.kernels.features.face import frame_features
from warpgarment.kernels.poisson.solver import PoissonSolver
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.surface_depth import SurfaceDepth
from warpgarment.nn.inputs import FrameInputs, VertexStep
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.parametrisation import Step
from warpgarment.objects.clearance import clearance
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedBodies, PackedGarments

from . import differentiable, memory
from .graph import GraphedFrames
from .pins import BodyPins, mean_response
from .surface import Surface, distance_to_keep
from .timing import Timings

FARTHEST = 1.0  # metres: a garment none of whose vertices is nearer to its body is in the wrong place or unit
SMALLEST_SINGULAR_VALUE = 1e-3  # a predicted stretch below this would fold the face onto itself: it becomes this
PINNED_MEAN = 0.9  # share of the way that q moves a pinned garment from where its pins alone would hold it
SHALLOW = 1e-4  # metres: collisions are repeated while anything of a garment is deeper


class Scene:
    """Garments, bodies, solvers and the network's view of them.

    Args:
        garments: In the order of the batch.
        bodies: Topology of the bodies, and which garment is on which.
        body_vertices: Bodies in the first frame [m], packed, shape [U,3].
        first_vertices: Garments in the first frame [m], packed, shape [V,3].
        network: Reads its config; run by `predict`.
        face_splits: As in `GarmentNetwork.layout`.
        epsilon: Distance that collision refinement keeps from the body [m]; None: see `clearance`.
        collision_passes: At most so many refinements a frame.
        half: Whether the transformer runs in bfloat16.
        timings: Where the stages write how long they took.

    Raises:
        MeshError: A garment is more than 1 m from its body.
        NotEnoughMemory: The batch would not fit on the device.
        ValueError: The network reads what a simulation does not know yet.
    """

    def __init__(
        self,
        garments: Sequence[Garment],
        bodies: PackedBodies,
        body_vertices: torch.Tensor,
        first_vertices: torch.Tensor,
        network: GarmentNetwork,
        *,
        face_splits: int,
        epsilon: float | None,
        collision_passes: int,
        half: bool,
        timings: Timings,
    ) -> None:
        if network.reads:
            raise ValueError(f"the network reads {', '.join(sorted(network.reads))}, which simulations do not give yet")
        device = body_vertices.device
        self.garments, self.network, self.timings = list(garments), network, timings
        self.collision_passes, self.half = collision_passes, half
        self.graph: GraphedFrames | None = None
        self.early_exit = device.type == "cpu"  # elsewhere it is cheaper to do a pass than to wait for the answer
        memory.check(garments, bodies, network.config, face_splits=face_splits, half=half, device=device)
        self.packed = packed = PackedGarments.pack(garments, device)
        self.inverse_rest = inverse_rest_frames(packed.rest_vertices, packed.faces)
        vertex_count = len(packed.rest_vertices)
        self._garment_means = FaceMeans(packed.faces, packed.garment_of_face, packed.count, vertex_count)
        self._component_means = FaceMeans(packed.faces, packed.face_component, packed.component_count, vertex_count)

        margins = [clearance(garment) if epsilon is None else epsilon for garment in garments]
        self.epsilon = torch.tensor(margins, device=device)[packed.garment_of_vertex.long()]
        self.body_of_vertex = bodies.body_of_garment[packed.garment_of_vertex.long()]
        self.body_of_face = bodies.body_of_garment[packed.garment_of_face.long()]
        self.surface = Surface(garments, packed)
        self._bodies = BodyMeshes(body_vertices, bodies.faces, bodies.vertex_offsets, bodies.face_offsets)
        self.placed: torch.Tensor | None = body_vertices  # what the trees were last moved to
        self.refuse_far(first_vertices)

        self._face_of_vertex = face_at_each_vertex(packed.faces, vertex_count)
        self.layout = network.layout(garments, packed, face_splits=face_splits)
        pinned = len(packed.pins) > 0
        self.poisson = PoissonSolver(packed.rest_vertices, packed.faces, pins=packed.pins if pinned else None)
        self.collision = CollisionSolver(packed.rest_vertices, packed.faces)
        self.pins = None
        if pinned:
            body_of_pin = bodies.body_of_garment[packed.garment_of_pin.long()]
            self.pins = BodyPins(first_vertices[packed.pins.long()], self._bodies, body_of_pin)
            responses = [mean_response(g.vertices, g.faces, g.pins, g.components[1]) for g in garments]
            self.mean_response = torch.from_numpy(np.concatenate(responses)).to(device)[:, None]

    def bodies(self, body_vertices: torch.Tensor) -> BodyMeshes:
        """The bodies' meshes with these vertices; moves them there if the last caller had them elsewhere."""
        if self.placed is not body_vertices:
            self._bodies.update(body_vertices)
            self.placed = body_vertices
        return self._bodies

    def refuse_far(self, vertices: torch.Tensor) -> None:
        """Raises MeshError for a garment that is nowhere near its body."""
        distance = self._bodies.query(vertices, self.body_of_vertex).distance
        for number, mine in enumerate(distance.split(_lengths(self.packed.vertex_offsets))):
            nearest = mine.abs().min().item()
            if nearest > FARTHEST:
                name = self.garments[number].name or f"number {number}"
                raise MeshError(
                    f"garment {name} is {nearest:.2f} m from its body at the nearest vertex. Check that both are in "
                    "metres (Garment.load(..., unit=...)) and Y up, and bring the garment onto the first frame with "
                    "wg.fit."
                )

    def components_mean(self, vertices: torch.Tensor) -> torch.Tensor:
        """Mean face centroid of each component (z of the paper) [m], [V,3] -> [C,3]."""
        if vertices.requires_grad:
            return differentiable.components_mean(self.packed, vertices)
        return self._component_means(vertices)

    def features(self, vertices: torch.Tensor, body_vertices: torch.Tensor, next_body: torch.Tensor) -> torch.Tensor:
        """Features of a frame, step 1: garments [V,3] on bodies [U,3] that will be at `next_body` [U,3] -> [F,34]."""
        packed = self.packed
        with self.timings("features"):
            bodies = self.bodies(body_vertices)
            if vertices.requires_grad:
                return differentiable.features(
                    packed, self.inverse_rest, vertices, self.body_of_face, bodies, next_body
                )
            return frame_features(
                self.inverse_rest,
                vertices,
                packed.faces,
                packed.garment_of_face,
                self._garment_means(vertices),
                self.body_of_face,
                bodies,
                next_body,
            )

    def predict(self, inputs: FrameInputs) -> Step | VertexStep:
        """The network, step 2: what happens next."""
        with self.timings("network"):
            return self.network.predict(inputs, self.layout, bfloat16=self.half)

    def reconstruct(
        self, vertices: torch.Tensor, step: Step | VertexStep, features: torch.Tensor, next_body: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Steps 3 and 4: the predicted deformation gradients become positions; predicted positions only meet the pins.

        Args:
            vertices: Of the newest frame [m], shape [V,3].
            step: Prediction.
            features: Of the newest frame, shape [F,34].
            next_body: Bodies in the next frame, shape [U,3].

        Returns:
            Positions [V,3], and which garments are finite [B]; the others are where they were.
        """
        packed = self.packed
        if isinstance(step, VertexStep):
            positions = step.positions
            if self.pins is not None:
                positions = positions.index_copy(0, packed.pins.long(), self.pins.targets(next_body))
            every = torch.ones(packed.count, dtype=torch.bool, device=vertices.device)
            return self.keep_finite(positions, vertices, every)
        with self.timings("singular values"):
            replace = self.network.config.replace_singular_values
            if step.psi.requires_grad or features.requires_grad:
                target, finite = differentiable.next_gradients(
                    packed, features, step, replace=replace, smallest=SMALLEST_SINGULAR_VALUE
                )
            else:
                owners = (packed.face_component, packed.garment_of_face, packed.count)
                target, finite = next_gradients(
                    features, *step, *owners, replace=replace, smallest=SMALLEST_SINGULAR_VALUE
                )
        with self.timings("poisson"):
            velocity = torch.nan_to_num(step.velocity, 0.0, 0.0, 0.0)
            mean = self.components_mean(vertices) + velocity
            solved = self.poisson.solve(
                target,
                mean,
                initial=vertices + velocity[packed.vertex_component.long()],
                pin_targets=None if self.pins is None else self.pins.targets(next_body),
            )
            if self.pins is not None:
                missing = mean - self.components_mean(solved)
                missing = PINNED_MEAN * missing[packed.vertex_component.long()]
                solved = solved + self.mean_response * missing
        return self.keep_finite(solved, vertices, finite)

    def carried(self, vertices: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """Where the vertices of a frame [V,3] with these features [F,34] would be had they moved with the body."""
        with self.timings("collision"):
            return carried(vertices, self.packed.faces, self._face_of_vertex, features)

    def push_out(
        self, vertices: torch.Tensor, next_body: torch.Tensor, finite: torch.Tensor, origin: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Step 5: refines collisions, again for garments of which anything is still deep.

        Which garments these are is decided on the device. The others are on no body in a later pass, so their vertices
        touch nothing and cost next to nothing; the CPU leaves out passes that no garment needs.

        Args:
            vertices: Positions [m], shape [V,3].
            next_body: Bodies in the next frame, shape [U,3].
            finite: Which garments are still simulated, shape [B].
            origin: From where the vertices come, see `carried`, shape [V,3]; None: all leave the body by the nearest
                way.

        Returns:
            Positions [V,3], finite [B], depth of each garment's deepest point [m] [B], and what the solver says of all
            passes: iterations, components stopped by the limit and their largest error, float64 [3].
        """
        with self.timings("collision"):
            bodies, on_body, epsilon = self.bodies(next_body), self.body_of_vertex, self.epsilon
            pending, depth = finite, vertices.new_zeros(self.packed.count)
            inside: SurfaceDepth | None = None
            solves = vertices.new_zeros(3, dtype=torch.float64)
            for _ in range(self.collision_passes):
                if inside is not None:
                    epsilon = distance_to_keep(epsilon, inside.missing, vertices, bodies, on_body)
                refined = self.collision.refine(vertices, bodies, on_body, epsilon=epsilon, origin=origin)
                solves = _together(solves, self.collision.summary())
                mine = pending[self.packed.garment_of_vertex.long()]
                refined = torch.where(mine[:, None], refined, vertices)
                vertices, finite = self.keep_finite(refined, vertices, finite)
                inside = self.surface.depth(vertices, bodies, on_body)
                depth = torch.where(pending, inside.garments, depth)
                pending = finite & pending & (depth > SHALLOW)
                if self.early_exit and not pending.any():
                    break
                on_body = torch.where(pending[self.packed.garment_of_vertex.long()], self.body_of_vertex, -1)
            if inside is None:
                depth = self.depth(vertices, bodies)
        return vertices, finite, depth, solves

    def tell(self, solves: np.ndarray) -> None:
        """Warns of solves that stopped at their limit; `solves` [2,3] as in `SimulationState`, read from the device."""
        for tell, (_, stopped, error) in zip((self.poisson.tell, self.collision.tell), solves, strict=True):
            tell(stopped, error)

    def depth(self, vertices: torch.Tensor, bodies: BodyMeshes) -> torch.Tensor:
        """How deep each garment is in its body, between its vertices too [m], at least 0; shape [B]."""
        return self.surface.depth(vertices, bodies, self.body_of_vertex).garments

    def keep_finite(
        self, new: torch.Tensor, old: torch.Tensor, finite: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """New positions where a garment's are all finite, else its old ones; and which garments are finite."""
        index = self.packed.garment_of_vertex
        finite = finite & self.all_of(torch.isfinite(new).all(1), index)
        return torch.where(finite[index.long()][:, None], new, old), finite

    def all_of(self, flags: torch.Tensor, garment: torch.Tensor) -> torch.Tensor:
        """Whether a flag holds for all elements of a garment; [N] and owner [N] -> [B]."""
        wrong = torch.zeros(self.packed.count, dtype=torch.int32, device=flags.device)
        return wrong.index_add(0, garment.long(), (~flags).int()) == 0


def _together(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Two summaries of solves as one: iterations and stopped components add up, of errors the largest counts."""
    return torch.cat([one[:2] + other[:2], torch.maximum(one[2:], other[2:])])


def _lengths(offsets: Sequence[int]) -> list[int]:
    return [after - before for before, after in itertools.pairwise(offsets)]
