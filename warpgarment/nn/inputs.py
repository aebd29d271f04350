"""Inputs and outputs of networks, for a whole batch in a simulation and for padded rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

if TYPE_CHECKING:
    from warpgarment.kernels.features.skin import Skin
    from warpgarment.objects.garment import Garment
    from warpgarment.objects.pack import PackedBodies


class Frames(NamedTuple):
    """Features of a packed batch whose frames are tensors of their own, so that a large one is not copied."""

    frames: tuple[torch.Tensor, ...]  # [F,K] each, H of them, oldest first

    def whole(self) -> torch.Tensor:
        """All frames side by side, [F,H,K]."""
        return torch.stack(self.frames, dim=1)


class FrameInputs(NamedTuple):
    """A packed batch of F faces, V vertices and C connected components at frame t, in physical units and world space.

    `previous`, `previous_body`, `materials`, `wind`, `pairs` and `skin` are None unless the network `reads` them; it
    gets `previous_body` with `previous`. `materials` and `wind` may be None all the same. `features` are `Frames` only
    for networks with `takes_frames`.
    """

    features: torch.Tensor | Frames  # [F,H,K] oldest first, all channels of kernels/features/channels.py
    velocities: torch.Tensor  # [C,H-1,3] of components, oldest first [m/frame]
    vertices: torch.Tensor  # [V,3] frame t [m]
    body: torch.Tensor  # [U,3] frame t [m]
    next_body: torch.Tensor  # [U,3] frame t+1 [m]
    previous: torch.Tensor | None = None  # [2,V,3] frames t-1 and t-2 [m]
    previous_body: torch.Tensor | None = None  # [2,U,3] frames t-1 and t-2 [m]
    materials: torch.Tensor | None = None  # [B,M] the fields of `Material`, in their order; NaN where there is none
    wind: torch.Tensor | None = None  # [2,B,3] velocity of the air at t+1 and t [m/s]
    pairs: torch.Tensor | None = None  # int32 [P,2] vertices of different garments that are near each other
    bodies: PackedBodies | None = None  # topology of the bodies, and which garment is on which
    skin: Skin | None = None  # the garments as bound to their bodies in the first frame


class VertexStep(NamedTuple):
    """Output of a network that predicts positions of vertices; `parametrisation.Step` is the output per face."""

    positions: torch.Tensor  # [V,3] the next frame before contact [m]; no Poisson system is solved
    patches: torch.Tensor | None = None  # [P,3] means over patches of the cloth, which only training uses [m]


class RowInputs(NamedTuple):
    """R rows of at most N faces and C components, in physical units. A row is a garment or a part of its faces."""

    features: torch.Tensor  # [R,N,H*K] oldest first, all channels
    velocities: torch.Tensor  # [R,C,(H-1)*3] m/frame
    rows: Any  # the result of `Architecture.rows`
    face_mask: torch.Tensor | None = None  # bool [R,N], True where a face is real; None where all are
    component_mask: torch.Tensor | None = None  # bool [R,C]
    turn: torch.Tensor | None = None  # [R,3,3] rotation of the world, applied after that to the network's heading
    rest_turn: torch.Tensor | None = None  # [R,3,3] rotation of the rest pose
    mirrored: torch.Tensor | None = None  # bool [R], which rows are mirrored in x, after the turns
    in_network_frame: bool = False  # inputs and target are already turned and mirrored
    outdoor: torch.Tensor | None = None  # [R,N,K] channels of the material and the wind: kernels/features/outdoor.py
    live: tuple[torch.Tensor, ...] = ()  # [R,N,K] each, the newest frames of `features` again, which has no gradient

    @property
    def newest(self) -> torch.Tensor:
        """Features that end with those of the newest frame, with their gradient, [R,N,*]."""
        return self.live[-1] if self.live else self.features

    def whole(self) -> torch.Tensor:
        """All features with their gradients, [R,N,H*K]."""
        if not self.live:
            return self.features
        width = sum(frame.shape[-1] for frame in self.live)
        return torch.cat([self.features[..., : self.features.shape[-1] - width], *self.live], dim=-1)


class NormalisedOutput(NamedTuple):
    """Output of the network, or a target for it, in units of zero mean and unit variance."""

    psi: torch.Tensor  # [R,N,9]
    singular_values: torch.Tensor  # [R,N,3]
    velocity: torch.Tensor  # [R,C,3]


class NetworkSizes(NamedTuple):
    """The figures of a simulation from which the memory of its network is predicted."""

    garments: Sequence[Garment]  # in the order of the batch; equal objects share their constants
    face_splits: int = 1
    half: bool = False  # whether the network runs in bfloat16
    cpu: bool = True  # whether the device is a CPU
    body_vertices: int = 0  # number of vertices of all bodies
