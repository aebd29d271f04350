"""Means and standard deviations by which a network normalises its inputs and outputs."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from warpgarment.kernels.features.channels import Kind
from warpgarment.nn.network import GarmentNetwork

from .outfits import OutfitBatch
from .single_step import Batch

POSITION_FLOORS = {"state": 1e-3, "offset": 1e-3, "acceleration": 1e-4}  # [m], [m/frame]; [m/frame^2]
OUTDOOR_FLOOR = 0.1  # least deviation of outdoor channels: a factor of 1.26 of a material, 0.1 m/s
FLOORS = {"feature": 3e-3, "velocity": 1e-3, "psi": 1e-3, "singular_value": 1e-3, "q": 3e-4}  # least deviations


def statistics(batches: Iterable[Batch], network: GarmentNetwork) -> dict[str, torch.Tensor]:
    """Means and standard deviations of inputs and targets over some batches.

    Residual outputs keep the means with which a garment moves like skin. Deviations have lower bounds, so that numbers
    which hardly vary (a body at rest, a singular value that is always one) do not become very large.
    """
    samples: dict[str, list[torch.Tensor]] = {name: [] for name in FLOORS}
    outside: list[torch.Tensor] = []
    for batch in batches:
        faces = slice(None) if batch.face_mask is None else batch.face_mask
        samples["feature"].append(network.read(batch.features[faces]).reshape(-1, network.channels.width))
        outside += _outdoor(batch)
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
    return found | _outdoor_found(outside, network)


def outdoor_statistics(batches: Iterable[Batch], network: GarmentNetwork) -> dict[str, torch.Tensor]:
    """Means and standard deviations of outdoor channels over some batches; empty for a network without any."""
    return _outdoor_found([rows for batch in batches for rows in _outdoor(batch)], network)


def _outdoor(batch: Batch) -> list[torch.Tensor]:
    """The outdoor channels of the real faces of a batch, as rows [*,K]; none for a network without any."""
    if batch.outdoor is None:
        return []
    return [batch.outdoor[slice(None) if batch.face_mask is None else batch.face_mask].flatten(0, -2)]


def _outdoor_found(parts: list[torch.Tensor], network: GarmentNetwork) -> dict[str, torch.Tensor]:
    """Statistics of rows of outdoor channels.

    Of a vector such as the wind the mean stays zero, so that calm air is zero, and the deviation is the same along all
    axes. Channels of materials count where the material is known; they have mean 0 and deviation 1 if it never is.
    """
    if not parts:
        return {}
    values = torch.cat(parts).double()
    mean, deviation = values.new_zeros(values.shape[1]), values.new_ones(values.shape[1])
    for channel, place in zip(network.outdoor.channels, network.outdoor.slices.values(), strict=True):
        known = values[:, place][values[:, place].isfinite().all(dim=1)]
        if not len(known):
            continue
        if channel.kind is Kind.SCALAR:
            mean[place] = known.mean(dim=0)
        deviation[place] = (known - mean[place]).square().mean().sqrt()
    return {"outdoor_mean": mean.float(), "outdoor_std": deviation.clamp(min=OUTDOOR_FLOOR).float()}


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
