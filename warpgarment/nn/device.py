"""The device that a user names, or the default one."""

from __future__ import annotations

import torch

from warpgarment.errors import UsageError


def device_of(name: torch.device | str | None) -> torch.device:
    """The device with a name; a GPU always has an index.

    Args:
        name: "cpu", "cuda", "cuda:0", ...; None takes a GPU if there is one.

    Raises:
        UsageError: The name is of another kind, or there is no such GPU.
    """
    if name is None or name == "":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError, ValueError):
        raise UsageError(f"there is no device {str(name)!r}. Give cpu, or cuda:0 where there is a GPU.") from None
    if device.type not in ("cpu", "cuda"):
        raise UsageError(f"{device} is not a device that garments move on. Give cpu, or cuda:0 where there is a GPU.")
    if device.type == "cpu":
        return torch.device("cpu")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0:
        raise UsageError(f"{device}: PyTorch sees no GPU here. Give cpu, or see `warpgarment doctor`.")
    index = torch.cuda.current_device() if device.index is None else device.index
    if index >= count:
        raise UsageError(f"{device}: there are {count} GPUs, numbered from 0.")
    return torch.device("cuda", index)
