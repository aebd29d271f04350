"""Layered outfits on a capsule, and LayersNets with random weights."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from support import sequences
from support.scenes import tube, walk
from support.sequences import two_layers
from warpgarment.kernels.features.skin import Skin, bind
from warpgarment.nn.inputs import FrameInputs
from warpgarment.nn.layers.config import LayersNetConfig
from warpgarment.nn.layers.network import LayersNet
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.pack import PackedBodies, PackedGarments
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.samples.noise import NoiseConfig
from warpgarment.training.samples.outfits import OutfitBuilder, OutfitData

CPU = torch.device("cpu")
TRAINED = {"embedding": 32, "layers": 1, "feed_forward": 32, "heads": 4, "world_heads": 2, "decoder": 32}
TRAINED |= {"patch_spacing": 0.1, "patch_radius": 0.1, "body_radius": 0.15}
QUIET = NoiseConfig(position=0.0, offset=0.0)
SMALL = {"embedding": 32, "layers": 2, "feed_forward": 24, "heads": 4, "world_heads": 2, "decoder": 24}
SMALL |= {"patch_spacing": 0.12, "patch_radius": 0.12, "patch_neighbours": 4, "body_radius": 0.09, "residual": False}
SILK, WOOL = Material(density=0.08, bend=2e-5, friction=0.1), Material(density=0.5, stretch=3e3, bend=1e-3)


def inner(seed: int = 0) -> Garment:
    """A dress that hangs closely about the capsule."""
    return _garment(14, 6, seed, bottom=-0.25, top=0.3, radius=(0.21, 0.17))


def outer(seed: int = 1) -> Garment:
    """A wider one above it."""
    return _garment(12, 5, seed, bottom=-0.15, top=0.32, radius=(0.27, 0.21))


def _garment(around: int, along: int, seed: int, **sizes) -> Garment:
    """A tube that is no longer symmetric, so that no two distances are equal."""
    vertices, faces = tube(around, along, **sizes)
    rng = np.random.default_rng(seed)
    return Garment(vertices + rng.uniform(-4e-3, 4e-3, vertices.shape).astype(np.float32), faces)


def layersnet(seed: int = 0, **changes) -> LayersNet:
    """Random weights, with statistics that are about right and different along each axis."""
    torch.manual_seed(seed)
    network = LayersNet(LayersNetConfig(**(SMALL | changes)))
    for name, parameter in network.named_parameters():
        if parameter.ndim < 2 and "bases" not in name:
            torch.nn.init.normal_(parameter, mean=float("norm" in name or "gain" in name), std=0.2)
        elif "decoder" in name:
            torch.nn.init.normal_(parameter, std=2.0 / parameter.shape[1] ** 0.5)
    spread = torch.tensor([0.2, 0.3, 0.25])
    network.set_statistics(
        {
            "state_mean": torch.linspace(-0.1, 0.1, 12),
            "state_std": torch.cat([spread, 0.03 * spread, 1.1 * spread, 0.04 * spread]),
            "acceleration_mean": torch.tensor([1e-4, -2e-4, 1e-4]),
            "acceleration_std": torch.tensor([1.5e-3, 2e-3, 1e-3]),
        }
    )
    if network.config.carried_by == "body":
        offset = {"offset_mean": torch.linspace(-0.01, 0.01, 6), "offset_std": torch.cat([0.1 * spread, 0.03 * spread])}
        network.set_statistics(offset)
    return network.eval()


class Outfit(NamedTuple):
    """Garments on a body in some frames."""

    garments: list[Garment]
    past: list[list[np.ndarray]]  # for each garment, vertices at t, t-1, t-2
    body: list[np.ndarray]  # at t+1, t, t-1, t-2
    body_faces: np.ndarray
    materials: list[Material | None]
    wind: np.ndarray  # [B,2,3] at t+1 and t

    def turned(self, rotation: np.ndarray, shift: np.ndarray) -> Outfit:
        """The outfit turned and then moved."""
        past = [[x @ rotation.T + shift for x in frames] for frames in self.past]
        return self._replace(past=past, body=[y @ rotation.T + shift for y in self.body], wind=self.wind @ rotation.T)


def moving(seed: int = 0, garments: list[Garment] | None = None, **changes) -> Outfit:
    """Two garments that move a little, with the capsule walking beneath them."""
    rng = np.random.default_rng(seed)
    garments = [inner(), outer()] if garments is None else garments
    motion = walk(8)
    past = []
    for garment in garments:
        x = [garment.vertices.astype(np.float64)]
        for scale in (4e-3, 5e-3):
            x.append(x[-1] + rng.normal(scale=scale, size=3) + rng.normal(scale=1e-3, size=x[0].shape))
        past.append(x)
    body = [motion.vertices[k].astype(np.float64) for k in (4, 3, 2, 1)]
    materials: list[Material | None] = [(SILK, WOOL)[k % 2] for k in range(len(garments))]
    wind = rng.normal(scale=3.0, size=(len(garments), 2, 3))
    return Outfit(garments, past, body, motion.faces, materials, wind)._replace(**changes)


def inputs_of(outfits: list[Outfit], dtype: torch.dtype = torch.float64) -> tuple[list[Garment], FrameInputs]:
    """The garments of outfits, one body each, and the inputs of a network for them as one batch."""
    garments = [garment for outfit in outfits for garment in outfit.garments]
    on = [k for k, outfit in enumerate(outfits) for _ in outfit.garments]
    bodies = PackedBodies.pack([o.body_faces for o in outfits], [len(o.body[0]) for o in outfits], on, CPU)

    def send(array) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=dtype)

    frames = [send(np.concatenate([x[k] for o in outfits for x in o.past])) for k in range(3)]
    body = [send(np.concatenate([o.body[k] for o in outfits])) for k in range(4)]
    given = [m for o in outfits for m in o.materials]
    rows = [[np.nan] * 6 if m is None else list(dataclasses.astuple(m)) for m in given]
    wind = send(np.concatenate([o.wind for o in outfits]).transpose(1, 0, 2))
    inputs = FrameInputs(
        torch.zeros(0), torch.zeros(0), frames[0], body[1], body[0], torch.stack(frames[1:]), torch.stack(body[2:]),
        send(np.array(rows)), wind, bodies=bodies, skin=bound(outfits, on),
    )  # fmt: skip
    return garments, inputs


def bound(outfits: list[Outfit], on: list[int]) -> Skin:
    """The garments at t-2 as bound to the bodies at t-2."""
    offsets = np.cumsum([0] + [len(o.body[0]) for o in outfits])
    cloth = [x[2] for o in outfits for x in o.past]
    of_vertex = np.repeat(on, [len(x) for x in cloth])
    return bind(np.concatenate(cloth), of_vertex, np.concatenate([o.body[3] for o in outfits]), offsets, CPU)


def layout_of(network: LayersNet, garments: list[Garment]):
    """The network's layout of some garments."""
    return network.layout(garments, PackedGarments.pack(garments, CPU))


def answer(network: LayersNet, outfits: list[Outfit]) -> list[np.ndarray]:
    """Positions at t+1 of each garment."""
    garments, inputs = inputs_of(outfits, network.state_mean.dtype)
    with torch.no_grad():
        after = network.predict(inputs, layout_of(network, garments)).positions.numpy()
    return np.split(after, np.cumsum([len(g.vertices) for g in garments])[:-1])


def turned_motion(motion: BodyMotion, rotation: np.ndarray, shift: np.ndarray) -> BodyMotion:
    """A motion turned and then moved."""
    return BodyMotion(
        motion.vertices @ rotation.T.astype(np.float32) + shift.astype(np.float32), motion.faces, motion.fps
    )


MATERIAL = Material(density=0.4, bend=1e-4)
GARMENTS = [
    {"name": "inner", "category": "tube", "material": MATERIAL.as_dict()},
    {"name": "outer", "category": "tube", "material": None},
]


def recorded(root: Path) -> Path:
    """Three sequences of two layers, and one for validation."""
    for number, (name, split) in enumerate((("a", "train"), ("b", "train"), ("c", "train"), ("d", "validation"))):
        extra = {"garments": GARMENTS}
        sequences.write(root, name, split, seed=number, frames=16, spoil=two_layers, manifest=extra)
    return root


def network_of(**changes) -> LayersNet:
    """A network with random weights and plausible statistics."""
    torch.manual_seed(0)
    network = LayersNet(LayersNetConfig(**(TRAINED | {"residual": False} | changes)))
    network.set_statistics({"acceleration_std": torch.full((3,), 2e-3)})
    return network


def builder_of(data, network, *, ahead=0, steps=1, noise=QUIET) -> OutfitBuilder:
    """A builder for the sequences a and b."""
    loaded = [OutfitData(Sequence.load(data / name), data / name, network.config, CPU) for name in "ab"]
    return OutfitBuilder(loaded, network, noise, ahead, steps)


def batch_of(data, network, picks=((0, 5), (1, 9)), **options):
    """The batch of two samples."""
    return builder_of(data, network, **options).build(list(picks), None, np.random.default_rng(0))
