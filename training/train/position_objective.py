r"""Training of networks that predict positions, on rollouts that grow (LayersNet, supplement C.1).

    K steps without gradient  ->  G steps, each with the loss

K grows with the progress of the run from 0 to `rollout`. For each sample a random step 0..K is drawn before which its
inputs are the recorded frames, displaced as in one-step training, and from which they are its own predictions. Lengths
in the loss are in decimetres, the size of the publication's scenes:

    L = position * mean |x - x*|^2 + patch * mean |x_p - x*_p|^2 + normal * mean |n - n*|^2
        + body * mean_{d < threshold} (threshold - d)^2 + layers * (the same between consecutive garments)

x are vertices, x_p means over patches (of networks that predict them), n unit normals of vertices, d signed distances
to the surface of the body, or of the garment beneath, along the normal of its nearest face where that is within
`reach`. Means of collision terms are over the violators. Nearest faces are found without gradient. These two terms
begin after `collisions_from` of the run.

It departs from the publication in this: distances are to surfaces and not to nearest vertices; each garment is kept
from the next one beneath it, not the outermost from all others together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import nn

from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.nn.architecture import architecture
from warpgarment.nn.inputs import VertexStep
from warpgarment.nn.layers.network import LayersNet
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.run import evaluating
from warpgarment.training.samples.outfits import OutfitBatch

SCALE = 10.0  # metres to decimetres
MOST_AHEAD = 64  # largest `rollout`


@dataclass(frozen=True)
class PositionConfig:
    """Settings of the loss and of the schedule of networks that predict positions.

    Attributes:
        position: Weight of the squared distance of vertices [1/dm^2].
        patch: Weight of the squared distance of the means of patches [1/dm^2].
        normal: Weight of the squared difference of unit normals of vertices.
        body: Weight of collisions with the body [1/dm^2]; 0 for none.
        layers: Weight of collisions between consecutive garments [1/dm^2]; 0 for none.
        rotation: Weight of the network's `rotation_penalty`, for the published form of its rotations.
        threshold: Least distance from the body or the garment beneath [m].
        reach: Distance up to which a garment has to do with the one beneath it [m].
        collisions_from: Share of the run after which collisions count, from 0 to 1.
        noise: Factor of the displacements of histories (`noise`), from which targets come back frame by frame; the
            publication has none.
        to_skin: Share of samples whose history is drawn by a random part of the way to where the garment would be as
            smooth skin of its body (kernels/features/skin.py); targets come back from there frame by frame. Rollouts
            that have lost their way look like that, and one step teaches the way back. The publication has none.
        rollout: Number of steps without gradient before those with a loss, at the end of the run. It grows evenly.
    """

    position: float = 1.0
    patch: float = 1.0
    normal: float = 1.0
    body: float = 1.0
    layers: float = 0.1
    rotation: float = 0.0
    threshold: float = 1e-4
    reach: float = 0.03
    collisions_from: float = 0.1
    noise: float = 0.0
    to_skin: float = 0.0
    rollout: int = 9

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"outfit.{field.name} must be at least 0, got {value}")
        if self.to_skin > 1.0:
            raise ValueError(f"outfit.to_skin is a share of samples, at most 1, got {self.to_skin}")
        if self.rollout > MOST_AHEAD:
            raise ValueError(f"outfit.rollout must be at most {MOST_AHEAD}, got {self.rollout}")


class PositionObjective(nn.Module):
    """Loss of a batch of outfits.

    Args:
        network: The network in training.
        config: Weights and schedule.
        precision: "float32" or "bfloat16".

    Attributes:
        progress: Progress of the run from 0 to 1, by which the schedule goes.
    """

    figures = ("loss", "loss_position", "loss_patch", "loss_normal", "loss_body", "loss_layers", "position_m")

    def __init__(self, network: GarmentNetwork, config: PositionConfig, precision: str) -> None:
        super().__init__()
        self.network, self.config, self.in_bfloat16 = network, config, precision == "bfloat16"
        self.kind, self.progress = architecture(network.config.architecture), 0.0

    @staticmethod
    def inputs(batch: OutfitBatch) -> tuple[OutfitBatch]:
        """The arguments of `forward` for a batch."""
        return (batch,)

    def ahead(self, batch: OutfitBatch) -> int:
        """Number of steps without gradient at the present progress."""
        return min(int(self.progress * (self.config.rollout + 1)), self.config.rollout, batch.ahead)

    def forward(self, batch: OutfitBatch) -> torch.Tensor:
        """The numbers named in `figures`, float32 [7], as means over the steps with a loss."""
        newest, ahead = batch.ahead + 2, self.ahead(batch)
        starts = (batch.draw * (ahead + 1)).long().clamp(max=ahead)[batch.sample_of_vertex]
        recent = self._rolled_out(batch, ahead, starts)
        found = []
        for k in range(batch.steps):
            step = self._step(batch, recent, newest + k)
            wanted = batch.wanted(newest + k + 1, ahead - starts + k + 1)
            found.append(self._losses(batch, step, newest + k + 1, wanted))
            recent = [step.positions, *recent[:2]]
        terms = torch.stack(found).mean(dim=0)
        weights = [getattr(self.config, name[5:]) for name in self.figures[1:6]]
        total = sum((w * term for w, term in zip(weights, terms, strict=False)), terms.new_zeros(()))
        if self.config.rotation:
            assert isinstance(self.network, LayersNet)  # no other network has such rotations
            total = total + self.config.rotation * self.network.rotation_penalty()
        return torch.cat([total[None], terms])

    def _rolled_out(self, batch: OutfitBatch, steps: int, starts: torch.Tensor) -> list[torch.Tensor]:
        """Positions at t, t-1 and t-2 [V,3] after a rollout of some steps without gradient, of which each vertex takes
        those from its number in `starts` [V]."""
        recent = batch.recorded(batch.ahead + 2 - steps)
        if not steps:
            return recent
        with torch.no_grad(), evaluating(self.network):
            for k in range(steps):
                frame = batch.ahead + 2 - steps + k
                after = self._step(batch, recent, frame).positions
                following = [after, *recent[:2]]
                truth = batch.recorded(frame + 1)
                with_truth = (starts > k)[:, None]  # predictions replace the truth later
                recent = [torch.where(with_truth, t, p) for t, p in zip(truth, following, strict=True)]
        return recent

    def _step(self, batch: OutfitBatch, recent: list[torch.Tensor], frame: int) -> VertexStep:
        """Prediction for the frame after one of the batch, with pins as recorded."""
        inputs = batch.inputs(recent, frame, self.network.reads)
        step = self.network.predict(inputs, batch.layout, bfloat16=self.in_bfloat16)
        assert isinstance(step, VertexStep)  # as its kind says
        pins = batch.packed.pins.long()
        return step._replace(positions=step.positions.index_copy(0, pins, batch.frames[frame + 1][pins]))

    def _losses(self, batch: OutfitBatch, step: VertexStep, frame: int, wanted: torch.Tensor) -> torch.Tensor:
        """Terms of the loss without their weights [5], and the mean distance [m], from targets [V,3]."""
        found, faces = step.positions, batch.packed.faces
        difference = found - wanted
        position = (SCALE * difference).square().sum(dim=1).mean()
        patch = position.new_zeros(())
        if step.patches is not None:
            means = self.kind.patch_means(batch.layout, wanted)
            patch = (SCALE * (step.patches - means)).square().sum(dim=1).mean()
        normal = (vertex_normals(found, faces) - vertex_normals(wanted, faces)).square().sum(dim=1).mean()
        late = self.progress >= self.config.collisions_from
        body = self._body(batch, found, frame) if late and self.config.body else position.new_zeros(())
        layers = self._layers(batch, found) if late and self.config.layers else position.new_zeros(())
        return torch.stack([position, patch, normal, body, layers, difference.detach().norm(dim=1).mean()])

    def _body(self, batch: OutfitBatch, positions: torch.Tensor, frame: int) -> torch.Tensor:
        """Collisions with the bodies."""
        on, config = batch.bodies, self.config
        meshes = BodyMeshes(batch.body[frame], on.faces, on.vertex_offsets, on.face_offsets)
        near = meshes.query(positions, batch.sample_of_vertex.int(), within=config.threshold)
        inside = torch.isfinite(near.distance) & (near.distance < config.threshold)
        away = positions.detach() - near.closest
        out = torch.nn.functional.normalize(away, dim=1) * near.distance.sign()[:, None]
        out = torch.where(inside[:, None], out, 0.0)
        reached = torch.where(inside[:, None], near.closest, 0.0)
        return self._hinge(((positions - reached) * out).sum(dim=1), inside)

    def _layers(self, batch: OutfitBatch, positions: torch.Tensor) -> torch.Tensor:
        """Collisions of each garment with the one beneath it in its outfit; that one gets no gradient."""
        packed, config = batch.packed, self.config
        below = torch.roll(batch.sample_of_garment, 1) == batch.sample_of_garment
        below[0] = False
        outer = below[packed.garment_of_vertex.long()].nonzero()[:, 0]
        if not len(outer):
            return positions.new_zeros(())
        fixed = positions.detach()
        meshes = BodyMeshes(fixed, packed.faces, packed.vertex_offsets, packed.face_offsets)
        near = meshes.query(fixed[outer].contiguous(), (packed.garment_of_vertex[outer] - 1).contiguous())
        corners = fixed[packed.faces[near.face.long().clamp(min=0)].long()]
        cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        out = torch.nn.functional.normalize(cross, dim=1)
        distance = ((positions[outer] - near.closest) * out).sum(dim=1)
        inside = (distance < config.threshold) & (near.distance.abs() < config.reach)
        return self._hinge(distance, inside)

    def _hinge(self, distance: torch.Tensor, inside: torch.Tensor) -> torch.Tensor:
        """Mean of (threshold - distance)^2 over the violators [dm^2]; zero without any."""
        lacking = torch.where(inside, SCALE * (self.config.threshold - distance), 0.0)
        return lacking.square().sum() / inside.sum().clamp(min=1)


def vertex_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Unit normals of vertices, from those of their faces weighted by area, [V,3] and [F,3] -> [V,3]."""
    index = faces.long()
    corners = SCALE * vertices[index]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = torch.zeros_like(vertices).index_add(0, index.flatten(), cross.repeat_interleave(3, dim=0))
    return torch.nn.functional.normalize(summed, dim=1, eps=1e-9)
