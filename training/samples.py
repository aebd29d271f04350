"""Training samples: histories of perturbed garments, as the network will meet them in a rollout, and what it should
answer.

A sample is a sequence and its newest history frame t; the target is frame t + 1. Frames before the first repeat it,
with a body at rest, exactly as a cold start does. Garment positions of the history are displaced (by `noise`, or by
what a rollout of the network itself did wrong), and everything is recomputed from the displaced positions, the answer
too:

    Psi = Phi_{t+1} (Phi~_t)^-1      Sigma = Sigma_{t+1}      q = z_{t+1} - z~_t            (~ displaced)

so the answer leads back to the recorded motion. A batch is built with one launch of the feature kernel over all faces
and frames. Its samples have the same number of faces N, a random subset of each garment's, so nothing is padded but
components.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from warpgarment.body import BodyMotion
from warpgarment.heading import rotation_about_up, yaw
from warpgarment.kernels.deformation import (
    deformation_gradient_from_inverse,
    inverse_rest_frames,
    relative_deformation_gradient,
    singular_values,
)
from warpgarment.kernels.features import FEATURES, LAYOUT, face_features
from warpgarment.kernels.laplacian import components
from warpgarment.parametrisation import NetworkOutput, Step, context, targets
from warpgarment.training.interactions import COLUMNS, UnusableSequence, cached, unpack
from warpgarment.training.noise import NoiseBasis, NoiseConfig

MIRROR = torch.tensor([-1.0, 1.0, 1.0])
MIRROR_MATRIX = torch.outer(MIRROR, MIRROR).flatten()


class Batch(NamedTuple):
    """Training samples; lengths in metres, in the network's frame (turned to its heading, mirrored, as the settings
    say)."""

    features: torch.Tensor  # [B,N,H*34] oldest first
    velocities: torch.Tensor  # [B,C,(H-1)*3]
    weights: torch.Tensor  # [B,N,N] geodesic
    velocity_mask: torch.Tensor | None  # [B,C] bool; None where all garments have C components
    target: NetworkOutput  # what the network should say
    ids: list[tuple[str, int]]  # sequence, newest frame


@dataclass(frozen=True)
class Augmentation:
    """Symmetries of the problem. `mirror`: share of samples mirrored in x; `yaw`: standard deviation [degrees] of a
    joint turn of world and rest pose; `world_yaw`: turn the world by any angle (for networks with heading
    "world")."""

    mirror: float = 0.5
    yaw: float = 5.0
    world_yaw: bool = False


class SequenceData:
    """One sequence, ready to be sampled: tensors on the device, small things precomputed.

    Args:
        sequence: A loaded `dataset.Sequence`.
        folder: Where it lies.
        cache: Cache root of `interactions`.
        network: The `NetworkConfig` samples are made for.
        device: Where samples are built.
    """

    def __init__(self, sequence, folder: Path, cache: Path, network, device: torch.device) -> None:
        garment = sequence.garment
        self.name, self.device, self.source = Path(folder).name, device, sequence
        recorded = np.asarray(sequence.vertices, np.float32)
        if len(recorded) < network.history + 1:
            raise UnusableSequence(f"{len(recorded)} frames, fewer than history + 1 = {network.history + 1}")
        if not np.isfinite(recorded).all():
            frame = int(np.nonzero(~np.isfinite(recorded).all(axis=(1, 2)))[0][0])
            raise UnusableSequence(f"garment positions are not finite from frame {frame}")
        interaction, geodesics = cached(sequence, folder, cache, device)
        if len(interaction) + 1 < network.history + 1:
            raise UnusableSequence(f"the body has only {len(interaction) + 1} frames")
        recorded = recorded[: len(interaction) + 1]
        self.vertices = torch.as_tensor(recorded if recorded.flags.writeable else recorded.copy(), device=device)
        self.interaction = torch.from_numpy(_writable(interaction)).to(device)
        self.faces = torch.as_tensor(np.array(garment.faces, np.int32), device=device)
        self.rest = torch.as_tensor(np.array(garment.vertices, np.float32), device=device)
        self.inverse_rest = inverse_rest_frames(self.rest, self.faces)
        self._geodesics, self._network, self._kernel = geodesics, network, None

        vertex_component, self.components = _components(len(self.rest), garment.faces)
        self.face_component = torch.as_tensor(vertex_component[garment.faces[:, 0]], dtype=torch.int64, device=device)
        self.component_weights = _mean_weights(garment.faces, vertex_component, self.components).to(device)  # [C,V]
        share = np.bincount(np.asarray(garment.faces).ravel(), minlength=len(self.rest)) / (3.0 * len(garment.faces))
        self.garment_weights = torch.as_tensor(share, dtype=torch.float32, device=device)  # [V]
        self.noise = NoiseBasis(np.asarray(garment.faces), vertex_component, np.asarray(garment.pins))

        velocity = self.interaction[..., COLUMNS["velocity"]]
        hot = torch.nn.functional.one_hot(self.face_component, self.components).to(velocity.dtype)
        hot = hot / hot.sum(dim=0).clamp(min=1.0)
        self.body_velocity = torch.einsum("fc,tfk->tck", hot, velocity)  # [T-1,C,3], over all faces
        self.yaw = self._yaw()  # [T-1]

    @cached_property
    def body(self) -> BodyMotion:
        """The collider, for rollouts."""
        return self.source.body()

    @property
    def count(self) -> int:
        """Number of samples: newest frames 0..T-2."""
        return len(self.vertices) - 1

    def _yaw(self) -> torch.Tensor:
        angles = []
        for vertices in self.vertices[:-1]:
            phi = deformation_gradient_from_inverse(self.inverse_rest, vertices.contiguous(), self.faces)
            angles.append(yaw(phi[None]))
        return torch.cat(angles)

    @property
    def kernel(self) -> torch.Tensor:
        """exp(-(D/r)^p), float16 [F,F]: geodesic weights of any subset of faces are its rows, divided by their sums."""
        if self._kernel is None:
            distances = torch.from_numpy(np.array(self._geodesics))
            kernel = torch.exp(-((distances / self._network.geodesic_radius) ** self._network.geodesic_power))
            self._kernel = kernel.to(device=self.device, dtype=torch.float16)
        return self._kernel


def _writable(array: np.ndarray) -> np.ndarray:
    """The same memory map, copy-on-write, so that torch takes it without a warning; nothing is read yet."""
    if isinstance(array, np.memmap):
        return np.load(array.filename, mmap_mode="c")
    return array


def _components(vertex_count: int, faces: np.ndarray) -> tuple[np.ndarray, int]:
    vertex_component, _, count = components(vertex_count, np.asarray(faces))
    return np.asarray(vertex_component), int(count)


def _mean_weights(faces: np.ndarray, vertex_component: np.ndarray, count: int) -> torch.Tensor:
    """[C,V] weights whose product with vertices is the mean face centroid of each component."""
    weights = np.zeros((count, len(vertex_component)))
    corners = np.asarray(faces).ravel()
    np.add.at(weights, (vertex_component[corners], corners), 1.0)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    return torch.as_tensor(weights, dtype=torch.float32)


class SampleBuilder:
    """Builds batches.

    Args:
        sequences: Training sequences.
        network: Their `NetworkConfig`.
        noise: Perturbation of histories.
        augmentation: Mirror and turns.
    """

    def __init__(self, sequences: list[SequenceData], network, noise: NoiseConfig, augmentation: Augmentation) -> None:
        self.sequences, self.network = sequences, network
        self.noise, self.augmentation = noise, augmentation
        self.device = sequences[0].device

    @torch.no_grad()
    def build(
        self,
        picks: list[tuple[int, int]],
        faces: int,
        rng: np.random.Generator,
        displacements: list[np.ndarray | None] | None = None,
    ) -> Batch:
        """Builds one batch.

        Args:
            picks: Sequence index and newest frame of each sample.
            faces: Number N of faces per sample; every garment has as many.
            rng: All randomness comes from here.
            displacements: Per sample None or [K,V,3] metres, K <= history: an override of the newest K frames, relative
                to the recorded positions; noise comes on top.

        Returns:
            The batch, on the sequences' device.
        """
        history, device, count = self.network.history, self.device, len(picks)
        canonical = self.network.heading == "canonical"
        components = max(self.sequences[s].components for s, _ in picks)
        angles = np.zeros((count, 2), np.float32)  # of the world, of world and rest together
        angles[:, 1] = rng.standard_normal(count) * np.radians(self.augmentation.yaw)
        if self.augmentation.world_yaw and not canonical:
            angles[:, 0] = rng.uniform(-np.pi, np.pi, count)
        mirrored = rng.random(count) < self.augmentation.mirror
        world = torch.as_tensor(angles[:, 0]).to(device)
        if canonical:
            world = -torch.stack([self.sequences[s].yaw[t] for s, t in picks])
        joint = rotation_about_up(torch.as_tensor(angles[:, 1]).to(device))
        turn = joint @ rotation_about_up(world)  # [B,3,3]

        positions, following, corners, next_corners, means = [], [], [], [], []
        rows = torch.empty(count, faces, history, 16, device=device)
        inverse_rest = torch.empty(count, faces, 3, 3, device=device)
        weights = torch.empty(count, faces, faces, device=device)
        velocities = torch.zeros(count, components, (history - 1) * 3, device=device)
        velocity = torch.zeros(count, components, 3, device=device)
        body_velocity = torch.zeros(count, components, 3, device=device)
        origin = torch.empty(count, 1, 3, device=device)
        start, next_start = 0, 0
        for b, (s, t) in enumerate(picks):
            sequence = self.sequences[s]
            subset = np.sort(rng.permutation(len(sequence.faces))[:faces])
            subset = torch.from_numpy(subset).to(device)
            raw = torch.arange(t - history + 1, t + 1)
            frames = raw.clamp(min=0).to(device)
            past = sequence.vertices[frames]
            delta = self._displacement(sequence, rng, displacements[b] if displacements else None)
            if delta is not None:
                first = max(history - 1 - t, 0)  # frames before the first repeat it, displaced as it is
                past = past + torch.from_numpy(delta[np.maximum(np.arange(history), first)]).to(device)
            mean = sequence.garment_weights @ past[-1]
            origin[b] = mean
            past = (past - mean) @ turn[b].mT
            after = (sequence.vertices[t + 1] - mean) @ turn[b].mT
            centres = torch.einsum("cv,hvk->hck", sequence.component_weights, past)
            velocities[b, : sequence.components] = (centres[1:] - centres[:-1]).transpose(0, 1).flatten(1)
            velocity[b, : sequence.components] = sequence.component_weights @ after - centres[-1]
            body_velocity[b, : sequence.components] = sequence.body_velocity[t] @ turn[b].mT
            rows[b] = sequence.interaction[frames[None, :], subset[:, None]]
            early = int((raw < 0).sum())
            if early:
                rows[b, :, :early, COLUMNS["deformation"]] = torch.eye(3, device=device).flatten()
                rows[b, :, :early, COLUMNS["velocity"]] = 0.0
            inverse_rest[b] = sequence.inverse_rest[subset]
            kernel = sequence.kernel[subset[:, None], subset[None, :]].float()
            torch.div(kernel, kernel.sum(dim=1, keepdim=True), out=weights[b])
            chosen, vertices = sequence.faces[subset], past.shape[1]
            steps = torch.arange(history, dtype=torch.int32, device=device) * vertices + start
            corners.append(chosen[:, None, :] + steps[None, :, None])
            next_corners.append(chosen + next_start)
            positions.append(past.reshape(-1, 3))
            following.append(after)
            means.append(sequence.garment_weights @ past)
            start, next_start = start + history * vertices, next_start + vertices

        if self.augmentation.yaw:
            inverse_rest = inverse_rest @ joint[:, None].mT
        self._turn(rows, turn, origin)
        stacked = inverse_rest[:, :, None].expand(-1, -1, history, -1, -1).reshape(-1, 3, 3)
        garment = torch.arange(count * history, dtype=torch.int32, device=device).reshape(count, 1, history)
        features = face_features(
            stacked, torch.cat(positions), torch.cat(corners).reshape(-1, 3),
            garment.expand(-1, faces, -1).reshape(-1).contiguous(), torch.cat(means), unpack(rows.reshape(-1, 16)),
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
            features, velocities, target = mirror(features, velocities, target, torch.from_numpy(mirrored).to(device))
        real = torch.tensor([self.sequences[s].components for s, _ in picks], device=device)
        mask = torch.arange(components, device=device)[None] < real[:, None]
        ids = [(self.sequences[s].name, t) for s, t in picks]
        return Batch(features, velocities, weights, None if mask.all() else mask, target, ids)

    def _displacement(
        self, sequence: SequenceData, rng: np.random.Generator, override: np.ndarray | None
    ) -> np.ndarray | None:
        """[history,V,3]: noise plus the override of the newest frames; None where there is neither."""
        delta = sequence.noise.displacement(self.network.history, self.noise, rng)
        if override is not None:
            if delta is None:
                delta = np.zeros((self.network.history, *override.shape[1:]), np.float32)
            delta[-len(override) :] += override
        return delta

    @staticmethod
    def _turn(rows: torch.Tensor, turn: torch.Tensor, origin: torch.Tensor) -> None:
        """Turns interactions [B,N,H,16] in place, about each garment's origin."""
        back = turn.mT
        flat = rows.flatten(1, 2)
        flat[..., COLUMNS["closest"]] = (flat[..., COLUMNS["closest"]] - origin) @ back
        flat[..., COLUMNS["velocity"]] = flat[..., COLUMNS["velocity"]] @ back
        # (G D G^T) row-major is (G kron G) applied to D row-major
        both = torch.einsum("bij,bkl->bikjl", turn, turn).reshape(-1, 9, 9)
        flat[..., COLUMNS["deformation"]] = flat[..., COLUMNS["deformation"]] @ both.mT


def mirror(
    features: torch.Tensor, velocities: torch.Tensor, target: NetworkOutput, chosen: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, NetworkOutput]:
    """Samples as a mirror in x shows them: v -> M v, maps A -> M A M, M = diag(-1, 1, 1); distances stay.

    The mirrored garment's faces run the other way round, so that its normals point outward; they are M n.

    Args:
        features: [B,N,H*34].
        velocities: [B,C,K*3].
        target: [B,N,3,3], [B,N,3], [B,C,3].
        chosen: Which samples, bool [B].
    """
    sign = torch.ones(FEATURES)
    for name in ("deformation_gradient", "body_deformation"):
        sign[LAYOUT[name]] = MIRROR_MATRIX
    for name in ("normal", "centroid", "direction_to_body", "body_velocity"):
        sign[LAYOUT[name]] = MIRROR

    def signs(values: torch.Tensor, width: int) -> torch.Tensor:
        values = values.to(features.device).repeat(width // len(values))
        return torch.where(chosen[:, None], values, torch.ones_like(values))[:, None]

    psi = target.psi.flatten(-2)
    return (
        features * signs(sign, features.shape[-1]),
        velocities * signs(MIRROR, velocities.shape[-1]),
        target._replace(
            psi=(psi * signs(MIRROR_MATRIX, 9)).unflatten(-1, (3, 3)), velocity=target.velocity * signs(MIRROR, 3)
        ),
    )
