"""Training samples of single steps: perturbed histories, similar to those of a rollout, and targets.

A sample is a sequence and the newest frame t of a history; the target is frame t + 1. Frames before the first one
repeat it, with a body at rest, exactly as in a cold start. Garment positions of the history are displaced (by `noise`,
or by errors of the network in a rollout), and everything is recomputed from the displaced positions, also the target:

    Psi = Phi_{t+1} (Phi~_t)^-1      Sigma = Sigma_{t+1}      q = z_{t+1} - z~_t            (~ displaced)

so the target leads back to the recorded motion. A batch is built with one launch of the feature kernel over all faces
and frames. Its samples have the same number of faces N, a random subset of each garment's faces, so only components are
padded. Networks without `Architecture.subsets` are finally trained on whole garments; these are padded with copies of a
face, which the loss ignores.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from warpgarment.kernels.deformation.gradients import deformation_gradient_from_inverse, relative_deformation_gradient
from warpgarment.kernels.deformation.svd import singular_values
from warpgarment.kernels.features.channels import FEATURES, INTERACTION, LAYOUT, OUTDOOR
from warpgarment.kernels.features.face import face_features
from warpgarment.kernels.features.outdoor import attributes, columns, face_velocity
from warpgarment.nn.architecture import architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.flops import work
from warpgarment.nn.heading import rotation_about_up
from warpgarment.nn.parametrisation import NetworkOutput, Step, context, targets
from warpgarment.nn.run import mirror_rows

from .augmentation import Augmentation, mirror
from .drawing import Past, displacement, part_of
from .interactions import unpack
from .noise import NoiseConfig
from .recorded import SequenceData

__all__ = ["Augmentation", "Batch", "SampleBuilder", "SequenceData", "mirror"]


class Batch(NamedTuple):
    """Training samples in the network's frame, that is turned to its heading and mirrored; lengths in metres."""

    features: torch.Tensor  # [B,N,H*34] oldest first
    velocities: torch.Tensor  # [B,C,(H-1)*3]
    weights: Any  # from `Architecture.rows`, for example geodesic weights [B,N,N]
    velocity_mask: torch.Tensor | None  # [B,C] bool; None where all garments have C components
    components: torch.Tensor  # scalar: number of components in the whole batch, times the share of this part of it
    target: NetworkOutput
    ids: list[tuple[str, int]]  # name of the sequence, newest frame
    face_mask: torch.Tensor | None = None  # [B,N] bool; None where all are real
    faces: torch.Tensor | None = None  # scalar like `components`, for real faces; None where all are real
    outdoor: torch.Tensor | None = None  # [B,N,K] channels of material and wind; None for networks without

    def work(self, config: NetworkConfig) -> tuple[int, int]:
        """Number of samples, and of operations of a training step on them (`nn/flops.py`)."""
        samples, faces = self.features.shape[:2]
        return samples, work(config, [(samples, faces, self.velocities.shape[1], self.weights)])

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays that are saved if the loss of the batch is not finite."""
        weights = {"weights": self.weights} if isinstance(self.weights, torch.Tensor) else _tensors(self.weights)
        tensors = {"features": self.features, "velocities": self.velocities, **weights, **self.target._asdict()}
        return {name: tensor.cpu().numpy() for name, tensor in tensors.items()}


def _tensors(layout: Any) -> dict[str, torch.Tensor]:
    """The tensors among the fields of a named tuple, by name; empty for any other object."""
    fields = layout._asdict() if hasattr(layout, "_asdict") else {}
    return {name: value for name, value in fields.items() if isinstance(value, torch.Tensor)}


class SampleBuilder:
    """Builds batches of single-step samples.

    Args:
        sequences: Training sequences.
        network: Settings of the network.
        noise: Perturbation of histories.
        augmentation: Mirroring, turns and changes of size.
    """

    def __init__(
        self, sequences: list[SequenceData], network: NetworkConfig, noise: NoiseConfig, augmentation: Augmentation
    ) -> None:
        self.sequences, self.network = sequences, network
        self.noise, self.augmentation = noise, augmentation
        self.device = sequences[0].device
        self.kind = architecture(network.architecture)
        self.subsets = self.kind.subsets
        self.outdoor = OUTDOOR.only(network.outdoor)

    def reaches(self, sequence: int, newest: int) -> bool:
        """Whether the frame after `newest` is recorded."""
        return self.sequences[sequence].pieces.reaches(newest, 1)

    @torch.no_grad()
    def build(
        self,
        picks: list[tuple[int, int]],
        faces: int | None,
        rng: np.random.Generator,
        displacements: list[np.ndarray | None] | None = None,
        part: slice = slice(None),
    ) -> Batch:
        """Builds one batch, or a part of it.

        Args:
            picks: Sequence index and newest frame of each sample.
            faces: Number N of faces per sample, a random subset of each garment's, which must have at least as many.
                None, for a kind of network without `subsets`, takes all faces of every garment.
            rng: Source of all randomness: sample b draws from the b-th stream that it spawns.
            displacements: For each sample None, or displacements of the newest K frames from the recorded positions
                [m], shape [K,V,3] with K <= history; noise is added to them.
            part: Slice of the samples to build.

        Returns:
            The batch, on the device of the sequences.
        """
        all_faces = sum(len(self.sequences[s].faces) if faces is None else faces for s, _ in picks)
        whole = [self.sequences[s].components for s, _ in picks]
        picks, streams, overrides = part_of(picks, rng, displacements, part)
        real = whole[part]
        history, device, count, components = self.network.history, self.device, len(picks), max(real)
        sizes = [len(self.sequences[s].faces) if faces is None else faces for s, _ in picks]
        whole_garments, faces = faces is None, max(sizes)
        turn, similarity, joint, mirrored, scale = self._drawn(picks, streams)

        positions, following, corners, next_corners, means = [], [], [], [], []
        rows = torch.empty(count, faces, history, INTERACTION.width, device=device)
        inverse_rest = torch.empty(count, faces, 3, 3, device=device)
        shown: list[tuple[Any, np.ndarray | None]] = []
        velocities = torch.zeros(count, components, (history - 1) * 3, device=device)
        velocity = torch.zeros(count, components, 3, device=device)
        body_velocity = torch.zeros(count, components, 3, device=device)
        origin = torch.empty(count, 1, 3, device=device)
        outside = torch.empty(count, faces, self.outdoor.width, device=device) if self.outdoor.width else None
        start, next_start = 0, 0
        for b, (s, t) in enumerate(picks):
            sequence, rng = self.sequences[s], streams[b]
            if whole_garments:
                subset = np.arange(faces)
                subset[sizes[b] :] = 0
            else:
                subset = np.sort(rng.permutation(len(sequence.faces))[:faces])
            shown.append((sequence.shown, None if whole_garments else subset))
            seen = self._send(subset)
            begins = Past.of(t, history, device)
            past = sequence.vertices[begins.frames]
            delta = displacement(sequence, history, self.noise, rng, overrides[b])
            if delta is not None:
                past = past + self._send(begins.held(delta))
            mean = sequence.garment_weights @ past[-1]
            origin[b] = mean
            past = (past - mean) @ similarity[b].mT
            after = (sequence.vertices[t + 1] - mean) @ similarity[b].mT
            centres = torch.einsum("cv,hvk->hck", sequence.component_weights, past)
            if outside is not None:
                outside[b] = self._outdoor(sequence, seen, past, sequence.air[t + 1] @ similarity[b].mT)
            velocities[b, : sequence.components] = (centres[1:] - centres[:-1]).transpose(0, 1).flatten(1)
            velocity[b, : sequence.components] = sequence.component_weights @ after - centres[-1]
            body_velocity[b, : sequence.components] = sequence.body_velocity[t] @ similarity[b].mT
            rows[b] = sequence.interaction[begins.frames[None, :], seen[:, None]]
            rows[b, :, : begins.early] = INTERACTION.still(rows[b, :, : begins.early])
            inverse_rest[b] = sequence.inverse_rest[seen]
            chosen, vertices = sequence.faces[seen], past.shape[1]
            steps = torch.arange(history, dtype=torch.int32, device=device) * vertices + start
            corners.append(chosen[:, None, :] + steps[None, :, None])
            next_corners.append(chosen + next_start)
            positions.append(past.reshape(-1, 3))
            following.append(after)
            means.append(sequence.garment_weights @ past)
            start, next_start = start + history * vertices, next_start + vertices

        if self.augmentation.yaw:
            inverse_rest = inverse_rest @ joint[:, None].mT
        if self.augmentation.scale:  # edges are longer, normals are not
            inverse_rest[:, :, :2] /= self._send(scale)[:, None, None, None]
        rows = self._turned(rows, turn, self._send(scale), origin)
        stacked = inverse_rest[:, :, None].expand(-1, -1, history, -1, -1).reshape(-1, 3, 3)
        garment = torch.arange(count * history, dtype=torch.int32, device=device).reshape(count, 1, history)
        features = face_features(
            stacked, torch.cat(positions), torch.cat(corners).reshape(-1, 3),
            garment.expand(-1, faces, -1).reshape(-1).contiguous(), torch.cat(means), unpack(rows.flatten(0, 2)),
        ).reshape(count, faces, history * FEATURES)  # fmt: skip
        phi_next = deformation_gradient_from_inverse(
            inverse_rest.reshape(-1, 3, 3), torch.cat(following), torch.cat(next_corners)
        )
        phi = features[..., -FEATURES:][..., LAYOUT["deformation_gradient"]].reshape(-1, 3, 3).contiguous()
        step = Step(
            relative_deformation_gradient(phi_next, phi).reshape(count, faces, 3, 3),
            singular_values(phi_next).reshape(count, faces, 3),
            velocity,
        )
        face_component = torch.zeros(count, faces, dtype=torch.int64, device=device)
        newest = context(features, face_component, 1)._replace(body_velocity=body_velocity)
        target = targets(step, newest, residual=self.network.residual)
        if mirrored.any():
            chosen = self._send(mirrored)
            features, velocities, target = mirror(features, velocities, target, chosen)
            outside = None if outside is None else mirror_rows(outside, self.outdoor, chosen)
        mask = None
        if min(real) < components:
            mask = self._send(np.arange(components)[None] < np.array(real)[:, None])
        share = torch.full((), sum(whole) * count / len(whole), device=device)
        ids = [(self.sequences[s].name, t) for s, t in picks]
        weights = self.kind.rows(shown, self.network, device, scale)
        if self.subsets and not whole_garments:
            return Batch(features, velocities, weights, mask, share, target, ids, outdoor=outside)
        face_mask = None
        if min(sizes) < faces:
            face_mask = self._send(np.arange(faces)[None] < np.array(sizes)[:, None])
        total = torch.full((), all_faces * count / len(whole), device=device)
        return Batch(features, velocities, weights, mask, share, target, ids, face_mask, total, outside)

    def _outdoor(
        self, sequence: SequenceData, chosen: torch.Tensor, past: torch.Tensor, air: torch.Tensor
    ) -> torch.Tensor:
        """Outdoor channels of the chosen faces [N,K], from a history [H,V,3] and the air [3] in the same frame."""
        velocity = face_velocity(past[-1], past[-2], sequence.faces[chosen], self.network.fps)
        cloth = attributes(sequence.material[None], velocity, 1).expand(len(chosen), -1)
        return columns(self.outdoor, cloth, air.expand_as(velocity), velocity)

    def _drawn(
        self, picks: list[tuple[int, int]], streams: list[np.random.Generator]
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, np.ndarray, np.ndarray]:
        """Draws for each sample: turn of the world [B,3,3], the turn times the scale, the part of the turn that the
        rest pose shares, whether the sample is mirrored [B], and its scale [B]."""
        settings, count = self.augmentation, len(picks)
        canonical = self.network.heading == "canonical"
        angles = np.zeros((2, count), np.float32)  # of the world, of world and rest together
        mirrored, scale = np.zeros(count, bool), np.ones(count, np.float32)
        for b, rng in enumerate(streams):
            angles[1, b] = rng.standard_normal() * np.radians(settings.yaw)
            angles[0, b] = rng.uniform(-np.pi, np.pi)
            mirrored[b] = rng.random() < settings.mirror
            scale[b] = 1.0 + settings.scale * rng.uniform(-1.0, 1.0)
        world, both = self._send(angles)
        if canonical:
            world = -torch.stack([self.sequences[s].yaw[t] for s, t in picks])
        elif not settings.world_yaw:
            world = torch.zeros_like(world)
        joint = rotation_about_up(both)
        turn = joint @ rotation_about_up(world)
        return turn, turn * self._send(scale)[:, None, None], joint, mirrored, scale

    def _send(self, array: np.ndarray) -> torch.Tensor:
        """Copies an array to the device, from pinned memory, so that the host does not wait."""
        values = torch.from_numpy(np.ascontiguousarray(array))
        if self.device.type != "cuda":
            return values.to(self.device)
        return values.pin_memory().to(self.device, non_blocking=True)

    @staticmethod
    def _turned(rows: torch.Tensor, turn: torch.Tensor, scale: torch.Tensor, origin: torch.Tensor) -> torch.Tensor:
        """Interactions [B,N,H,16], turned and scaled about the origin of each garment [B,1,3]."""
        flat = INTERACTION.centred(rows.flatten(1, 2), origin)
        return (flat @ INTERACTION.turn(turn, scale=scale).mT).reshape(rows.shape)
