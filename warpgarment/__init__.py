"""Neural garment dynamics for any garment on any moving body, on NVIDIA Warp and PyTorch."""

from __future__ import annotations

import contextlib
import gc
import importlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpgarment.dressing.dress import Dressed, DressedOutfit, dress
    from warpgarment.nn import checkpoint
    from warpgarment.nn.config import NetworkConfig
    from warpgarment.nn.faces.network import ManifoldAwareTransformer
    from warpgarment.nn.layers.config import LayersNetConfig
    from warpgarment.nn.layers.network import LayersNet
    from warpgarment.nn.patches.network import PatchTransformer
    from warpgarment.objects.body import BodyMotion, read_body
    from warpgarment.objects.fit import fit
    from warpgarment.objects.garment import Garment
    from warpgarment.objects.material import Material
    from warpgarment.objects.motion import GarmentMotion
    from warpgarment.objects.outfit import Outfit
    from warpgarment.objects.status import RolloutStatus, Verdict
    from warpgarment.objects.wind import Wind
    from warpgarment.sim.results.rerun import Rerun
    from warpgarment.sim.simulator import Simulator
    from warpgarment.view.browser.page import browse

    from . import demo, kernels, metrics
    from .errors import CheckpointError, DressingError, MeshError, MissingExtra, NotEnoughMemory
    from .geometry import geodesics
    from .sim import memory
    from .sim.results import differentiable
    from .view import draw

    __version__: str

__all__ = [
    "BodyMotion",
    "CheckpointError",
    "Dressed",
    "DressedOutfit",
    "DressingError",
    "Garment",
    "GarmentMotion",
    "LayersNet",
    "LayersNetConfig",
    "ManifoldAwareTransformer",
    "Material",
    "MeshError",
    "MissingExtra",
    "NetworkConfig",
    "NotEnoughMemory",
    "Outfit",
    "PatchTransformer",
    "Rerun",
    "RolloutStatus",
    "Simulator",
    "Verdict",
    "Wind",
    "__version__",
    "browse",
    "checkpoint",
    "demo",
    "differentiable",
    "draw",
    "dress",
    "fit",
    "geodesics",
    "kernels",
    "memory",
    "metrics",
    "read_body",
]

# Where public names live. They are imported when first used: `warpgarment --help` waits for neither torch nor Warp.
_HOME = {
    "BodyMotion": "objects.body",
    "CheckpointError": "errors",
    "Dressed": "dressing.dress",
    "DressedOutfit": "dressing.dress",
    "DressingError": "errors",
    "Garment": "objects.garment",
    "GarmentMotion": "objects.motion",
    "LayersNet": "nn.layers.network",
    "LayersNetConfig": "nn.layers.config",
    "ManifoldAwareTransformer": "nn.faces.network",
    "Material": "objects.material",
    "MeshError": "errors",
    "MissingExtra": "errors",
    "NetworkConfig": "nn.config",
    "NotEnoughMemory": "errors",
    "Outfit": "objects.outfit",
    "PatchTransformer": "nn.patches.network",
    "Rerun": "sim.results.rerun",
    "RolloutStatus": "objects.status",
    "Simulator": "sim.simulator",
    "Verdict": "objects.status",
    "Wind": "objects.wind",
    "browse": "view.browser.page",
    "dress": "dressing.dress",
    "fit": "objects.fit",
    "read_body": "objects.body",
}
_MODULES = {
    "checkpoint": "nn.checkpoint",
    "demo": "demo",
    "differentiable": "sim.results.differentiable",
    "draw": "view.draw",
    "geodesics": "geometry.geodesics",
    "kernels": "kernels",
    "memory": "sim.memory",
    "metrics": "metrics",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: Any
    if name == "__version__":  # of what is installed
        from importlib.metadata import version

        value = version(__name__)
    else:
        with _uncollected():
            home = importlib.import_module(f".{_HOME.get(name) or _MODULES[name]}", __name__)
        value = getattr(home, name) if name in _HOME else home
    globals()[name] = value
    return value


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Context without garbage collections, for imports: they make half a million objects that stay, which Python would
    visit again and again, a fifth of a second in all. At the end these are in its oldest generation, as if visited."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():
            gc.freeze()
            gc.unfreeze()
        gc.enable()


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
