"""Runs a network on rows of garments: the one place where inputs are turned, mirrored, normalised and cast for it.

    features, velocities, target       world space, physical units
      turn                             to the network's heading (heading.py), then by `turn`; the rest pose is turned by
                                       `rest_turn`
      mirror                           in x, for the rows of `mirrored`
      normalise, noise, cast           by the network's statistics; Gaussian noise on its inputs; bfloat16
    forward_normalised
      denormalise, mirror, turn back   in float32

Simulation, training and `GarmentNetwork.forward` all use it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import torch

from warpgarment.kernels.features.channels import FACE, Channel, Kind, Layout

from .heading import canonical_frame, rotate_features, rotate_matrices, rotate_vectors
from .inputs import NormalisedOutput, RowInputs
from .parametrisation import NetworkOutput

if TYPE_CHECKING:
    from .network import GarmentNetwork

VELOCITY = Layout([Channel("velocity", 3, Kind.VECTOR)])
PSI = Layout([Channel("psi", 9, Kind.MAP)])


class Ran(NamedTuple):
    """Result of a call of the network."""

    output: NetworkOutput  # physical units; in world space, or in the network's frame if the inputs were
    normalised: NormalisedOutput  # in the network's frame
    target: NormalisedOutput | None  # in the network's frame; None if none was given


def run(
    network: GarmentNetwork,
    inputs: RowInputs,
    *,
    noise: float = 0.0,
    bfloat16: bool = False,
    target: NetworkOutput | None = None,
) -> Ran:
    """Runs a network on rows of garments.

    Args:
        network: The network; in training mode, dropout is on.
        inputs: Inputs in world space, or in the network's frame if `in_network_frame` is set.
        noise: Standard deviation of Gaussian noise on the normalised inputs; 0 for none.
        bfloat16: Whether `forward_normalised` runs under autocast to bfloat16. Otherwise the caller's autocast applies.
        target: The desired output, in the same space as the inputs; None if there is none.
    """
    normalised, turn, wanted = _network(network, inputs, noise, bfloat16, target)
    with torch.autocast(inputs.features.device.type, enabled=False):
        output = network.denormalise(normalised)
        if inputs.mirrored is not None:
            output = mirror_output(output, inputs.mirrored)
        return Ran(rotate_output(output, turn, inverse=True), normalised, wanted)


def normalised(
    network: GarmentNetwork, inputs: RowInputs, *, noise: float = 0.0, bfloat16: bool = False
) -> tuple[NormalisedOutput, torch.Tensor | None]:
    """The same without what follows the network, and the rotation of each row to the network's frame, [R,3,3] or None.

    Rows that are mirrored stay so in the output; the arguments are those of `run`.
    """
    said, turn, _ = _network(network, inputs, noise, bfloat16, None)
    return said, turn


def _network(
    network: GarmentNetwork, inputs: RowInputs, noise: float, bfloat16: bool, target: NetworkOutput | None
) -> tuple[NormalisedOutput, torch.Tensor | None, NormalisedOutput | None]:
    """Normalised output, rotation of the rows and normalised target."""
    kind = inputs.features.device.type
    half = bfloat16 or torch.is_autocast_enabled(kind)
    dtype = torch.bfloat16 if bfloat16 else torch.get_autocast_dtype(kind)
    mirrored, embedded = inputs.mirrored, None
    with torch.autocast(kind, enabled=False):  # half precision is for the network, not for positions
        velocities, turn = inputs.velocities, _turn(network, inputs)
        if not (noise or inputs.in_network_frame):
            plain = mirrored is None and inputs.rest_turn is None and not inputs.live
            if plain:
                embedded = network.embedded(inputs.features, turn, inputs.face_mask)
            else:
                embedded = network.embedded_rows(inputs, turn)
        features = inputs.whole() if embedded is None else inputs.features
        if turn is not None:
            if embedded is None:
                features = rotate_features(features, turn, inputs.rest_turn)
            velocities = rotate_vectors(velocities, turn)
            target = None if target is None else rotate_output(target, turn)
        if mirrored is not None:
            velocities = mirror_rows(velocities, VELOCITY, mirrored)
            if embedded is None:
                features = mirror_rows(features, FACE, mirrored)
            target = None if target is None else mirror_output(target, mirrored)
        x = network.encode(features) if embedded is None else embedded
        outdoor = _outdoor(network, inputs, turn)
        v = network.encode_velocities(velocities)
        if noise:
            x = x + noise * torch.randn_like(x)
            v = v + noise * torch.randn_like(v)
        x = network.with_outdoor(x, outdoor, inputs.face_mask, embedded=embedded is not None)
    call = network.forward_normalised if embedded is None else network.forward_embedded
    with torch.autocast(kind, dtype=dtype, enabled=half):
        said = call(x, v, inputs.rows, face_mask=inputs.face_mask, component_mask=inputs.component_mask)
    with torch.autocast(kind, enabled=False):
        wanted = None if target is None else network.normalise_targets(target)
    return said, turn, wanted


def _turn(network: GarmentNetwork, inputs: RowInputs) -> torch.Tensor | None:
    """Rotations from the inputs' world to the network's frame, [R,3,3]; None if there is nothing to turn."""
    if inputs.in_network_frame or network.config.heading == "world":
        return None if inputs.in_network_frame else inputs.turn
    own = canonical_frame(inputs.newest, inputs.face_mask)
    return own if inputs.turn is None else inputs.turn @ own


def _outdoor(network: GarmentNetwork, inputs: RowInputs, turn: torch.Tensor | None) -> torch.Tensor | None:
    """Outdoor channels in the network's frame, [R,N,K]; None if the network has none or none are given."""
    if inputs.outdoor is None or not network.outdoor.width:
        return None
    rows = network.known(inputs.outdoor)
    if turn is not None:
        rows = rows @ network.outdoor.turn(turn).mT
    return rows if inputs.mirrored is None else mirror_rows(rows, network.outdoor, inputs.mirrored)


def rotate_output(output: NetworkOutput, turn: torch.Tensor | None, *, inverse: bool = False) -> NetworkOutput:
    """An output, or a target, rotated like the inputs, or back; unchanged if `turn` is None.

    Args:
        output: Output in physical units, shapes as in `NetworkOutput` with rows in front.
        turn: Rotation of each row, shape [R,3,3].
        inverse: Whether to rotate back to the world.
    """
    if turn is None:
        return output
    turn = turn.mT if inverse else turn
    return NetworkOutput(
        rotate_matrices(output.psi, turn), output.singular_values, rotate_vectors(output.velocity, turn)
    )


def mirror_inputs(
    features: torch.Tensor, velocities: torch.Tensor, chosen: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Features [R,N,H*K] and velocities [R,C,(H-1)*3], mirrored in x in the chosen rows, bool [R]."""
    return features * _signs(FACE, features, chosen), velocities * _signs(VELOCITY, velocities, chosen)


def mirror_rows(rows: torch.Tensor, layout: Layout, chosen: torch.Tensor) -> torch.Tensor:
    """Channels of a layout [R,N,K], or of several frames [R,N,H*K], mirrored in x in the chosen rows, bool [R]."""
    return rows * _signs(layout, rows, chosen)


def mirror_output(output: NetworkOutput, chosen: torch.Tensor) -> NetworkOutput:
    """An output, or a target, mirrored in x in the chosen rows, bool [R]; a second call undoes it."""
    psi = output.psi.flatten(-2)
    return output._replace(
        psi=(psi * _signs(PSI, psi, chosen)).unflatten(-1, (3, 3)),
        velocity=output.velocity * _signs(VELOCITY, output.velocity, chosen),
    )


def _signs(layout: Layout, values: torch.Tensor, chosen: torch.Tensor) -> torch.Tensor:
    """Signs [R,1,W] by which mirroring multiplies values [R,*,W], which hold the layout one or several times."""
    signs = layout.mirror(values.device).repeat(values.shape[-1] // layout.width)
    return torch.where(chosen[:, None], signs, torch.ones_like(signs))[:, None]


@contextmanager
def evaluating(network: GarmentNetwork) -> Iterator[None]:
    """Puts a network in evaluation mode for a block, and restores its mode afterwards.

    A network that is in evaluation mode is left alone: to set the mode of all its parts takes a millisecond or two.
    """
    if not network.training:
        yield
        return
    network.eval()
    try:
        yield
    finally:
        network.train()
