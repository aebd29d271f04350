"""What a contact is, who finds contacts, and how far each one is from what it asks for.

Contact k asks that the cloth keeps a distance along a direction n_k from a point U_k of something that is not cloth:

    n_k · (Σ_j w_kj V_j - U_k) ≥ d_k

or, where both sides are cloth, that one part of it keeps that distance from another: then all vertices are in the
stencil, with weights of both signs, and U_k is zero. With g_k = Σ_j w_kj e_j ⊗ n_k, solver.py moves the vertices by

    (B ⊗ I₃ + Σ_k g_k g_kᵀ) D = Σ_k g_k c_k,    c_k = d_k - n_k·(Σ_j w_kj Ṽ_j - U_k)

| symbol | code | what |
| --- | --- | --- |
| n_k | `normal` | unit vector, away from what is touched; zero: no contact |
| U_k | `anchor` | a point of what is touched, or of its tangent plane |
| d_k | `distance` | distance to keep |
| V_j, w_kj | `vertex`, `weight` | the stencil: at most four vertices and their weights |
| c_k | `gap` | what is missing along the normal |

Where each vertex has at most one contact, contact k is at vertex k, and there is no stencil. This is the only kind that
can be solved today.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
import warp as wp

from warpgarment.kernels.sdf.bodies import BodyMeshes


class Contacts(NamedTuple):
    """K contacts. They are constants of a solve: no gradient flows into them."""

    normal: torch.Tensor
    """n, float64 [K,3]: unit vectors, zero where there is no contact."""
    anchor: torch.Tensor
    """U [m], float64 [K,3]; zero where both sides are in the stencil."""
    distance: torch.Tensor | float
    """d [m], a number or float [K]."""
    vertex: torch.Tensor | None = None
    """int32 [K,4], packed vertices, -1 where one is not used; None: contact k is at vertex k, and K = V."""
    weight: torch.Tensor | None = None
    """w, float64 [K,4]; None where `vertex` is."""


class ContactFrame(NamedTuple):
    """What a source of contacts may look at besides the positions: the bodies, and whose vertices these are."""

    bodies: BodyMeshes
    """The bodies in the frame of the positions."""
    body_of_vertex: torch.Tensor | None = None
    """int32 [V]; -1: of a garment that is not looked at any more. None where there is one body."""
    garment_of_vertex: torch.Tensor | None = None
    """int32 [V]; None where there is one garment."""
    epsilon: torch.Tensor | float = 0.004
    """Distance to keep from the bodies [m], a number or float32 [V]."""
    origin: torch.Tensor | None = None
    """Where each vertex comes from [m], as seen from the bodies, float32 [V,3]; NaN where that is not known."""


class ContactSource(Protocol):
    """Finds the contacts of a batch of garments with something."""

    name: str
    """What is touched, for messages."""

    def find(self, vertices: torch.Tensor, frame: ContactFrame) -> Contacts:
        """Contacts of the positions [m], float32 [V,3], on their device.

        Frames are recorded as CUDA graphs: nothing here may wait for the device, such as `.item()` or indexing by a
        mask, and shapes must not change from frame to frame.
        """
        ...


def one_for_each_vertex(contacts: Contacts, what: str = "contacts") -> Contacts:
    """The contacts, if they have no stencils.

    Raises:
        ValueError: They have; names `what` and the fields.
    """
    if contacts.vertex is not None or contacts.weight is not None:
        raise ValueError(
            f"{what}: `vertex` and `weight` are given, but stencils of several vertices cannot be solved yet; leave "
            "both out and give one contact for each vertex"
        )
    return contacts


def nearest(found: Sequence[Contacts], vertices: torch.Tensor) -> Contacts:
    """One contact at each vertex, of those that several sources have found: that with the largest gap.

    Args:
        found: Contacts of each source, without stencils; at least one.
        vertices: The positions that they were found for [m], float32 [V,3].

    Returns:
        The contacts of the only source as they are; of several sources, with distances float64 [V].
    """
    if len(found) == 1:
        return found[0]
    normal, anchor, distance = (torch.stack(parts) for parts in zip(*map(_spread, found), strict=True))
    gap = distance - (normal * (vertices.detach().double() - anchor)).sum(2)
    chosen = torch.where((normal != 0).any(2), gap, -torch.inf).argmax(0)
    row = torch.arange(len(vertices), device=vertices.device)
    return Contacts(normal[chosen, row], anchor[chosen, row], distance[chosen, row])


def _spread(contacts: Contacts) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Normals, anchors and distances, one distance for each contact."""
    normal, anchor, distance, *_ = contacts
    if isinstance(distance, torch.Tensor):
        return normal, anchor, distance.double()
    return normal, anchor, normal.new_full((len(normal),), distance)


@wp.kernel(enable_backward=False)
def contact_gap(
    # In:
    vertices: wp.array[wp.vec3],
    normal: wp.array[wp.vec3d],
    anchor: wp.array[wp.vec3d],
    distance: wp.float64,
    # Out:
    gap: wp.array[wp.float64],
):
    """c = d - n·(Ṽ - U) at the contacts, zero elsewhere."""
    i = wp.tid()
    n = normal[i]
    c = wp.float64(0.0)
    if wp.dot(n, n) > c:
        c = distance - wp.dot(n, wp.vec3d(vertices[i]) - anchor[i])
    gap[i] = c
