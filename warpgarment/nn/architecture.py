"""The kinds of networks there are, and the interface that each of them implements.

`ARCHITECTURES` names the module of each kind, imported when a network of that kind is used. Users add a kind of
their own as one more entry of this dict, in their own process: see docs/extending.md.
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

ARCHITECTURES = {
    "faces": "warpgarment.nn.faces",
    "patches": "warpgarment.nn.patches",
    "layers": "warpgarment.nn.layers",
}
"""Module of each value of `NetworkConfig.architecture`; every such module has an object `ARCHITECTURE`."""


class GrowthError(ValueError):
    """A network cannot be grown to the shape wanted; the message gives the reason."""


class Architecture(Protocol):
    """One kind of network. Subclasses inherit the methods that have a default here.

    Attributes:
        config: Class of the network's settings.
        presets: Named settings, which `TrainConfig.network` can choose.
        subsets: Whether a network may be run on some of a garment's faces. If not, a simulation always gives it all
            faces, whatever `face_splits` is, and training does so once garments are no longer split.
        positions: Whether networks of this kind answer with a `VertexStep`. They are trained on positions of whole
            outfits, and read no features of faces then.
        apart: Whether networks of this kind read the frames of a history where each of them is, on a CPU, so that a
            simulation need not put them side by side.
    """

    config: type[NetworkConfig]
    presets: Mapping[str, NetworkConfig]
    subsets: bool
    positions: bool = False
    apart: bool = False

    def build(self, config: NetworkConfig) -> GarmentNetwork:
        """An untrained network."""
        ...

    def geometry(self, garment: Garment, config: NetworkConfig) -> Any:
        """How the faces of a garment lie on the cloth, for example geodesic distances; on the host, computed once."""
        return None

    def sampled(self, geometry: Any, config: NetworkConfig, device: torch.device) -> Any:
        """The `geometry` in a form from which `rows` quickly takes many random subsets of faces, in training."""
        return geometry

    def rows(
        self,
        shown: Sequence[tuple[Any, np.ndarray | None]],
        config: NetworkConfig,
        device: torch.device,
        scale: Sequence[float] | np.ndarray | None = None,
    ) -> Any:
        """The argument `rows` of `forward_normalised`.

        Args:
            shown: For each row, the `geometry` of its garment and the indices of its faces in their order; None for
                all faces. A single entry serves all rows of a batch that repeats one garment.
            config: Settings of the network.
            device: Device of the result.
            scale: Factor by which the lengths of each row are multiplied; None for 1.
        """
        return None

    def entries(self, garment: Garment, faces: int, config: NetworkConfig) -> int:
        """Number of entries of `rows` for one row of `faces` faces; it limits the rows in one call of the network."""
        return 0

    def alike(self, garment: Garment) -> Hashable:
        """A key of the garment; only rows whose garments have equal keys share a call of the network."""
        return None

    def memory(self, sizes: NetworkSizes, config: NetworkConfig) -> dict[str, int]:
        """Bytes that a simulation needs for the network, by purpose.

        The entries "network" and "making weights" are temporary: only the largest of them, and of the temporary memory
        of other stages, counts. All other entries last for the whole simulation and are added up.
        """
        ...

    def patch_means(self, layout: Any, positions: torch.Tensor) -> torch.Tensor:
        """The means that `VertexStep.patches` predicts, of positions [V,3]; only for kinds that predict them."""
        raise TypeError(f"{type(self).__name__} predicts no patches")

    def flops(self, config: NetworkConfig, faces: int, components: int, rows: Any) -> tuple[int, int]:
        """Number of operations of the forward pass for one row, see flops.py.

        Returns:
            Operations of products both of whose factors need a gradient, and operations of all other products.
        """
        ...

    def start_from(
        self, network: GarmentNetwork, config: NetworkConfig, *, grow: bool, seed: int = 0
    ) -> GarmentNetwork:
        """The network that a training starts from.

        Args:
            network: A trained network.
            config: The shape wanted, of this kind.
            grow: Whether the result has that shape and predicts the same as `network`.
            seed: Seed for weights that are initialised at random.

        Raises:
            GrowthError: The network cannot be grown to that shape.
        """
        if grow:
            raise GrowthError(
                f"there is no rule by which a network with architecture={config.architecture!r} grows. Leave out grow "
                "to train it further in its own shape"
            )
        return network


def architecture(name: str) -> Architecture:
    """The kind of network with a name.

    Raises:
        ValueError: No kind has that name.
    """
    check_name(name)
    return importlib.import_module(ARCHITECTURES[name]).ARCHITECTURE


def check_name(name: str) -> None:
    """Checks that a name is in `ARCHITECTURES`.

    Raises:
        ValueError: It is not; the message lists the known names.
    """
    if name not in ARCHITECTURES:
        *others, last = (f'"{known}"' for known in ARCHITECTURES)
        known = f"{', '.join(others)} or {last}" if others else last
        raise ValueError(f"architecture must be {known}, got {name!r}")


def build_network(config: NetworkConfig) -> GarmentNetwork:
    """An untrained network of the kind that `config.architecture` names."""
    return architecture(config.architecture).build(config)


def preset(name: str) -> NetworkConfig:
    """The settings of a named shape, looked up in the presets of all kinds.

    Raises:
        ValueError: No kind has a preset of that name.
    """
    presets: dict[str, NetworkConfig] = {}
    for kind in ARCHITECTURES:
        presets |= architecture(kind).presets
        if name in presets:
            return presets[name]
    raise ValueError(f"no network {name!r}; there are {', '.join(presets)}")
