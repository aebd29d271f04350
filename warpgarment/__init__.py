"""Neural garment dynamics for any garment on any moving body, on NVIDIA Warp and PyTorch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import demo, draw, geodesics, kernels, memory, metrics
    from .body import BodyMotion
    from .errors import CheckpointError, MeshError, MissingExtra, NotEnoughMemory
    from .fitting import fit
    from .garment import Garment
    from .motion import GarmentMotion
    from .network import ManifoldAwareTransformer, NetworkConfig, PatchTransformer
    from .simulator import Simulator
    from .status import RolloutStatus, Verdict

    __version__: str

__all__ = [
    "BodyMotion",
    "CheckpointError",
    "Garment",
    "GarmentMotion",
    "ManifoldAwareTransformer",
    "MeshError",
    "MissingExtra",
    "NetworkConfig",
    "NotEnoughMemory",
    "PatchTransformer",
    "RolloutStatus",
    "Simulator",
    "Verdict",
    "__version__",
    "demo",
    "draw",
    "fit",
    "geodesics",
    "kernels",
    "memory",
    "metrics",
]

# Where a public name lives. Names are imported when first used: `warpgarment --help` waits for neither torch nor Warp.
_HOME = {
    "BodyMotion": "body",
    "CheckpointError": "errors",
    "Garment": "garment",
    "GarmentMotion": "motion",
    "ManifoldAwareTransformer": "network",
    "MeshError": "errors",
    "MissingExtra": "errors",
    "NetworkConfig": "network",
    "NotEnoughMemory": "errors",
    "PatchTransformer": "network",
    "RolloutStatus": "status",
    "Simulator": "simulator",
    "Verdict": "status",
    "fit": "fitting",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: Any
    if name == "__version__":  # of what is installed
        from importlib.metadata import version

        value = version(__name__)
    else:
        home = importlib.import_module(f".{_HOME.get(name, name)}", __name__)
        value = getattr(home, name) if name in _HOME else home
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
