"""Samples for networks that predict positions: whole outfits on their bodies, with materials and wind, in some frames.

A sample is a sequence and the newest frame t of a history. The batch holds the recorded frames t-K-2 ... t+G. A rollout
of K steps ends at t and G further steps have a loss; frames before the first one repeat it on a body that
stands still, as in a cold start. Each sample has a random number from 0 to 1, by which the objective chooses the step
from which predictions replace the truth, and a displacement of its history (noise.py). Garments are bound to their
bodies (kernels/features/skin.py) where a simulation would be: mostly in the first frame of the sequence, otherwise in
any frame before t-K of the last `RECENT` ones, as if the simulation had started there.

Some histories lie between the recorded one and the smooth skin, at rest relative to it or already on their way back.
Targets of displaced histories come back by `RETURN` in a frame; at once, they would teach velocities that overshoot.
"""

from __future__ import annotations

import copy
from dataclasses import astuple, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgarment.kernels.features.skin import Skin, bind
from warpgarment.kernels.mesh.laplacian import components
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.flops import step_flops
from warpgarment.nn.inputs import FrameInputs
from warpgarment.nn.network import GarmentNetwork
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.pack import PackedBodies, PackedGarments
from warpgarment.training.data.pieces import Pieces
from warpgarment.training.data.sequence import Sequence

from .drawing import displacement, part_of
from .interactions import UnusableSequence
from .noise import NoiseBasis, NoiseConfig

RECENT = 40  # frames
RETURN = 0.2  # share of a displacement by which targets come back in a frame
FROM_FIRST = 0.7  # share of samples that are bound in the first frame


class OutfitData:
    """One training sequence: an outfit with its body, materials and wind.

    Args:
        sequence: The loaded sequence.
        folder: Folder of the sequence.
        network: Settings of the network for which samples are made.
        device: Device on which samples are built.

    Raises:
        UnusableSequence: The sequence has too few frames, or positions that are not finite, or is in pieces.
    """

    def __init__(self, sequence: Sequence, folder: Path, network: NetworkConfig, device: torch.device) -> None:
        self.name, self.device, self.source = Path(folder).name, device, sequence
        recorded = np.asarray(sequence.vertices, np.float32)
        if len(recorded) < network.history + 1:
            raise UnusableSequence(f"{len(recorded)} frames, fewer than history + 1 = {network.history + 1}")
        if not np.isfinite(recorded).all():
            frame = int(np.nonzero(~np.isfinite(recorded).all(axis=(1, 2)))[0][0])
            raise UnusableSequence(f"garment positions are not finite from frame {frame}")
        self.vertices = torch.as_tensor(np.array(recorded), device=device)
        self.pieces = Pieces.of(sequence.name, sequence.manifest, len(recorded))
        if not self.pieces.whole:
            raise UnusableSequence("it is in pieces, and networks that predict positions train on recordings")
        if not sequence.manifest.get("recorded", True):
            raise UnusableSequence("it has no recording, which networks that predict positions need")
        self.garments, whole = list(sequence.worn), sequence.garment
        self.faces = torch.as_tensor(np.array(whole.faces, np.int32), device=device)
        vertex_component, _, self.components = components(len(whole.vertices), np.asarray(whole.faces))
        self.noise = NoiseBasis(np.asarray(whole.faces), np.asarray(vertex_component), np.asarray(whole.pins))
        unknown = (np.nan,) * len(fields(Material))
        self.materials = np.array([unknown if m is None else astuple(m) for m in sequence.materials], np.float32)
        self.wind = np.zeros((len(recorded), 3), np.float32) if sequence.wind is None else np.asarray(sequence.wind)

    @cached_property
    def body(self) -> BodyMotion:
        """The part of the body with which cloth collides."""
        return self.source.body()

    @cached_property
    def mirrored(self) -> OutfitData:
        """The sequence in a mirror that turns x about. Faces are wound the other way, so that normals point outward."""
        other, flip = copy.copy(self), np.array([-1.0, 1.0, 1.0], np.float32)
        other.vertices = self.vertices * torch.from_numpy(flip).to(self.device)
        other.garments = [
            Garment(g.vertices * flip, g.faces[:, ::-1].copy(), pins=g.pins, name=g.name) for g in self.garments
        ]
        other.faces, other.wind = self.faces[:, [0, 2, 1]].contiguous(), self.wind * flip
        other.body = BodyMotion(self.body.vertices * flip, self.body.faces[:, ::-1].copy(), self.body.fps)
        return other

    @property
    def count(self) -> int:
        """Number of samples of one step."""
        return len(self.pieces.newest(1))


@dataclass(frozen=True)
class OutfitBatch:
    """Outfits in N = K + 3 + G frames, packed; metres, world space. A sample is one outfit on one body."""

    packed: PackedGarments
    bodies: PackedBodies
    layout: Any  # of the network
    frames: torch.Tensor  # [N,V,3] recorded positions of garments
    body: torch.Tensor  # [N,U,3] bodies
    skin: Skin | None  # the garments as bound to their bodies in some earlier frame; None if nobody reads it
    wind: torch.Tensor  # [N,B,3] velocity of the air [m/s]
    materials: torch.Tensor  # [B,M]; NaN for a garment without one
    delta: torch.Tensor  # [3,V,3] displacement of the three frames of a history, newest first
    draw: torch.Tensor  # [number of samples], from 0 to 1
    sample_of_garment: torch.Tensor  # int64 [B]
    sample_of_vertex: torch.Tensor  # int64 [V]
    steps: int  # G
    ids: list[tuple[str, int]]  # name of the sequence, newest frame

    @property
    def ahead(self) -> int:
        """Largest number of steps K of a rollout before those with a loss."""
        return len(self.frames) - 3 - self.steps

    def recorded(self, frame: int) -> list[torch.Tensor]:
        """Recorded and displaced positions [V,3] of a frame of the batch and of the two before it."""
        return [self.frames[frame - k] + self.delta[k] for k in range(3)]

    def wanted(self, frame: int, predicted: torch.Tensor) -> torch.Tensor:
        """Targets of a frame of the batch, [V,3].

        Args:
            frame: Number of the frame.
            predicted: Number of steps that have been predicted up to this frame, for each vertex, [V].
        """
        return self.frames[frame] + ((1.0 - RETURN) ** predicted)[:, None] * self.delta[0]

    def inputs(self, recent: list[torch.Tensor], frame: int, reads: frozenset[str]) -> FrameInputs:
        """What a network gets of a frame; the features of faces are empty.

        Args:
            recent: Positions of garments in this frame and the two before it, [V,3] each.
            frame: Number of the frame in the batch, at least 2.
            reads: Optional inputs that the network reads.
        """
        body, nothing, past = self.body, self.frames.new_zeros((0, 0, 0)), "previous" in reads
        return FrameInputs(
            nothing,
            nothing,
            recent[0],
            body[frame],
            body[frame + 1],
            previous=torch.stack(recent[1:]) if past else None,
            previous_body=torch.stack([body[frame - 1], body[frame - 2]]) if past else None,
            materials=self.materials if "materials" in reads else None,
            wind=torch.stack([self.wind[frame + 1], self.wind[frame]]) if "wind" in reads else None,
            bodies=self.bodies,
            skin=self.skin if "skin" in reads else None,
        )

    def work(self, config: NetworkConfig) -> tuple[int, int]:
        """Number of samples, and of operations of the steps with a loss (`nn/flops.py`)."""
        faces, garments = len(self.packed.faces), self.packed.count
        return len(self.ids), self.steps * step_flops(config, 1, faces, garments)

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays that are saved if the loss of the batch is not finite."""
        tensors = {"frames": self.frames, "body": self.body, "wind": self.wind, "materials": self.materials}
        tensors |= {"delta": self.delta, "draw": self.draw, "faces": self.packed.faces}
        return {name: tensor.cpu().numpy() for name, tensor in tensors.items()}


class OutfitBuilder:
    """Builds batches of outfits.

    Args:
        sequences: Training sequences.
        network: The network in training, which makes the layouts.
        noise: Perturbation of histories.
        ahead: Largest number of steps K of a rollout before those with a loss.
        steps: Number of steps G with a loss.
        mirror: Share of samples that are mirrored in x.
        to_skin: Share of samples whose history lies between the recorded one and smooth skin.
    """

    def __init__(
        self,
        sequences: list[OutfitData],
        network: GarmentNetwork,
        noise: NoiseConfig,
        ahead: int,
        steps: int,
        mirror: float = 0.0,
        to_skin: float = 0.0,
    ) -> None:
        self.sequences, self.network, self.noise, self.ahead, self.steps = sequences, network, noise, ahead, steps
        self.mirror, self.to_skin = mirror, to_skin
        self.device, self.subsets = sequences[0].device, False

    def reaches(self, sequence: int, newest: int) -> bool:
        """Whether all frames after `newest` that have a loss are recorded."""
        return self.sequences[sequence].pieces.reaches(newest, self.steps)

    @torch.no_grad()
    def build(
        self,
        picks: list[tuple[int, int]],
        faces: int | None,
        rng: np.random.Generator,
        displacements: list[np.ndarray | None] | None = None,
        part: slice = slice(None),
    ) -> OutfitBatch:
        """Builds one batch, or a part of it, of all faces of every outfit; the arguments are those of
        `Builder.build`, and `faces` has no effect."""
        picks, streams, overrides = part_of(picks, rng, displacements, part)
        mine, history = [self.sequences[s] for s, _ in picks], self.network.config.history
        if self.mirror:
            shown = zip(mine, streams, strict=True)
            mine = [data.mirrored if stream.random() < self.mirror else data for data, stream in shown]
        past, bodies, wind, deltas, draws, bound, towards = [], [], [], [], [], [], []
        for (_, t), data, stream, override in zip(picks, mine, streams, overrides, strict=True):
            frames = np.arange(t - self.ahead - 2, t + self.steps + 1).clip(0)
            delta = displacement(data, history, self.noise, stream, override)
            past.append(data.vertices[torch.from_numpy(frames).to(self.device)])
            bodies.append(np.asarray(data.body.vertices[frames], np.float32))
            wind.append(np.repeat(data.wind[frames][:, None], len(data.garments), axis=1))
            deltas.append(np.zeros((history, *past[-1].shape[1:]), np.float32) if delta is None else delta[::-1])
            draws.append(stream.random())
            chosen = self.to_skin > 0.0 and stream.random() < self.to_skin
            towards.append((stream.random() * chosen, float(stream.random() < 0.5)) if chosen else (0.0, 0.0))
            start = max(t - self.ahead - 2, 0)
            early = stream.random() < FROM_FIRST
            frame = 0 if early else int(stream.integers(max(start - RECENT, 0), start + 1))
            bound.append((data.vertices[frame].cpu().numpy(), np.asarray(data.body.vertices[frame], np.float64)))
        garments = [garment for data in mine for garment in data.garments]
        sample = np.repeat(np.arange(len(mine)), [len(data.garments) for data in mine])
        packed = PackedGarments.pack(garments, self.device)
        vertices = [data.body.vertices.shape[1] for data in mine]
        packed_bodies = PackedBodies.pack([data.body.faces for data in mine], vertices, sample.tolist(), self.device)

        def send(array: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

        sample_of_garment = send(sample)
        sample_of_vertex = sample_of_garment[packed.garment_of_vertex.long()]
        recorded, body = torch.cat(past, dim=1), send(np.concatenate(bodies, axis=1))
        skin = None
        if self.to_skin or "skin" in self.network.reads:
            owner = np.repeat(np.arange(len(mine)), [len(cloth) for cloth, _ in bound])
            cloth, lower = (np.concatenate(part) for part in zip(*bound, strict=True))
            skin = bind(cloth, owner, lower, packed_bodies.vertex_offsets, self.device)
        moved = send(np.concatenate(deltas, axis=1))
        if skin is not None and any(share for share, _ in towards):
            share, speed = (send(np.array(part, np.float32))[sample_of_vertex] for part in zip(*towards, strict=True))
            known = range(self.ahead + 2, self.ahead - 1, -1)  # newest first
            to_skin = torch.stack([skin(body[k])[1] - recorded[k] for k in known])
            parts = torch.stack([share * (1.0 - RETURN) ** (-k * speed) for k in range(history)])
            moved = moved + parts[..., None] * to_skin
        return OutfitBatch(
            packed=packed,
            bodies=packed_bodies,
            layout=self.network.layout(garments, packed),
            frames=recorded,
            body=body,
            skin=skin,
            wind=send(np.concatenate(wind, axis=1).astype(np.float32)),
            materials=send(np.concatenate([data.materials for data in mine])),
            delta=moved,
            draw=send(np.array(draws, np.float32)),
            sample_of_garment=sample_of_garment,
            sample_of_vertex=sample_of_vertex,
            steps=self.steps,
            ids=[(data.name, t) for (_, t), data in zip(picks, mine, strict=True)],
        )
