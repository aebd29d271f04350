"""What all networks have in common: normalisation, the heading they see, statistics, files.

`forward` does everything; training takes it apart:

    features, velocities, frame = network.canonicalise(features, velocities, face_mask)
    x, v = network.encode(features, velocities)                                    # noise may be added here
    normalised = network.forward_normalised(x, v, weights, ...)                    # losses may be taken here, against
    target = network.normalise_targets(rotate_output(target, frame))               #   this
    output = rotate_output(network.denormalise(normalised), frame, inverse=True)

Inputs and outputs are normalised inside, with statistics that are buffers and travel with the weights. What Psi, Sigma
and q mean is in `parametrisation.py`; `heading.py` says what `heading="canonical"` does.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import nn

from warpgarment.kernels.features.channels import FACE, FEATURES

from . import heading as _heading
from .attention import EncoderLayer
from .config import NetworkConfig
from .parametrisation import NetworkOutput

STATISTICS = {  # buffers of the normalisation and their lengths; of features that of all channels
    "feature_mean": FEATURES,
    "feature_std": FEATURES,
    "velocity_mean": 3,
    "velocity_std": 3,
    "psi_mean": 9,
    "psi_std": 9,
    "singular_value_mean": 3,
    "singular_value_std": 3,
    "q_mean": 3,
    "q_std": 3,
}


class NormalisedOutput(NamedTuple):
    """Output of the network, or a target for it, in units of zero mean and unit variance."""

    psi: torch.Tensor  # [B,N,9]
    singular_values: torch.Tensor  # [B,N,3]
    velocity: torch.Tensor  # [B,C,3]


def rotate_output(output: NetworkOutput, frame: torch.Tensor | None, *, inverse: bool = False) -> NetworkOutput:
    """Output (or target) turned into the frame of `canonicalise`, or back out of it; unchanged where `frame` is None.

    Args:
        output: In physical units, shapes as in `NetworkOutput` with a batch in front.
        frame: Rotation per garment, shape [B,3,3].
        inverse: From the canonical frame to the world.
    """
    if frame is None:
        return output
    turn = frame.mT if inverse else frame
    return NetworkOutput(
        _heading.rotate_matrices(output.psi, turn),
        output.singular_values,
        _heading.rotate_vectors(output.velocity, turn),
    )


class GarmentNetwork(nn.Module):
    """Predicts how each face deforms in the next frame; the kinds of it differ in `forward_normalised`.

    A residual network (`config.residual`) starts with zero output weights; the means of its Psi and q are identity and
    zero, so that, untrained, it moves the garment like skin. `set_statistics` keeps those means.

    Args:
        config: Its shape and settings.
    """

    face_head: nn.Linear
    velocity_head: nn.Linear
    feature_mean: torch.Tensor
    feature_std: torch.Tensor
    velocity_mean: torch.Tensor
    velocity_std: torch.Tensor
    psi_mean: torch.Tensor
    psi_std: torch.Tensor
    singular_value_mean: torch.Tensor
    singular_value_std: torch.Tensor
    q_mean: torch.Tensor
    q_std: torch.Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.channels = FACE.only(config.channels)
        for name, length in STATISTICS.items():
            length = self.channels.width if name.startswith("feature_") else length
            start = torch.zeros(length) if name.endswith("_mean") else torch.ones(length)
            self.register_buffer(name, start)
        self.psi_mean.copy_(torch.eye(3).flatten())
        self.singular_value_mean.fill_(1.0)

    def encoder_layers(self) -> nn.ModuleList:
        """The encoder over tokens of `config.embedding`, untrained."""
        config = self.config
        return nn.ModuleList(
            EncoderLayer(
                config.embedding,
                config.feed_forward,
                config.heads,
                config.manifold_heads,
                dropout=config.dropout,
                norm_first=config.norm_first,
                activation=config.activation,
            )
            for _ in range(config.layers)
        )

    def start_like_skin(self) -> None:
        """Sets the output weights of a residual network to zero."""
        if self.config.residual:
            for head in (self.face_head, self.velocity_head):
                nn.init.zeros_(head.weight)
                nn.init.zeros_(head.bias)

    def forward(
        self,
        face_features: torch.Tensor,
        velocities: torch.Tensor,
        weights: Any,
        *,
        face_mask: torch.Tensor | None = None,
        velocity_mask: torch.Tensor | None = None,
    ) -> NetworkOutput:
        """Physical units and world space in and out.

        Args:
            face_features: Stacked features, oldest first, shape [B,N,H*34].
            velocities: Past velocities of each component [m/frame], oldest first, shape [B,C,(H-1)*3].
            weights: What the network must know of how the faces lie on the cloth: of a `ManifoldAwareTransformer` the
                geodesic weights [B,N,N], zero in padded columns; of a `PatchTransformer` a `PatchLayout`. B may be 1
                for a batch of one garment many times.
            face_mask: True where a face is real, shape [B,N]; None where all are.
            velocity_mask: True where a component is real, shape [B,C]; None where all are.

        Returns:
            To be read by `parametrisation.compose`. Entries of padding mean nothing, and are finite.
        """
        kind = face_features.device.type
        half = torch.is_autocast_enabled(kind)
        with torch.autocast(kind, enabled=False):  # half precision is for the transformer, not for positions
            face_features, velocities, frame = self.canonicalise(face_features, velocities, face_mask)
            x, v = self.encode(face_features, velocities)
        with torch.autocast(kind, dtype=torch.get_autocast_dtype(kind), enabled=half):
            normalised = self.forward_normalised(x, v, weights, face_mask=face_mask, velocity_mask=velocity_mask)
        with torch.autocast(kind, enabled=False):
            return rotate_output(self.denormalise(normalised), frame, inverse=True)

    def canonicalise(
        self, face_features: torch.Tensor, velocities: torch.Tensor, face_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """Turns inputs to the heading the network knows; a network with heading "world" leaves them as they are.

        Returns:
            Features, velocities, and the rotation [B,3,3] that was applied (None for "world"), for `rotate_output`.
        """
        if self.config.heading == "world":
            return face_features, velocities, None
        frame = _heading.canonical_frame(face_features, face_mask)
        turned = _heading.rotate_features(face_features, frame)
        return turned, _heading.rotate_vectors(velocities, frame), frame

    def encode(self, face_features: torch.Tensor, velocities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Normalises (canonical) inputs; the same statistics serve all frames of the history."""
        x = (self.read(face_features).unflatten(-1, (-1, self.channels.width)) - self.feature_mean) / self.feature_std
        return x.flatten(-2), self.encode_velocities(velocities)

    def read(self, face_features: torch.Tensor) -> torch.Tensor:
        """Those of the features [...,H*34] that this network reads, `config.channels`; [...,H*K]."""
        if self.channels.names == FACE.names:
            return face_features
        return FACE.take(face_features.unflatten(-1, (-1, FEATURES)), self.channels.names).flatten(-2)

    def encode_velocities(self, velocities: torch.Tensor) -> torch.Tensor:
        """Normalises (canonical) velocities."""
        return ((velocities.unflatten(-1, (-1, 3)) - self.velocity_mean) / self.velocity_std).flatten(-2)

    def forward_normalised(
        self,
        x: torch.Tensor,
        v: torch.Tensor,
        weights: Any,
        *,
        face_mask: torch.Tensor | None = None,
        velocity_mask: torch.Tensor | None = None,
    ) -> NormalisedOutput:
        """The network itself: normalised inputs to normalised outputs, shapes as in `forward`."""
        raise NotImplementedError

    def denormalise(self, normalised: NormalisedOutput) -> NetworkOutput:
        """Normalised output to physical units (still in the canonical frame), in the precision of the statistics."""
        psi = normalised.psi * self.psi_std + self.psi_mean
        singular_values = normalised.singular_values * self.singular_value_std + self.singular_value_mean
        velocity = normalised.velocity * self.q_std + self.q_mean
        return NetworkOutput(psi.unflatten(-1, (3, 3)), singular_values, velocity)

    def normalise_targets(self, output: NetworkOutput) -> NormalisedOutput:
        """The inverse of `denormalise`."""
        psi = (output.psi.flatten(-2) - self.psi_mean) / self.psi_std
        singular_values = (output.singular_values - self.singular_value_mean) / self.singular_value_std
        return NormalisedOutput(psi, singular_values, (output.velocity - self.q_mean) / self.q_std)

    def set_statistics(self, statistics: Mapping[str, torch.Tensor]) -> None:
        """Replaces statistics of the normalisation.

        Args:
            statistics: Any of `STATISTICS`, with its length. Inputs in the canonical frame, targets as
                `parametrisation.targets` gives them, also in the canonical frame.

        Raises:
            ValueError: An unknown name, a wrong length, a value that is not finite, a deviation that is not positive,
                or an output mean of a residual network that is not "moves like skin".
        """
        for name, value in statistics.items():
            if name not in STATISTICS:
                raise ValueError(f"unknown statistic {name!r}; there are {', '.join(STATISTICS)}")
            value = torch.as_tensor(value, dtype=torch.float32)
            length = len(getattr(self, name))
            if tuple(value.shape) != (length,):
                raise ValueError(f"{name} must have shape [{length}], got {list(value.shape)}")
            if not torch.isfinite(value).all():
                raise ValueError(f"{name} is not finite")
            if name.endswith("_std") and (value <= 0.0).any():
                raise ValueError(f"{name} must be positive, smallest is {value.min().item():g}")
            if self.config.residual and name in ("psi_mean", "q_mean"):
                skin = torch.eye(3).flatten() if name == "psi_mean" else torch.zeros(3)
                if not torch.equal(value.cpu(), skin):
                    raise ValueError(f"{name} of a residual network stays {skin.tolist()}, so that zero means skin")
        for name, value in statistics.items():
            getattr(self, name).copy_(torch.as_tensor(value, dtype=torch.float32))

    def parameter_count(self) -> int:
        """Number of trainable parameters."""
        return sum(parameter.numel() for parameter in self.parameters())

    def save(self, path: str | os.PathLike[str], *, dtype: torch.dtype | None = None) -> None:
        """Writes a checkpoint; see `checkpoint.save`."""
        from . import checkpoint

        checkpoint.save(self, path, dtype=dtype)

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: torch.device | str | None = None) -> GarmentNetwork:
        """Reads a checkpoint; see `checkpoint.load`."""
        from . import checkpoint

        return checkpoint.load(path, device=device)
