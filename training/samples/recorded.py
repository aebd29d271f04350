"""One recorded garment on the device, with everything that is the same for all its samples."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgarment.kernels.deformation.gradients import deformation_gradient_from_inverse, inverse_rest_frames
from warpgarment.kernels.features.channels import INTERACTION
from warpgarment.kernels.mesh.laplacian import components
from warpgarment.nn.architecture import architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.heading import yaw
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.training.data.pieces import Pieces
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.data.worn import WornGarment

from .interactions import UnusableSequence, cached
from .noise import NoiseBasis


class SequenceData:
    """One garment of a training sequence as tensors on the device, with precomputed means and interactions.

    Args:
        sequence: The loaded sequence.
        folder: Folder of the sequence.
        cache: Root folder of the cache of `interactions`.
        network: Settings of the network for which samples are made.
        device: Device on which samples are built.
        number: Number of the garment of an outfit, from 0; None for all garments of the sequence as one.

    Attributes:
        material: Fields of its `Material`, float32 [M]; NaN if it has none.
        air: Velocity of the air in each frame [m/s], float32 [T,3].
        pieces: Where its samples are.
        recorded: Whether its positions are those of a recording or a teacher, and not a network's.

    Raises:
        UnusableSequence: The sequence has too few frames, or positions or interactions that are not finite; or its
            pieces have too few known frames.
    """

    def __init__(
        self,
        sequence: Sequence,
        folder: Path,
        cache: Path,
        network: NetworkConfig,
        device: torch.device,
        number: int | None = None,
    ) -> None:
        source = sequence if number is None else WornGarment(sequence, number)
        garment = source.garment
        self.name, self.device, self.source = Path(folder).name, device, source
        recorded = np.asarray(source.vertices, np.float32)
        if len(recorded) < network.history + 1:
            raise UnusableSequence(f"{len(recorded)} frames, fewer than history + 1 = {network.history + 1}")
        if not np.isfinite(recorded).all():
            frame = int(np.nonzero(~np.isfinite(recorded).all(axis=(1, 2)))[0][0])
            raise UnusableSequence(f"garment positions are not finite from frame {frame}")
        interaction, geodesics = (None if a is None else _writable(a) for a in cached(sequence, folder, cache, device))
        assert interaction is not None
        if isinstance(source, WornGarment):
            self.name, own = f"{self.name}{source.name.removeprefix(sequence.name)}", source.faces
            interaction, geodesics = interaction[:, own], None if geodesics is None else geodesics[own, own]
        if len(interaction) + 1 < network.history + 1:
            raise UnusableSequence(f"the body has only {len(interaction) + 1} frames")
        recorded = recorded[: len(interaction) + 1]
        self.vertices = torch.as_tensor(recorded if recorded.flags.writeable else recorded.copy(), device=device)
        self.interaction = torch.from_numpy(interaction).to(device)
        self.faces = torch.as_tensor(np.array(garment.faces, np.int32), device=device)
        self.rest = torch.as_tensor(np.array(garment.vertices, np.float32), device=device)
        self.inverse_rest = inverse_rest_frames(self.rest, self.faces)
        self._geodesics, self._network = geodesics, network

        vertex_component, self.components = _components(len(self.rest), garment.faces)
        self.face_component = torch.as_tensor(vertex_component[garment.faces[:, 0]], dtype=torch.int64, device=device)
        self.component_weights = _mean_weights(garment.faces, vertex_component, self.components).to(device)  # [C,V]
        share = np.bincount(np.asarray(garment.faces).ravel(), minlength=len(self.rest)) / (3.0 * len(garment.faces))
        self.garment_weights = torch.as_tensor(share, dtype=torch.float32, device=device)  # [V]
        self.noise = NoiseBasis(np.asarray(garment.faces), vertex_component, np.asarray(garment.pins))

        material = source.materials[0] if len(source.materials) == 1 else None
        fields = (np.nan,) * len(dataclasses.fields(Material)) if material is None else dataclasses.astuple(material)
        self.material = torch.tensor(fields, dtype=torch.float32, device=device)
        wind = np.zeros((len(recorded), 3)) if source.wind is None else source.wind[: len(recorded)]
        self.air = torch.as_tensor(np.array(wind, np.float32), device=device)
        self.recorded = bool(sequence.manifest.get("recorded", True))
        self.pieces = Pieces.of(sequence.name, sequence.manifest, len(self.vertices))
        if not self.pieces.whole and self.pieces.known < network.history:
            raise UnusableSequence(
                f"its pieces begin with {self.pieces.known} known frames, and the network reads {network.history}"
            )

        velocity = self.interaction[..., INTERACTION.slices["velocity"]]
        hot = torch.nn.functional.one_hot(self.face_component, self.components).to(velocity.dtype)
        hot = hot / hot.sum(dim=0).clamp(min=1.0)
        self.body_velocity = torch.einsum("fc,tfk->tck", hot, velocity)  # [T-1,C,3], over all faces
        self.yaw = self._yaw()  # [T-1]

    @cached_property
    def body(self) -> BodyMotion:
        """The part of the body with which cloth collides, for rollouts."""
        return self.source.body()

    @cached_property
    def garment(self) -> Garment:
        """The garment, with the cached geodesics, for unrolled samples."""
        garment = self.source.garment
        if self._geodesics is not None:
            garment.__dict__.setdefault("geodesics", self._geodesics)
        return garment

    def body_frames(self, frames: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """The colliding part of the body in some frames: vertices [m], shape [T,U,3], and faces [G,3]."""
        used, faces = self._collider
        return self.source.body_vertices_in(frames, used), faces

    @cached_property
    def _collider(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the body's vertices that colliding faces use [U], and these faces as indices into them [G,3]."""
        faces = self.source.body_in([0]).faces[self.source.collider_faces]
        used, inverse = np.unique(faces, return_inverse=True)
        return used, inverse.reshape(-1, 3)

    @cached_property
    def shown(self) -> Any:
        """How the garment's faces lie on the cloth, from `Architecture.sampled`; an argument of `Architecture.rows`."""
        kind = architecture(self._network.architecture)
        return kind.sampled(kind.geometry(self.garment, self._network), self._network, self.device)

    @property
    def count(self) -> int:
        """Number of samples of one step."""
        return len(self.pieces.newest(1))

    def _yaw(self) -> torch.Tensor:
        angles = []
        for vertices in self.vertices[:-1]:
            phi = deformation_gradient_from_inverse(self.inverse_rest, vertices.contiguous(), self.faces)
            angles.append(yaw(phi[None]))
        return torch.cat(angles)


def _writable(array: np.ndarray) -> np.ndarray:
    """The same file mapped copy-on-write, which torch accepts without a warning; nothing is read yet."""
    if isinstance(array, np.memmap) and array.filename is not None:
        return np.load(array.filename, mmap_mode="c")
    return array


def _components(vertex_count: int, faces: np.ndarray) -> tuple[np.ndarray, int]:
    vertex_component, _, count = components(vertex_count, np.asarray(faces))
    return np.asarray(vertex_component), int(count)


def _mean_weights(faces: np.ndarray, vertex_component: np.ndarray, count: int) -> torch.Tensor:
    """Weights [C,V] whose product with vertices is the mean face centroid of each component."""
    weights = np.zeros((count, len(vertex_component)))
    corners = np.asarray(faces).ravel()
    np.add.at(weights, (vertex_component[corners], corners), 1.0)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    return torch.as_tensor(weights, dtype=torch.float32)
