"""Means and standard deviations by which a network normalises its inputs and outputs."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from warpgarment.nn.network import GarmentNetwork

from .outfits import OutfitBatch
from .single_step import Batch

POSITION_FLOORS = {"state": 1e-3, "offset": 1e-3, "acceleration": 1e-4}  # [m], [m/frame]; [m/frame^2]
FLOORS = {"feature": 3e-3, "velocity": 1e-3, "psi": 1e-3, "singular_value": 1e-3, "q": 3e-4}  # least deviations


def statistics(batches: Iterable[Batch], network: GarmentNetwork) -> dict[str, torch.Tensor]:
    """Means and standard deviations of inputs and targets over some batches.

    Residual outputs keep the means with which a garment moves like skin. Deviations have lower bounds, so that numbers
    which hardly vary (a body at rest, a singular value that is always one) do not become very large.
    """
    samples: dict[str, list[torch.Tensor]] = {name: [] for name in FLOORS}
    for batch in batches:
        faces = slice(None) if batch.face_mask is None else batch.face_mask
        samples["feature"].append(network.read(batch.features[faces]).reshape(-1, network.channels.width))
        real = slice(None) if batch.velocity_mask is None else batch.velocity_mask
        samples["velocity"].append(batch.velocities[real].reshape(-1, 3))
        samples["psi"].append(batch.target.psi[faces].reshape(-1, 9))
        samples["singular_value"].append(batch.target.singular_values[faces].reshape(-1, 3))
        samples["q"].append(batch.target.velocity[real].reshape(-1, 3))
    found = {}
    for name, parts in samples.items():
        values = torch.cat(parts).double()
        mean = values.mean(dim=0)
        if network.config.residual and name in ("psi", "q"):
            mean = torch.eye(3, dtype=torch.float64).flatten() if name == "psi" else torch.zeros(3, dtype=torch.float64)
        deviation = (values - mean.to(values.device)).square().mean(dim=0).sqrt()
        found[f"{name}_mean"] = mean.float()
        found[f"{name}_std"] = deviation.clamp(min=FLOORS[name]).float()
    return found


def position_statistics(batches: Iterable[OutfitBatch], network: GarmentNetwork) -> dict[str, torch.Tensor]:
    """Means and standard deviations of what a network that predicts positions observes in some batches.

    Deviations have lower bounds, as above.
    """
    samples: dict[str, list[torch.Tensor]] = {}
    for batch in batches:
        newest = batch.ahead + 2
        inputs = batch.inputs(batch.recorded(newest), newest, network.reads)
        for name, values in network.observed(inputs, batch.layout, batch.frames[newest + 1]).items():
            samples.setdefault(name, []).append(values)
    found = {}
    for name, parts in samples.items():
        values = torch.cat(parts).double()
        found[f"{name}_mean"] = values.mean(dim=0).float()
        found[f"{name}_std"] = values.std(dim=0, correction=0).clamp(min=POSITION_FLOORS.get(name, 1e-9)).float()
    return found
