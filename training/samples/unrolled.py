"""Samples for unrolled training: whole garments on their bodies, as a `Scene` and its first state, for K steps.

A sample is a sequence and the newest frame t of a history, as in `single_step`; frames t+1..t+K are the recorded
targets. The history is displaced as in `single_step`, and its features are computed from the displaced positions with
cached nearest points. Positions and features are in world space. The batch holds turns and mirrors, which are applied
to the inputs of the network.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from warpgarment.kernels.deformation.stretch import stretch
from warpgarment.kernels.features.channels import INTERACTION
from warpgarment.kernels.kept import Kept, keeping
from warpgarment.nn.architecture import architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.flops import work
from warpgarment.nn.heading import rotation_about_up
from warpgarment.nn.network import GarmentNetwork
from warpgarment.objects.pack import PackedBodies
from warpgarment.sim.history import History
from warpgarment.sim.scene import Scene
from warpgarment.sim.timing import Timings

from .augmentation import Augmentation
from .drawing import Past, displacement, part_of
from .interactions import unpack
from .noise import NoiseConfig
from .recorded import SequenceData
from .scenes import Scenes


@dataclass(frozen=True)
class UnrolledBatch:
    """Samples for unrolled training, packed; lengths in metres, in world space."""

    scene: Scene
    vertices: torch.Tensor  # [V,3] displaced positions at frame t
    before: torch.Tensor  # [V,3] displaced positions at frame t-1
    history: History  # of the frames before t
    features: torch.Tensor  # [F,34] at frame t
    bodies: list[torch.Tensor]  # K+1 tensors [U,3], bodies at frames t..t+K
    recorded: list[torch.Tensor]  # K tensors [V,3], recorded positions at frames t+1..t+K
    stretched: list[tuple[torch.Tensor, torch.Tensor]]  # their deformation gradients [F,3,3] and singular values [F,3]
    air: list[torch.Tensor]  # K tensors [B,3], velocity of the air at frames t+1..t+K [m/s]
    turn: torch.Tensor  # [B,3,3] rotation of the world for the network
    joint: torch.Tensor  # [B,3,3] the part of that rotation that the rest pose shares
    mirrored: torch.Tensor  # bool [B]
    face_weight: torch.Tensor  # [F] weights whose weighted sum is a mean over samples of means over faces
    vertex_weight: torch.Tensor  # [V] the corresponding weights of vertices
    components: torch.Tensor  # scalar, as `single_step.Batch.components`
    materials: torch.Tensor  # [B,M] fields of the material of each garment, NaN where it is not known
    counted: torch.Tensor  # bool [B], whether `recorded` is a recording; the weights of others are zero
    ids: list[tuple[str, int]]  # name of the sequence, newest frame

    def work(self, config: NetworkConfig) -> tuple[int, int]:
        """Number of samples, and of operations of a training step on them (`nn/flops.py`)."""
        views = [
            (*view.face_index.shape, view.component_index.shape[1], view.weights) for view in self.scene.layout.views
        ]
        return len(self.ids), len(self.recorded) * work(config, views)

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays that are saved if the loss of the batch is not finite."""
        tensors = {"features": self.history.stacked(self.features), "velocities": self.history.velocities}
        tensors |= {"vertices": self.vertices, "recorded": torch.stack(self.recorded), "faces": self.scene.packed.faces}
        return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


class UnrolledBuilder:
    """Builds batches for unrolled training.

    Args:
        sequences: Training sequences.
        network: The network in training; the scenes run it.
        noise: Perturbation of histories.
        augmentation: Mirroring and turns.
        steps: Number of steps K.
        collision_passes: Largest number of collision refinements in a frame.
    """

    def __init__(
        self,
        sequences: list[SequenceData],
        network: GarmentNetwork,
        noise: NoiseConfig,
        augmentation: Augmentation,
        steps: int,
        collision_passes: int,
    ) -> None:
        self.sequences, self.network = sequences, network
        self.noise, self.augmentation = noise, augmentation
        self.device = sequences[0].device
        self.subsets = architecture(network.config.architecture).subsets
        self.steps, self.collision_passes = steps, collision_passes
        self._kept, self._scenes = Kept(), Scenes()

    def reaches(self, sequence: int, newest: int) -> bool:
        """Whether all K frames after `newest` are recorded."""
        return self.sequences[sequence].pieces.reaches(newest, self.steps)

    @torch.no_grad()
    def build(
        self,
        picks: list[tuple[int, int]],
        faces: int | None,
        rng: np.random.Generator,
        displacements: list[np.ndarray | None] | None = None,
        part: slice = slice(None),
    ) -> UnrolledBatch:
        """Builds one batch, or a part of it, as `SampleBuilder.build`. But the batch has all faces, and the network
        sees them in subsets of about `faces` faces (None: all at once). A later batch may take over the scene of one
        that is gone, of whose losses no gradients may be asked then."""
        total = sum(self.sequences[s].components for s, _ in picks) / len(picks)
        chosen = part_of(picks, rng, displacements, part)
        together = sorted(zip(*chosen, strict=True), key=lambda sample: sample[0][0])  # so that scenes come again
        picks, streams, overrides = (list(values) for values in zip(*together, strict=True))
        history, device = self.network.config.history, self.device
        mine = [self.sequences[s] for s, _ in picks]
        face_splits = 1 if faces is None else max(round(min(len(data.faces) for data in mine) / faces), 1)

        past, rows, bodies = [], [], []
        for (_, t), data, stream, override in zip(picks, mine, streams, overrides, strict=True):
            begins = Past.of(t, history, device)
            delta = displacement(data, history, self.noise, stream, override)
            moved = data.vertices[begins.frames]
            if delta is not None:
                moved = moved + torch.from_numpy(begins.held(delta)).to(device)
            seen = data.interaction[begins.frames].clone()  # [H,F,16]
            seen[: begins.early] = INTERACTION.still(seen[: begins.early])
            past.append(moved)
            rows.append(seen)
            bodies.append(data.body_frames([int(begins.frames[0]), *range(t, t + self.steps + 1)]))
        recorded = [
            torch.cat([data.vertices[t + k] for (_, t), data in zip(picks, mine, strict=True)])
            for k in range(1, self.steps + 1)
        ]
        placed = [
            torch.from_numpy(np.concatenate(parts)).to(device) for parts in zip(*(v for v, _ in bodies), strict=True)
        ]
        first = torch.cat([data.vertices[max(t - history + 1, 0)] for (_, t), data in zip(picks, mine, strict=True)])
        key = tuple(s for s, _ in picks), face_splits
        scene = self._scenes.take(key)
        if scene is None:
            with keeping(self._kept):
                scene = self._scene(mine, [f for _, f in bodies], placed[0], first, face_splits)
        else:
            scene.begin(placed[0], first)
        positions, interactions = torch.cat(past, dim=1), torch.cat(rows, dim=1)  # [H,V,3], [H,F,16]
        known = zip(positions, interactions, strict=True)
        features = torch.stack([scene.features.of_interaction(v.contiguous(), unpack(r)) for v, r in known], dim=1)
        means = torch.stack([scene.centroids(v) for v in positions], dim=1)  # [C,H,3]
        turn, joint, mirrored = self._symmetries(streams)
        counted = torch.tensor([data.recorded for data in mine], device=device)
        batch = UnrolledBatch(
            scene=scene,
            vertices=positions[-1].contiguous(),
            before=positions[-2].contiguous(),
            history=History(features[:, :-1], means.diff(dim=1)),
            features=features[:, -1].contiguous(),
            bodies=placed[1:],
            recorded=recorded,
            stretched=[stretch(scene.inverse_rest, frame, scene.packed.faces) for frame in recorded],
            air=[
                torch.stack([data.air[t + k] for (_, t), data in zip(picks, mine, strict=True)])
                for k in range(1, self.steps + 1)
            ],
            turn=turn,
            joint=joint,
            mirrored=mirrored,
            face_weight=_means(scene.packed.garment_of_face, counted),
            vertex_weight=_means(scene.packed.garment_of_vertex, counted),
            components=torch.full((), total * len(picks), device=device),
            materials=torch.stack([data.material for data in mine]),
            counted=counted,
            ids=[(data.name, t) for (_, t), data in zip(picks, mine, strict=True)],
        )
        self._scenes.keep(key, scene, batch)
        return batch

    def _scene(
        self,
        mine: list[SequenceData],
        body_faces: list[np.ndarray],
        body: torch.Tensor,
        first: torch.Tensor,
        face_splits: int,
    ) -> Scene:
        """A new scene of sequences, with bodies [U,3] and garments [V,3] at the first known frame."""
        counts = [int(faces.max()) + 1 for faces in body_faces]  # all vertices are those of faces
        return Scene(
            [data.garment for data in mine],
            PackedBodies.pack(body_faces, counts, range(len(mine)), self.device),
            body,
            first,
            self.network,
            face_splits=face_splits,
            epsilon=None,
            collision_passes=self.collision_passes,
            half=False,
            timings=Timings(self.device),
            materials=torch.stack([data.material for data in mine]),
        )

    def _symmetries(self, streams: list[np.random.Generator]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Draws for each sample: turn of the world [B,3,3], the part that the rest pose shares, mirrored or not."""
        settings = self.augmentation
        free = settings.world_yaw and self.network.config.heading == "world"
        angles, mirrored = np.zeros((2, len(streams)), np.float32), np.zeros(len(streams), bool)
        for b, rng in enumerate(streams):
            angles[1, b] = rng.standard_normal() * np.radians(settings.yaw)
            angles[0, b] = rng.uniform(-np.pi, np.pi) if free else 0.0
            mirrored[b] = rng.random() < settings.mirror
        world, joint = rotation_about_up(torch.from_numpy(angles).to(self.device))
        return joint @ world, joint, torch.from_numpy(mirrored).to(self.device)


def _means(owner: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Weights whose weighted sum is the mean over garments of means over the elements of each, where they count, and
    of zeros."""
    number = torch.bincount(owner.long(), minlength=len(counted))
    return (counted / (len(counted) * number))[owner.long()].float()
