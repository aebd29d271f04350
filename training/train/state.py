"""The state of a training run in one safetensors file: weights, averaged weights, optimiser, pool, and progress.

Random numbers need no state: every step makes its own from (seed, step).
"""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from warpgarment.errors import CheckpointError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.plain import check_plain, parsed_json
from warpgarment.nn.network import GarmentNetwork
from warpgarment.training.data.schema import is_finite


class Average:
    """Exponential moving average of a network's weights; statistics are copied.

    Args:
        network: The network in training.
        decay: Decay per update; after n updates it is at most (1 + n) / (10 + n).
    """

    def __init__(self, network: GarmentNetwork, decay: float) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay, self.updates = decay, 0
        self._mine: list[torch.Tensor] = list(self.network.parameters())
        self._buffers = list(self.network.buffers())

    @torch.no_grad()
    def update(self, network: torch.nn.Module) -> None:
        """Adds the current weights to the average."""
        weight = 1.0 - min(self.decay, (1.0 + self.updates) / (10.0 + self.updates))
        self.updates += 1
        torch._foreach_lerp_(self._mine, list(network.parameters()), weight)
        for mine, theirs in zip(self._buffers, network.buffers(), strict=True):
            mine.copy_(theirs)


def save(
    path: Path,
    network: torch.nn.Module,
    average: Average,
    optimizer: torch.optim.Optimizer,
    extra: dict[str, torch.Tensor],
    progress: dict[str, Any],
) -> None:
    """Writes the state under a temporary name, flushes and renames it, so that the file `path` is always complete."""
    tensors = {f"network.{k}": v for k, v in network.state_dict().items()}
    tensors |= {f"average.{k}": v for k, v in average.network.state_dict().items()}
    for index, values in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{k}": torch.as_tensor(v) for k, v in values.items()}
    tensors |= extra
    tensors = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    metadata = {"progress": json.dumps(progress | {"average_updates": average.updates})}
    with atomic_file(path) as temporary:
        save_file(tensors, temporary, metadata=metadata)


def _check(progress: Any, tensors: dict[str, torch.Tensor]) -> None:
    """Raises ValueError unless the progress has its entries and all numbers are finite."""
    counts, numbers = ("step", "pool_step", "average_updates"), ("elapsed", "best")
    whole = isinstance(progress, dict) and all(type(progress.get(key)) is int and progress[key] >= 0 for key in counts)
    if not whole or not all(isinstance(progress.get(key), float | int) for key in numbers):
        raise ValueError(f"its progress lacks one of {', '.join((*counts, *numbers))}, or it is no number")
    rows = progress.get("recent", [])
    if not isinstance(rows, list) or not all(isinstance(r, list) and all(map(is_finite, r)) for r in rows):
        raise ValueError("its recent losses are not finite numbers")
    if not 0 <= progress["elapsed"] < math.inf or math.isnan(progress["best"]):
        raise ValueError(f"{progress['elapsed']:g} s so far, with an error of {progress['best']:g} cm at best")
    bad = [name for name, tensor in tensors.items() if not torch.isfinite(tensor).all()]
    if bad:
        raise ValueError(f"{len(bad)} of {len(tensors)} tensors are not finite (first: {bad[0]})")
    rollouts = {name.split(".")[1] for name in tensors if name.startswith("pool.")}
    for name in rollouts:
        place, moved = tensors.get(f"pool.{name}.place"), tensors.get(f"pool.{name}.displacement")
        if place is None or moved is None or place.shape != (2,) or place.is_floating_point():
            raise ValueError(f"rollout {name} of its pool has no place or no positions")


def load(
    path: Path, network: torch.nn.Module, average: Average, optimizer: torch.optim.Optimizer
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Restores what `save` wrote, in place.

    Returns:
        The extra tensors, and the progress.

    Raises:
        CheckpointError: The file is not a training state, or is one of another network.
    """
    try:
        check_plain(path)
        with safe_open(path, framework="pt", device="cpu") as file:
            progress = parsed_json(path, file.metadata()["progress"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        _check(progress, tensors)

        def part(prefix: str) -> dict[str, torch.Tensor]:
            return {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}

        network.load_state_dict(part("network."))
        average.network.load_state_dict(part("average."))
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, value in part("optimizer.").items():
            index, key = name.split(".", 1)
            state.setdefault(int(index), {})[key] = value
        optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    except Exception as error:
        raise CheckpointError(f"{path}: cannot resume from it ({error}); start anew with resume=False") from error
    average.updates = progress["average_updates"]
    return {k: v for k, v in tensors.items() if k.split(".")[0] not in ("network", "average", "optimizer")}, progress
