r"""Training on several steps in a row: the prediction is the input of the next step, and gradients flow through.

    predict -> compose -> singular values -> Poisson -> collisions -> features of the next frame -> predict -> ...

with the stages of `warpgarment.sim.scene.Scene`, which are those of the simulator. Every step k = 1..K has the loss of
one-step training, in the same normalised quantities, with the target that leads from the predicted state to the
recording:

    Psi_k = Phi_{t+k} Phi~_{t+k-1}^-1      Sigma_k = Sigma_{t+k}      q_k = z_{t+k} - z~_{t+k-1}      (~ predicted)

and, with its own weight, the distance of the predicted vertices from the recorded ones in metres:

    L = 1/K sum_k [ L_def + lambda_sv L_sv + lambda_vel L_vel + position |V~_{t+k} - V_{t+k}| ]

and the terms of `cloth_losses.py`, if they have weights. A sequence without a recording has only its physics.

Gradients flow through the network at every step; through the state, that is deformation gradients, normals, centroids,
distances and directions to the body, singular values, velocities, the wind relative to faces and the heading; through
the replacement of singular values; through the Poisson solve, in Phi and mean; through collision refinement, for fixed
contacts; and through those targets that depend on the state. These are constants: the nearest body face with its
deformation and velocity, found at every step without gradient; its nearest point, unless it slides along that face
(`UnrollConfig.sliding`); the rotation in the residual; the body and the pins on it; recorded frames.

The Poisson solve needs whole garments, so the splits of the schedule become `face_splits` of the simulator: the network
sees all faces, in interleaved subsets. Every sample has the same weight, whatever its number of faces, so the mean over
equal parts of a batch is the loss of the whole batch. Gaussian noise on features, mirroring, yaw, displaced histories
and the pool work as in one-step training; changes of size are not possible. Batches are not built ahead.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import nn

from warpgarment.kernels.deformation.gradients import relative_deformation_gradient
from warpgarment.kernels.deformation.trained_steps import Rows, Wanted, trained_steps
from warpgarment.kernels.features.channels import LAYOUT
from warpgarment.kernels.features.outdoor import packed_columns
from warpgarment.nn.heading import rotate_vectors
from warpgarment.nn.inputs import RowInputs
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.parametrisation import NetworkOutput, Step, StepContext, compose, context, targets
from warpgarment.nn.rows import PaddedView
from warpgarment.nn.run import VELOCITY, mirror_rows, normalised, run
from warpgarment.sim.history import History, Stacks
from warpgarment.training.samples.unrolled import UnrolledBatch

from .cloth_losses import ClothLossConfig, ClothLosses, ClothState
from .losses import LossConfig, summed, weighted

MOST_STEPS = 8  # largest K
KNOWN = 5e-3  # metres: e, an error that is small enough anywhere
FIGURES = ("loss", "loss_deformation", "loss_singular_values", "loss_velocity", "position_m")


@dataclass(frozen=True)
class UnrollConfig:
    """Settings of unrolled training.

    Attributes:
        steps: Number of steps K in a row; 1 is one-step training, for which the other settings here have no effect.
        position: Weight of the position loss [1/m]; 0 for none. At 2000 it is most of the loss. It is the error of
            rollouts, while the other terms count every wrinkle.
        collision_passes: Largest number of collision refinements between steps; 0 for none. A rollout has up to four.
        floor: Distance of the teacher from its own twin for each metre between cloth and body, without unit. A vertex
            at distance d counts e / (floor d + e) in the position loss, with e of 5 mm: where the recording itself is
            chance, it counts less. 0: all count the same.
        sliding: Whether gradients take the nearest body point as one that slides along its face, see
            `warpgarment.sim.stages.features.Features`; with it rollouts come out 6 % better (docs/physics.md).
    """

    steps: int = 1
    position: float = 2000.0
    collision_passes: int = 1
    floor: float = 0.0
    sliding: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= MOST_STEPS:
            raise ValueError(f"unroll.steps must lie between 1 and {MOST_STEPS}, got {self.steps}")
        given = {"position": self.position, "collision_passes": self.collision_passes, "floor": self.floor}
        for name, value in given.items():
            if not 0.0 <= value < math.inf:
                raise ValueError(f"unroll.{name} must be at least 0 and finite, got {value}")


class StepTaken(NamedTuple):
    """A step of a sample; positions in metres, [V,3] each."""

    terms: torch.Tensor  # the losses [4] of `losses.Losses`
    vertices: torch.Tensor | None  # predicted; None for the last step, if they are not needed
    recorded: torch.Tensor
    solved: torch.Tensor | None  # predicted, before the physics stage; None without one


class Seen(NamedTuple):
    """What the network reads in a step, packed."""

    features: torch.Tensor  # [F,H*34], without gradients
    live: list[torch.Tensor]  # [F,34] each, the newest frames of these, to which gradients flow
    velocities: torch.Tensor  # [C,(H-1)*3]
    outside: torch.Tensor | None  # [F,K], channels of the material and the wind


class Now(NamedTuple):
    """The newest frame, packed."""

    vertices: torch.Tensor  # [V,3]
    features: torch.Tensor  # [F,34]
    newest: StepContext


class UnrolledObjective(nn.Module):
    """Loss of a batch of unrolled samples.

    Args:
        network: The network in training.
        config: Weights and units of the loss.
        noise: Standard deviation of Gaussian noise on the normalised inputs; 0: none.
        precision: Precision of the transformer, "float32" or "bfloat16".
        unroll: Settings of unrolled training.
        cloth: Weights of the terms of `cloth_losses.py`.

    Attributes:
        figures: Names of the numbers that `forward` gives.
    """

    def __init__(
        self,
        network: GarmentNetwork,
        config: LossConfig,
        noise: float,
        precision: str,
        unroll: UnrollConfig,
        cloth: ClothLossConfig | None = None,
    ) -> None:
        super().__init__()
        self.cloth = cloth or ClothLossConfig()
        self.figures = (*FIGURES, *(f"loss_{name}" for name in self.cloth.terms))
        self.network, self.config, self.noise, self.unroll = network, config, noise, unroll
        self.in_bfloat16 = precision == "bfloat16"

    @staticmethod
    def inputs(batch: UnrolledBatch) -> tuple[UnrolledBatch]:
        """The arguments of `forward` for a batch."""
        return (batch,)

    def forward(self, batch: UnrolledBatch) -> torch.Tensor:
        """The numbers named in `figures`: the total and its three terms, as means over the steps, the mean distance of
        predicted from recorded vertices [m], each as much as it counts, and the terms of the cloth. Without a weight
        for that distance or for the cloth, the last step is not solved and not in its mean."""
        found, distances, looks = [], [], []
        fps, before, now = self.network.config.fps, batch.before, batch.vertices
        cloth = None
        if self.cloth.terms:
            scene = batch.scene
            cloth = ClothLosses(self.cloth, scene.packed, batch.materials, fps, batch.counted, scene.relax.cloth)
        batch.scene.features.sliding = self.unroll.sliding
        weight = batch.vertex_weight
        if self.unroll.floor:
            weight = weight * certainty(batch, self.unroll.floor)
        for terms, vertices, recorded, solved in self.steps(batch):
            found.append(terms)
            if vertices is None:
                continue
            distances.append(((vertices - recorded).norm(dim=1) * weight).sum())
            if cloth is not None:
                looks.append(cloth(ClothState(vertices, recorded, now, before, solved)))
            before, now = now, vertices
        terms = torch.stack(found).mean(dim=0)
        position = torch.stack(distances).mean() if distances else terms.new_zeros(())
        total = terms[0] + self.unroll.position * position if self.unroll.position else terms[0]
        seen = torch.stack(looks).mean(dim=0) if looks else terms.new_zeros(0)
        total = total + sum(getattr(self.cloth, name) * term for name, term in zip(self.cloth.terms, seen, strict=True))
        return torch.stack([total, *terms[1:], position if self.unroll.position else position.detach(), *seen])

    def steps(self, batch: UnrolledBatch) -> Iterator[StepTaken]:
        """Yields the steps."""
        scene, config = batch.scene, self.network.config
        vertices, history, features = batch.vertices, batch.history, batch.features
        before, packed = batch.before, scene.packed
        live: list[torch.Tensor] = []  # features of the newest frames, to which gradients flow
        # Operators of other networks keep what they read, which a stack that overlaps with later ones would change.
        overlap = self.network.takes_frames and not self.noise
        stacks = Stacks() if overlap else History.stacked
        for k, recorded in enumerate(batch.recorded):
            stacked = stacks(history, features.detach())
            assert isinstance(stacked, torch.Tensor)  # such stacks are not apart
            live = [*live, features][-config.history :] if features.requires_grad else live
            newest = context(features, scene.packed.face_component, scene.packed.component_count)
            outside = packed_columns(
                self.network.outdoor,
                config.fps,
                vertices,
                before,
                packed.faces,
                packed.garment_of_face,
                scene.materials,
                batch.air[k],
            )
            seen = Seen(stacked.flatten(1), live, history.velocities.flatten(1), outside)
            predicted = self._by_kernels if features.device.type == "cpu" else self._by_operators
            step, terms = predicted(batch, seen, Now(vertices, features, newest), k)
            last = k + 1 == len(batch.recorded)
            if last and not self.unroll.position and not self.cloth.terms:
                yield StepTaken(terms, None, recorded, None)
                return
            body = batch.bodies[k + 1]
            solved, finite = scene.reconstruct(vertices, step, features, body)
            before_stage, solved = solved, scene.relax(solved, finite)
            if self.unroll.collision_passes:
                origin = scene.contact.origin(vertices, features)
                solved = scene.contact(solved, body, finite, origin, measure=False)[0]
            yield StepTaken(terms, solved, recorded, before_stage if scene.relax.on else None)
            if not last:
                velocity = scene.centroids(solved) - scene.centroids(vertices)
                history = history.followed(stacked, velocity)
                before, vertices = vertices, solved
                features = scene.features(vertices, body, batch.bodies[k + 2])

    def _by_operators(self, batch: UnrolledBatch, seen: Seen, now: Now, k: int) -> tuple[Step, torch.Tensor]:
        """The predicted step, and its losses [4] against a recorded frame."""
        scene, residual = batch.scene, self.network.config.residual
        phi = now.features[:, LAYOUT["deformation_gradient"]].reshape(-1, 3, 3).contiguous()
        phi_next, values = batch.stretched[k]
        velocity = scene.centroids(batch.recorded[k]) - scene.centroids(now.vertices)
        wanted = Step(relative_deformation_gradient(phi_next, phi), values, velocity)
        target = targets(wanted, now.newest, residual=residual)
        output = NetworkOutput(*(torch.zeros_like(part) for part in target))
        terms = seen.features.new_zeros(4)
        for view in scene.layout.views:
            rows = self._rows(batch, view, seen)
            parts = (
                view.faces(target.psi),
                view.faces(target.singular_values),
                view.components(target.velocity),
            )
            ran = run(self.network, rows, noise=self.noise, bfloat16=self.in_bfloat16, target=NetworkOutput(*parts))
            assert ran.target is not None  # as one was given
            face_weight = view.faces(batch.face_weight)
            face_weight = face_weight if view.face_mask is None else face_weight * view.face_mask
            weights = face_weight, self._component_weight(batch, view)
            losses = weighted(ran.normalised, ran.target, self.network, self.config, *weights)
            view.add_to(output, ran.output)
            terms = terms + torch.stack(losses)
        return compose(output, now.newest, residual=residual), terms

    def _by_kernels(self, batch: UnrolledBatch, seen: Seen, now: Now, k: int) -> tuple[Step, torch.Tensor]:
        """The same on a CPU, where what follows the network is one launch for all numbers of the faces of a view."""
        scene, network, newest = batch.scene, self.network, now.newest
        physical, residual = self.config.units == "physical", network.config.residual
        wanted = scene.centroids(batch.recorded[k]) - scene.centroids(now.vertices)
        if residual:
            wanted = wanted - newest.body_velocity
        velocity = torch.zeros_like(wanted)
        rows, moved = [], wanted.new_zeros(())
        for view in scene.layout.views:
            inputs = self._rows(batch, view, seen)
            said, turn = normalised(network, inputs, noise=self.noise, bfloat16=self.in_bfloat16)
            assert turn is not None  # as the rows have one
            assert inputs.mirrored is not None
            rows.append(Rows(view.index, inputs.mirrored, turn, said.psi.float(), said.singular_values.float()))
            way = rotate_vectors(mirror_rows(network.denormalise(said).velocity, VELOCITY, inputs.mirrored), turn.mT)
            view.add_velocities(velocity, way)
            target = mirror_rows(rotate_vectors(view.components(wanted), turn), VELOCITY, inputs.mirrored)
            apart = (said.velocity.float() - (target - network.q_mean) / network.q_std).abs()
            apart = apart * network.q_std if physical else apart
            moved = moved + (apart.sum(dim=-1) * self._component_weight(batch, view)).sum()
        deviations = torch.cat([network.psi_std, network.singular_value_std])
        phi = now.features[:, LAYOUT["deformation_gradient"]].reshape(-1, 3, 3)
        psi, values, of_faces = trained_steps(
            phi,
            rows,
            Wanted(
                torch.cat([deviations, network.psi_mean, network.singular_value_mean]),
                deviations if physical else torch.ones_like(deviations),
                batch.face_weight,
                newest.body_rotation if residual else torch.eye(3).expand(len(phi), 3, 3),
                *batch.stretched[k],
            ),
        )
        step = Step(psi, values, velocity + newest.body_velocity if residual else velocity)
        return step, torch.stack(summed(of_faces[0], of_faces[1], moved, self.config))

    @staticmethod
    def _rows(batch: UnrolledBatch, view: PaddedView, seen: Seen) -> RowInputs:
        """What the network reads for the rows of a view."""
        garment = batch.scene.packed.garment_of_face[view.face_index[:, 0]].long()
        return view.inputs(seen.features, seen.velocities, seen.outside)._replace(
            turn=batch.turn[garment],
            rest_turn=batch.joint[garment],
            mirrored=batch.mirrored[garment],
            live=tuple(view.faces(frame) for frame in seen.live),
        )

    @staticmethod
    def _component_weight(batch: UnrolledBatch, view: PaddedView) -> torch.Tensor:
        """How much each component of a view counts, [R,C]."""
        garment = batch.scene.packed.garment_of_face[view.face_index[:, 0]].long()
        share = view.share[:, None] / batch.components * batch.counted[garment][:, None]
        weight = share.expand(view.component_index.shape)
        return weight if view.component_mask is None else weight * view.component_mask


def certainty(batch: UnrolledBatch, floor: float) -> torch.Tensor:
    """How much a vertex counts in the position loss, e / (floor d + e), by the mean distance d of its faces from the
    body in the last known frame; float32 [V]."""
    faces = batch.scene.packed.faces.long()
    outside = batch.features[:, LAYOUT["signed_distance"]].detach().clamp(min=0.0)
    around = outside.new_zeros(len(batch.vertices), 2)
    for corner in faces.T:
        around.index_add_(0, corner, torch.cat([outside, torch.ones_like(outside)], dim=1))
    distance = around[:, 0] / around[:, 1].clamp(min=1.0)
    return KNOWN / (floor * distance + KNOWN)
