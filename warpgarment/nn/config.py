"""The settings of a network."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from warpgarment.kernels.features.channels import FACE, OUTDOOR

from .architecture import check_name
from .attention import ACTIVATIONS

CHANNELS = (  # channels of the first networks, which a checkpoint that names no channels reads
    "deformation_gradient",
    "normal",
    "centroid",
    "signed_distance",
    "direction_to_body",
    "body_deformation",
    "body_velocity",
    "singular_values",
)

STATISTICS = {  # buffers of the normalisation and their lengths, for networks of these channels
    "feature_mean": FACE.only(CHANNELS).width,
    "feature_std": FACE.only(CHANNELS).width,
    "velocity_mean": 3,
    "velocity_std": 3,
    "psi_mean": 9,
    "psi_std": 9,
    "singular_value_mean": 3,
    "singular_value_std": 3,
    "q_mean": 3,
    "q_std": 3,
}


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Settings of a network. The defaults are the paper's."""

    embedding: int = 512
    layers: int = 8
    feed_forward: int = 512
    heads: int = 8
    manifold_heads: int = 2
    dropout: float = 0.1
    history: int = 10  # frames
    geodesic_power: float = 20.0
    geodesic_radius: float = 1.0  # metres
    residual: bool = False  # see parametrisation.py
    replace_singular_values: bool = True  # of Psi Phi by Sigma (section 4.3.1); False in an ablation
    heading: str = "world"  # or "canonical", see heading.py
    norm_first: bool = False
    activation: str = "relu"  # or "gelu"
    fps: float = 30.0  # frames per second of the motions it was trained on
    architecture: str = "faces"  # every face is a token; or "patches", see patches/network.py
    patch_spacing: float = 0.08  # metres between patches; this and the next three are settings of "patches" alone
    face_embedding: int = 128  # width of a face; `embedding` and `feed_forward` are widths of patches
    face_feed_forward: int = 128
    face_layers: int = 2  # number of face layers after the patches; there is one more before them
    channels: tuple[str, ...] = CHANNELS  # features of a face that the network reads, see kernels/features/channels.py
    physics: int = 0  # iterations of the cloth's own physics after the Poisson solve: sim/stages/relax.py
    physics_length: float = 0.25  # metres: shorter waves of the cloth are the physics', longer ones the network's
    outdoor: tuple[str, ...] = ()  # channels of material and wind that it reads too: kernels/features/outdoor.py

    def __post_init__(self) -> None:
        for name in ("embedding", "layers", "feed_forward", "heads", "face_embedding", "face_feed_forward"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.embedding % self.heads:
            raise ValueError(f"heads must divide embedding, got {self.heads} heads for embedding {self.embedding}")
        if not 0 <= self.manifold_heads <= self.heads:
            raise ValueError(f"manifold_heads must lie between 0 and heads={self.heads}, got {self.manifold_heads}")
        if self.history < 2:
            raise ValueError(f"history must be at least 2 frames, since velocities need two, got {self.history}")
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"dropout must lie in [0, 1), got {self.dropout}")
        if self.face_layers < 0:
            raise ValueError(f"face_layers must not be negative, got {self.face_layers}")
        if self.physics < 0:
            raise ValueError(f"physics must not be negative, got {self.physics}")
        for name in ("geodesic_power", "geodesic_radius", "fps", "patch_spacing", "physics_length"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if self.heading not in ("world", "canonical"):
            raise ValueError(f'heading must be "world" or "canonical", got {self.heading!r}')
        check_name(self.architecture)
        if self.activation not in ACTIVATIONS:
            raise ValueError(f"activation must be one of {', '.join(ACTIVATIONS)}, got {self.activation!r}")
        if not self.channels:
            raise ValueError(f"channels must name at least one of {', '.join(FACE.names)}")
        FACE.only(self.channels)
        OUTDOOR.only(self.outdoor)

    @property
    def features(self) -> int:
        """Number of features of a face in a frame that the network reads: 34 with the default channels."""
        return FACE.only(self.channels).width

    @property
    def inputs(self) -> int:
        """Number of inputs of a face: its features in all frames of the history, and its outdoor channels."""
        return self.history * self.features + OUTDOOR.only(self.outdoor).width

    def as_dict(self) -> dict[str, Any]:
        """Settings as plain values, for a checkpoint; `channels`, `outdoor` and `physics` only if not the defaults."""
        values = dataclasses.asdict(self)
        if self.channels == CHANNELS:
            del values["channels"]
        if not self.outdoor:
            del values["outdoor"]
        if not self.physics:
            del values["physics"], values["physics_length"]
        return values

    @classmethod
    def base(cls, **changes: Any) -> NetworkConfig:
        """The paper's network with 12.8 million parameters."""
        return cls(**changes)

    @classmethod
    def small(cls, **changes: Any) -> NetworkConfig:
        """A network of faces for one CPU core, with 0.5 million parameters."""
        settings: dict[str, Any] = {
            "embedding": 128,
            "layers": 4,
            "feed_forward": 192,
            "heads": 4,
            "manifold_heads": 2,
            "geodesic_power": 2.0,
            "geodesic_radius": 0.15,
            "residual": True,
            "heading": "canonical",
            "norm_first": True,
            "activation": "gelu",
        }
        return cls(**(settings | changes))

    @classmethod
    def fast(cls, **changes: Any) -> NetworkConfig:
        """A network of patches for real time on one CPU core, with 0.7 million parameters."""
        settings: dict[str, Any] = {
            "architecture": "patches",
            "embedding": 128,
            "layers": 4,
            "feed_forward": 192,
            "heads": 4,
            "manifold_heads": 2,
            "dropout": 0.0,
            "geodesic_power": 2.0,
            "geodesic_radius": 0.15,
            "residual": True,
            "heading": "canonical",
            "norm_first": True,
            "activation": "gelu",
        }
        return cls(**(settings | changes))
