"""The settings of a LayersNet."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from warpgarment.nn.config import NetworkConfig

BODY = 16  # number of nearest body vertices that a patch sees at most
VERTEX_PATCHES = 4  # number of patches against which a vertex is decoded at most


@dataclasses.dataclass(frozen=True)
class LayersNetConfig(NetworkConfig):
    """Settings of a LayersNet. The defaults are this project's; `paper` has those of the publication.

    Of the settings that it inherits, `embedding`, `layers`, `feed_forward`, `heads`, `heading`, `residual`,
    `patch_spacing` and `fps` have a meaning here. `history` is 3 frames, from which the velocities at t and t-1 follow.

    Attributes:
        world_heads: Number of heads that see world patches, body vertices, wind and gravity; the other heads see mesh
            patches and attributes.
        decoder: Width of the hidden layers of the decoder.
        carried_by: Where cloth goes before the network's accelerations are added: "body", on as it moved about its
            body, or "inertia", on as it moved in space (see inputs.py).
        patches: How the cloth is divided: "geodesics", or "texture" for cells of `patch_spacing` in texture space, as
            published; a garment without texture coordinates is divided by geodesics all the same.
        rotation: "orthogonal" turns hidden vectors by R_h = Q (R + R + R + R + R + 1) Q^T with an orthogonal Q;
            "published" by R_h = W R W^T of rank 3, which is no rotation (see turns.py).
        patch_radius: Largest distance between the centres of patches that a world edge joins [m].
        patch_neighbours: Largest number of world edges of a patch; the nearest ones are kept.
        body_radius: Largest distance from a patch, or vertex, to the body vertices that it sees [m].
    """

    embedding: int = 128
    layers: int = 4
    feed_forward: int = 128
    heads: int = 8
    manifold_heads: int = 0
    dropout: float = 0.0
    history: int = 3
    residual: bool = True
    heading: str = "canonical"
    architecture: str = "layers"
    patch_spacing: float = 0.08
    world_heads: int = 4
    decoder: int = 128
    carried_by: str = "body"
    patches: str = "geodesics"
    rotation: str = "orthogonal"
    patch_radius: float = 0.08
    patch_neighbours: int = 16
    body_radius: float = 0.08

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.history != 3:
            raise ValueError(f"history of a LayersNet is 3 frames, got {self.history}")
        if self.outdoor:
            raise ValueError("a LayersNet always reads materials and wind; leave out outdoor")
        if not 1 <= self.world_heads < self.heads:
            raise ValueError(f"world_heads must lie between 1 and heads - 1 = {self.heads - 1}, got {self.world_heads}")
        if self.rotation not in ("orthogonal", "published"):
            raise ValueError(f'rotation must be "orthogonal" or "published", got {self.rotation!r}')
        if self.carried_by not in ("body", "inertia"):
            raise ValueError(f'carried_by must be "body" or "inertia", got {self.carried_by!r}')
        if self.patches not in ("geodesics", "texture"):
            raise ValueError(f'patches must be "geodesics" or "texture", got {self.patches!r}')
        if self.rotation == "orthogonal" and self.head_width < 4:
            raise ValueError(f"a head must be at least 4 wide to be turned, got {self.head_width}")
        for name in ("decoder", "patch_neighbours"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("patch_radius", "body_radius"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")

    @property
    def head_width(self) -> int:
        """Width of a head."""
        return self.embedding // self.heads

    @classmethod
    def paper(cls, **changes: Any) -> LayersNetConfig:
        """The network as it was published, with 1.0 million parameters; lengths at life size."""
        settings: dict[str, Any] = {
            "residual": False,
            "carried_by": "inertia",
            "heading": "world",
            "feed_forward": 256,
            "decoder": 268,
            "rotation": "published",
            "patches": "texture",
            "patch_spacing": 0.055,
            "patch_radius": 0.04,
            "body_radius": 0.06,
        }
        return cls(**(settings | changes))
