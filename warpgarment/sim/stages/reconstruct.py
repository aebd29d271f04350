"""Steps 3 and 4 of a frame: predicted deformation gradients become positions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch

from warpgarment.kernels import kept
from warpgarment.kernels.deformation.next_frame import next_gradients
from warpgarment.kernels.deformation.replaced import replace_singular_values
from warpgarment.kernels.features.channels import LAYOUT
from warpgarment.kernels.poisson.solver import PoissonSolver
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.nn.inputs import VertexStep
from warpgarment.nn.parametrisation import Step
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim.pins import BodyPins, mean_response
from warpgarment.sim.timing import Timings

from .centroids import ComponentCentroids
from .finite import keep_finite

SMALLEST_SINGULAR_VALUE = 1e-3  # least predicted stretch; a smaller one would fold the face onto itself
PINNED_MEAN = 0.9  # share of the missing mean displacement by which a pinned garment is moved, see `mean_response`


class Reconstruct:
    """Singular values and the Poisson solve of a batch.

    Args:
        garments: The batch.
        packed: The batch, packed.
        centroids: Function from positions to the centroids of components.
        first_vertices: Garments in the first frame [m], shape [V,3].
        bodies: The bodies in the first frame, to which pins are tied.
        body_of_garment: Body of each garment, int32 [B].
        replace: Whether the predicted singular values replace those of the predicted deformation gradients.
        timings: Times of the stages, to which this one adds its own as "singular values" and "poisson".
    """

    def __init__(
        self,
        garments: Sequence[Garment],
        packed: PackedGarments,
        centroids: ComponentCentroids,
        *,
        first_vertices: torch.Tensor,
        bodies: BodyMeshes,
        body_of_garment: torch.Tensor,
        replace: bool,
        timings: Timings,
    ) -> None:
        self._packed, self._centroids, self._replace, self._timings = packed, centroids, replace, timings
        self._device, self._solved = packed.faces.device, False
        pinned = len(packed.pins) > 0
        self.solver = PoissonSolver(packed.rest_vertices, packed.faces, pins=packed.pins if pinned else None)
        self._pins: BodyPins | None = None
        self._body_of_pin = body_of_garment[packed.garment_of_pin.long()]
        self.hold(first_vertices, bodies)
        if pinned:
            held = [(g.vertices, g.faces, g.pins, g.components[1]) for g in garments]
            responses = [kept.of("mean response", each, partial(mean_response, *each)) for each in held]
            self._mean_response = torch.from_numpy(np.concatenate(responses)).to(packed.faces.device)[:, None]

    def hold(self, first_vertices: torch.Tensor, bodies: BodyMeshes) -> None:
        """Ties the pins to bodies, with garments [V,3] and bodies in the first frame [m]."""
        if len(self._packed.pins):
            self._pins = BodyPins(first_vertices[self._packed.pins.long()], bodies, self._body_of_pin)

    def __call__(
        self, vertices: torch.Tensor, step: Step | VertexStep, features: torch.Tensor, next_body: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions at t+1 before contact. Differentiable in positions, prediction and features.

        Args:
            vertices: Garments at t [m], shape [V,3].
            step: Prediction of the network.
            features: Features at t, shape [F,34].
            next_body: Bodies at t+1 [m], shape [U,3].

        Returns:
            Positions [m], shape [V,3], and which garments are finite, bool [B]; the others keep their positions.
        """
        self._solved = not isinstance(step, VertexStep)
        if isinstance(step, VertexStep):  # positions are predicted, and only those of pins change
            positions = step.positions
            if self._pins is not None:
                positions = positions.index_copy(0, self._packed.pins.long(), self._pins.targets(next_body))
            every = torch.ones(self._packed.count, dtype=torch.bool, device=vertices.device)
            return keep_finite(self._packed, positions, vertices, every)
        with self._timings("singular values"):
            target, finite = self.gradients(step, features)
        with self._timings("poisson"):
            of_vertex = self._packed.vertex_component.long()
            velocity = torch.nan_to_num(step.velocity, 0.0, 0.0, 0.0)
            mean = self._centroids(vertices) + velocity
            solved = self.solver.solve(
                target,
                mean,
                initial=vertices + velocity[of_vertex],
                pin_targets=None if self._pins is None else self._pins.targets(next_body),
            )
            if self._pins is not None:
                missing = mean - self._centroids(solved)
                missing = PINNED_MEAN * missing[of_vertex]
                solved = solved + self._mean_response * missing
        return keep_finite(self._packed, solved, vertices, finite)

    def summary(self) -> torch.Tensor:
        """The report of the last Poisson solve, float64 [3] on the device; zeros if positions were predicted."""
        return self.solver.summary() if self._solved else torch.zeros(3, dtype=torch.float64, device=self._device)

    def gradients(self, step: Step, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Deformation gradients at t+1 [F,3,3], and garments with finite prediction [B]; see `next_gradients`.

        Two launches compute them; on a GPU, if prediction or features require a gradient, operator by operator.
        """
        packed = self._packed
        owners = packed.face_component, packed.garment_of_face, packed.count
        if torch.is_grad_enabled() and (step.psi.requires_grad or features.requires_grad):
            if self._device.type != "cpu":
                return self._differentiable_gradients(step, features)
            from warpgarment.kernels.deformation.trained_next import trained_next_gradients  # a simulation has none

            return trained_next_gradients(
                features, *step, *owners, replace=self._replace, smallest=SMALLEST_SINGULAR_VALUE
            )
        return next_gradients(features, *step, *owners, replace=self._replace, smallest=SMALLEST_SINGULAR_VALUE)

    def _differentiable_gradients(self, step: Step, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        packed, owner = self._packed, self._packed.garment_of_face.long()
        phi = features[:, LAYOUT["deformation_gradient"]].reshape(-1, 3, 3)
        sound = torch.isfinite(step.psi).flatten(1).all(1) & torch.isfinite(step.singular_values).all(1)
        sound &= torch.isfinite(step.velocity).all(1)[packed.face_component.long()]
        broken = torch.zeros(packed.count, dtype=torch.int32, device=phi.device).index_add(0, owner, (~sound).int())
        finite = broken == 0
        kept = finite[owner]
        target = (torch.where(kept[:, None, None], step.psi, torch.eye(3, device=phi.device)) @ phi).contiguous()
        if self._replace:
            stretch = torch.where(kept[:, None], step.singular_values, 1.0).clamp(min=SMALLEST_SINGULAR_VALUE)
            target = replace_singular_values(target, stretch)
        return target, finite
