"""The cloth of a garment and the air about it, as channels of its faces for networks whose settings name them.

    density, stretch, shear, bend, friction    log10 of the material's value over that of a common cloth; the mean of
                                               the training data for a garment without a material
    wind                                       velocity of the air at t+1 minus that of the face's centroid [m/s]

The velocity of a face is the way of its centroid from t-1 to t, times the frames per second. So still air is felt as
well, as minus the velocity of the face, which is what drag depends on. Of the two moments of a step the channel has
the air of the later one, in whose wind the cloth arrives; the air of t was in the step before.

These channels are of the newest frame only, beside the stacked features of the history. The wind is a vector: it turns
to the network's heading and is mirrored with the garment (`OUTDOOR` in channels.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from .channels import Layout

ATTRIBUTES = (  # number of the field of `Material`, its common value, its least value (SI)
    (0, 0.3, 1e-3),  # density [kg/m^2]
    (1, 1e3, 1.0),  # stretch [N/m]
    (2, 1e3, 1.0),  # shear [N/m]
    (3, 1e-3, 1e-6),  # bend [N]
    (5, 0.3, 1e-2),  # friction
)
CLOTH = ("density", "stretch", "shear", "bend", "friction")  # the channels of `ATTRIBUTES`, in their order


def attributes(materials: torch.Tensor | None, like: torch.Tensor, count: int) -> torch.Tensor:
    """Materials as networks see them, [B,5], with the type and device of another tensor.

    Args:
        materials: Fields of `Material` of each garment, shape [B,M], NaN for a garment without one; None if none has.
        like: The other tensor.
        count: Number of garments B.
    """
    if materials is None:
        return like.new_full((count, len(ATTRIBUTES)), torch.nan)
    columns = [(materials[:, field].clamp(min=least) / common).log10() for field, common, least in ATTRIBUTES]
    return torch.stack(columns, dim=1).to(like.dtype)


def needs(channels: Sequence[str]) -> frozenset[str]:
    """The optional inputs of a simulation from which these channels follow."""
    found = {"materials"} if set(channels) & set(CLOTH) else set()
    return frozenset(found | ({"previous", "wind"} if "wind" in channels else set()))


def face_velocity(now: torch.Tensor, before: torch.Tensor, faces: torch.Tensor, fps: float) -> torch.Tensor:
    """Velocities of the centroids of faces [m/s], shape [F,3].

    Args:
        now: Vertices at t [m], shape [V,3].
        before: Vertices at t-1 [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
        fps: Frames per second.
    """
    return (now - before)[faces.long()].sum(dim=1) * (fps / 3.0)


def columns(layout: Layout, cloth: torch.Tensor, air: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    """The channels of a layout, in its order, before normalisation.

    Args:
        layout: Channels of `OUTDOOR`.
        cloth: The result of `attributes` for each face, shape [...,5].
        air: Velocity of the air at t+1 [m/s], shape [...,3].
        velocity: Velocity of each face [m/s], shape [...,3].

    Returns:
        Rows, shape [...,K]; NaN in the channels of a material that is not known.
    """
    parts = dict(zip(CLOTH, cloth.split(1, dim=-1), strict=True)) | {"wind": air - velocity}
    return torch.cat([parts[name] for name in layout.names], dim=-1)


def packed_columns(
    layout: Layout,
    fps: float,
    now: torch.Tensor,
    before: torch.Tensor | None,
    faces: torch.Tensor,
    garment_of_face: torch.Tensor,
    materials: torch.Tensor | None,
    air: torch.Tensor | None,
) -> torch.Tensor | None:
    """The channels of a packed batch, [F,K]; None for a layout without any.

    Args:
        layout: Channels of `OUTDOOR`.
        fps: Frames per second.
        now: Vertices at t [m], shape [V,3].
        before: Vertices at t-1 [m], shape [V,3]; None if they do not move.
        faces: Global vertex indices, shape [F,3].
        garment_of_face: Garment of each face, shape [F].
        materials: Fields of `Material`, shape [B,M]; None if no garment has one.
        air: Velocity of the air at t+1 [m/s], shape [B,3]; None for still air.
    """
    if not layout.width:
        return None
    owner = garment_of_face.long()
    velocity = now.new_zeros((len(faces), 3))
    if before is not None:
        velocity = face_velocity(now, before, faces, fps)
    if materials is None:
        cloth = now.new_full((len(faces), len(ATTRIBUTES)), torch.nan)
    else:
        cloth = attributes(materials, now, len(materials))[owner]
    blowing = torch.zeros_like(velocity) if air is None else air.to(now.dtype)[owner]
    return columns(layout, cloth, blowing, velocity)
