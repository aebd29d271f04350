"""The table of feature channels: how each one turns, mirrors, and is at rest.

    | kind      | the world is turned by G, the rest pose by J | mirrored in x, M = diag(-1, 1, 1) |
    | --------- | -------------------------------------------- | --------------------------------- |
    | SCALAR    | x                                            | x                                 |
    | VECTOR    | G v                                          | M v                               |
    | MAP       | G A G^T                                      | M A M                             |
    | FROM_REST | G A J^T                                      | M A M                             |
    | POINT     | G (p - origin), see `Layout.centred`         | M p                               |

Maps are 3 x 3 and row-major. Faces of a mirrored garment have the opposite winding, so that normals still point
outward. A new channel is a row of `FACE` and an expression in `write_features` (face.py); all else follows from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from functools import lru_cache
from typing import Literal, NamedTuple

import torch


class Kind(Enum):
    """Behaviour of a channel under turns and mirrors, see the table above."""

    SCALAR = "scalar"
    VECTOR = "vector"
    MAP = "map"
    FROM_REST = "map from the rest pose"
    POINT = "point"


_WIDTHS = {Kind.VECTOR: 3, Kind.MAP: 9, Kind.FROM_REST: 9, Kind.POINT: 3}  # a scalar may have any width


class Channel(NamedTuple):
    """Numbers of a face that form one quantity."""

    name: str
    width: int
    kind: Kind
    at_rest: Literal["keep", "zero", "identity"] = "keep"
    """Its value if the body does not move."""
    length: bool = False
    """Whether it has the unit of a length and grows with the scene."""


class Layout:
    """Channels side by side in K columns.

    Args:
        channels: The channels, from the first column to the last.

    Raises:
        ValueError: A width does not fit the kind, or a name occurs twice.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self.channels = tuple(channels)
        self.names = tuple(channel.name for channel in self.channels)
        self.slices: dict[str, slice] = {}
        self.width = 0
        for channel in self.channels:
            width = _WIDTHS.get(channel.kind, channel.width)
            if channel.width != width:
                raise ValueError(
                    f"channel {channel.name} is a {channel.kind.name} of width {channel.width}, not {width}"
                )
            if channel.name in self.slices:
                raise ValueError(f"channel {channel.name} occurs more than once")
            self.slices[channel.name] = slice(self.width, self.width + channel.width)
            self.width += channel.width

    def only(self, names: Sequence[str]) -> Layout:
        """Some of the channels, in the order given.

        Raises:
            ValueError: There is no such name, or it is given twice.
        """
        known = dict(zip(self.names, self.channels, strict=True))
        for name in names:
            if name not in known:
                raise ValueError(f"no feature channel {name!r}; there are {', '.join(known)}")
        return Layout([known[name] for name in names])

    def take(self, rows: torch.Tensor, names: Sequence[str]) -> torch.Tensor:
        """The columns of some channels of rows [...,K], in the order of the names; for all of them, the rows."""
        if tuple(names) == self.names:
            return rows
        return torch.cat([rows[..., self.slices[name]] for name in names], dim=-1)

    def turn(
        self, world: torch.Tensor, rest: torch.Tensor | None = None, scale: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Matrices that turn rows, to be multiplied with the row as a column vector.

        Row-major maps turn by Kronecker products: vec(G A J^T) = (G ⊗ J) vec(A).

        Args:
            world: Rotation G of garment and body, shape [R,3,3].
            rest: Rotation J of the rest pose, shape [R,3,3]; None if it is not turned.
            scale: Factor of all lengths, shape [R]; None for 1.

        Returns:
            Matrices, shape [R,K,K].
        """
        turn = torch.eye(self.width, dtype=world.dtype, device=world.device).repeat(len(world), 1, 1)
        if rest is None:
            rest = torch.eye(3, dtype=world.dtype, device=world.device).expand_as(world)
        # Maps come before vectors: gradients of G are summed in this order, on which the bits of training losses depend
        for channel in sorted(self.channels, key=lambda channel: _WIDTHS.get(channel.kind) == 3):
            place, factor = self.slices[channel.name], scale if channel.length else None
            if channel.kind is Kind.SCALAR:
                if factor is None:
                    continue
                block = turn[:, place, place]
            elif channel.kind in (Kind.MAP, Kind.FROM_REST):
                right = world if channel.kind is Kind.MAP else rest
                block = torch.einsum("bij,bkl->bikjl", world, right).reshape(-1, 9, 9)
            else:
                block = world
            turn[:, place, place] = block if factor is None else block * factor[:, None, None]
        return turn

    def mirror(self, device: torch.device) -> torch.Tensor:
        """Signs of the columns under a mirror in x, shape [K]; cached, since a copy to a GPU would wait for it."""
        return _signs(self, device)

    def centred(self, rows: torch.Tensor, origin: torch.Tensor) -> torch.Tensor:
        """Rows with points relative to an origin, so that `turn` turns them about it.

        Args:
            rows: Rows, shape [...,K]; not changed.
            origin: Origin [m], shape [3], or [...,3] with the number of dimensions of the rows.
        """
        moved = rows.clone()
        for channel in self.channels:
            if channel.kind is Kind.POINT:
                moved[..., self.slices[channel.name]] -= origin
        return moved

    def still(self, rows: torch.Tensor) -> torch.Tensor:
        """A copy of rows [...,K] with the values for a body that does not move."""
        rows = rows.clone()
        for channel in self.channels:
            place = rows[..., self.slices[channel.name]]
            if channel.at_rest == "zero":
                place.zero_()
            elif channel.at_rest == "identity":
                place.copy_(torch.eye(3, dtype=rows.dtype, device=rows.device).flatten())
        return rows


@lru_cache
def _signs(layout: Layout, device: torch.device) -> torch.Tensor:
    vector = torch.tensor([-1.0, 1.0, 1.0])
    signs = torch.ones(layout.width)
    for channel, place in zip(layout.channels, layout.slices.values(), strict=True):
        if channel.kind in (Kind.VECTOR, Kind.POINT):
            signs[place] = vector
        elif channel.kind is not Kind.SCALAR:
            signs[place] = torch.outer(vector, vector).flatten()
    return signs.to(device)


FACE = Layout(
    (
        Channel("deformation_gradient", 9, Kind.FROM_REST),
        Channel("normal", 3, Kind.VECTOR),
        Channel("centroid", 3, Kind.VECTOR, length=True),
        Channel("signed_distance", 1, Kind.SCALAR, length=True),
        Channel("direction_to_body", 3, Kind.VECTOR),
        Channel("body_deformation", 9, Kind.MAP, at_rest="identity"),
        Channel("body_velocity", 3, Kind.VECTOR, at_rest="zero", length=True),
        Channel("singular_values", 3, Kind.SCALAR),
    )
)
"""Channels of a face that a network can read; face.py defines each of them."""

INTERACTION = Layout(
    (
        Channel("closest", 3, Kind.POINT, length=True),
        Channel("sign", 1, Kind.SCALAR),
        Channel("deformation", 9, Kind.MAP, at_rest="identity"),
        Channel("velocity", 3, Kind.VECTOR, at_rest="zero", length=True),
    )
)
"""Channels of a stored `BodyInteraction`: all its fields except the index of the body face."""

OUTDOOR = Layout(
    (
        Channel("density", 1, Kind.SCALAR),
        Channel("stretch", 1, Kind.SCALAR),
        Channel("shear", 1, Kind.SCALAR),
        Channel("bend", 1, Kind.SCALAR),
        Channel("friction", 1, Kind.SCALAR),
        Channel("wind", 3, Kind.VECTOR, length=True),
    )
)
"""Channels of a face for its cloth and the air about it, which no kernel writes; outdoor.py defines each."""

FEATURES, LAYOUT = FACE.width, FACE.slices
