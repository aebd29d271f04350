"""The kinds of networks there are, and what the rest of the program asks of a kind.

`ARCHITECTURES` names the module of each kind; it is imported when a network of that kind is used. A user's own kind is
a line more in this dict, in the user's process: docs/extending.md shows how.
"""

from __future__ import annotations

import importlib
from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np
    import torch

    from warpgarment.objects.garment import Garment

    from .config import NetworkConfig
    from .inputs import NetworkSizes
    from .network import GarmentNetwork

ARCHITECTURES = {"faces": "warpgarment.nn.faces", "patches": "warpgarment.nn.patches"}
"""Modules by the `architecture` of a `NetworkConfig`; each has one object `ARCHITECTURE`."""


class GrowthError(ValueError):
    """A network that cannot be grown to the shape wanted; says what is in the way."""


class Architecture(Protocol):
    """One kind of network. Inherit from it to take over what has a default here.

    Attributes:
        config: Class of its settings.
        presets: Its named shapes, for `TrainConfig.network`.
        subsets: Whether it may see a part of a garment's faces as well as all of them. Where not, it sees all in a
            simulation whatever `face_splits` says, and in training once garments are no longer split.
    """

    config: type[NetworkConfig]
    presets: Mapping[str, NetworkConfig]
    subsets: bool

    def build(self, config: NetworkConfig) -> GarmentNetwork:
        """An untrained network."""
        ...

    def geometry(self, garment: Garment, config: NetworkConfig) -> Any:
        """What a network must know of how the faces of a garment lie on the cloth, on the host: computed once."""
        return None

    def sampled(self, geometry: Any, config: NetworkConfig, device: torch.device) -> Any:
        """The same in a form that training draws many random subsets of faces from; for `rows`."""
        return geometry

    def rows(
        self,
        shown: Sequence[tuple[Any, np.ndarray | None]],
        config: NetworkConfig,
        device: torch.device,
        scale: Sequence[float] | np.ndarray | None = None,
    ) -> Any:
        """What `forward_normalised` is given as `rows`.

        Args:
            shown: Of each row its garment's `geometry`, and its faces in their order, None for all. One entry serves
                all rows of a batch that is one garment many times.
            config: Settings of the network.
            device: Where tensors go.
            scale: Factor of the lengths of each row; None: 1.
        """
        return None

    def entries(self, garment: Garment, faces: int, config: NetworkConfig) -> int:
        """Numbers that `rows` holds for a row of so many faces: limits how many rows share a call of the network."""
        return 0

    def alike(self, garment: Garment) -> Hashable:
        """Rows share a call only where this is the same for their garments."""
        return None

    def memory(self, sizes: NetworkSizes, config: NetworkConfig) -> dict[str, int]:
        """Bytes that a simulation needs for the network, by purpose.

        What lasts is added up. Of "network" and "making weights", which are needed in passing, and of what other stages
        need in passing, only the largest counts.
        """
        ...

    def flops(self, config: NetworkConfig, faces: int, components: int, rows: Any) -> tuple[int, int]:
        """Operations of the forward pass for one row, see flops.py.

        Returns:
            Those of products both of whose factors need a gradient, and those of the others.
        """
        ...

    def start_from(
        self, network: GarmentNetwork, config: NetworkConfig, *, grow: bool, seed: int = 0
    ) -> GarmentNetwork:
        """The network that a training starts from.

        Args:
            network: A trained one.
            config: Shape wanted, of this kind.
            grow: Whether the network is to have that shape and predict what the given one does.
            seed: Seed for weights that are initialised at random.

        Raises:
            GrowthError: It cannot be grown to that shape.
        """
        if grow:
            raise GrowthError(
                f"there is no rule by which a network with architecture={config.architecture!r} grows. Leave out grow "
                "to train it further in its own shape"
            )
        return network


def architecture(name: str) -> Architecture:
    """The kind of network of a name.

    Raises:
        ValueError: There is none of that name.
    """
    check_name(name)
    return importlib.import_module(ARCHITECTURES[name]).ARCHITECTURE


def check_name(name: str) -> None:
    """Refuses a name that is none of `ARCHITECTURES`.

    Raises:
        ValueError: Names those there are.
    """
    if name not in ARCHITECTURES:
        *others, last = (f'"{known}"' for known in ARCHITECTURES)
        known = f"{', '.join(others)} or {last}" if others else last
        raise ValueError(f"architecture must be {known}, got {name!r}")


def build_network(config: NetworkConfig) -> GarmentNetwork:
    """An untrained network of the kind that `config.architecture` names."""
    return architecture(config.architecture).build(config)


def preset(name: str) -> NetworkConfig:
    """The settings of a named shape, of whichever kind.

    Raises:
        ValueError: There is none of that name.
    """
    presets: dict[str, NetworkConfig] = {}
    for kind in ARCHITECTURES:
        presets |= architecture(kind).presets
        if name in presets:
            return presets[name]
    raise ValueError(f"no network {name!r}; there are {', '.join(presets)}")
