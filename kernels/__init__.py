"""Numerics on arrays, in Warp kernels. A module such as `warpgarment.kernels.sdf` is imported when it is first used."""

from __future__ import annotations

import importlib
from types import ModuleType


def __getattr__(name: str) -> ModuleType:
    home = f"{__name__}.{name}"
    try:
        return importlib.import_module(home)
    except ModuleNotFoundError as error:
        if error.name != home:
            raise
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
