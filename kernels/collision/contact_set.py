"""Contacts, sources of contacts, and the gap of each contact.

Contact k requires the cloth to keep a distance along a direction n_k from a point U_k of an obstacle:

    n_k · (Σ_j w_kj V_j - U_k) ≥ d_k

If both sides are cloth, it requires one part to keep that distance from another. Then all vertices are in the stencil,
with weights of both signs, and U_k is zero. With g_k = Σ_j w_kj e_j ⊗ n_k, solver.py moves the vertices by

    (B ⊗ I₃ + Σ_k g_k g_kᵀ) D = Σ_k g_k c_k,    c_k = d_k - n_k·(Σ_j w_kj Ṽ_j - U_k)

| symbol | code | what |
| --- | --- | --- |
| n_k | `normal` | unit vector away from the obstacle; zero for no contact |
| U_k | `anchor` | a point [m] of the obstacle, or of its tangent plane |
| d_k | `distance` | distance to keep [m] |
| V_j, w_kj | `vertex`, `weight` | the stencil: at most four vertices and their weights |
| c_k | `gap` | distance [m] by which the cloth is too close, along the normal |

If each vertex has at most one contact, contact k is at vertex k, and there is no stencil. Only such contacts can be
solved now.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.sdf.bodies import BodyMeshes

wp.set_module_options(compiling.options())


class Contacts(NamedTuple):
    """K contacts. They are constants of a solve: no gradient flows into them."""

    normal: torch.Tensor
    """n, float64 [K,3]: unit vectors, zero for no contact."""
    anchor: torch.Tensor
    """U [m], float64 [K,3]; zero if both sides are in the stencil."""
    distance: torch.Tensor | float
    """d [m], a number or float [K]."""
    vertex: torch.Tensor | None = None
    """int32 [K,4], packed vertices, -1 for an unused one; None if contact k is at vertex k, where K = V."""
    weight: torch.Tensor | None = None
    """w, float64 [K,4]; None if `vertex` is None."""


class ContactFrame(NamedTuple):
    """Inputs of a source of contacts besides the positions: the bodies, and the owners of the vertices."""

    bodies: BodyMeshes
    """The bodies in the frame of the positions."""
    body_of_vertex: torch.Tensor | None = None
    """int32 [V]; -1 for vertices of a garment that needs no contacts. None if there is one body."""
    garment_of_vertex: torch.Tensor | None = None
    """int32 [V]; None if there is one garment."""
    epsilon: torch.Tensor | float = 0.004
    """Distance to keep from the bodies [m], a number or float32 [V]."""
    origin: torch.Tensor | None = None
    """Positions of vertices if they had moved with the body [m], float32 [V,3], see `features.carry`, or NaN."""
    clear: torch.Tensor | None = None
    """Radius of the ball around each vertex that is known to hold no surface of its body [m], float32 [V]."""


class ContactSource(Protocol):
    """Finds contacts of a batch of garments with a kind of obstacle."""

    name: str
    """Name of the obstacle, for messages."""

    def find(self, vertices: torch.Tensor, frame: ContactFrame) -> Contacts:
        """Contacts of the positions [m], float32 [V,3], on their device.

        Frames are recorded as CUDA graphs. So nothing here may wait for the device, as `.item()` and indexing by a mask
        do, and shapes must not change from frame to frame.
        """
        ...


def one_for_each_vertex(contacts: Contacts, what: str = "contacts") -> Contacts:
    """Returns the contacts, after a check that they have no stencils.

    Raises:
        ValueError: They have stencils; the message names `what` and the fields.
    """
    if contacts.vertex is not None or contacts.weight is not None:
        raise ValueError(
            f"{what}: `vertex` and `weight` are given, but stencils of several vertices cannot be solved yet; leave "
            "both out and give one contact for each vertex"
        )
    return contacts


def nearest(found: Sequence[Contacts], vertices: torch.Tensor) -> Contacts:
    """One contact at each vertex: of those of several sources, the one with the largest gap.

    Args:
        found: Contacts of each source, without stencils; at least one.
        vertices: The positions [m] for which they were found, float32 [V,3].

    Returns:
        V contacts. Those of a single source are returned unchanged; otherwise distances are float64 [V].
    """
    if len(found) == 1:
        return found[0]
    normal, anchor, distance = (torch.stack(parts) for parts in zip(*map(_spread, found), strict=True))
    gap = distance - (normal * (vertices.detach().double() - anchor)).sum(2)
    chosen = torch.where((normal != 0).any(2), gap, -torch.inf).argmax(0)
    row = torch.arange(len(vertices), device=vertices.device)
    return Contacts(normal[chosen, row], anchor[chosen, row], distance[chosen, row])


def _spread(contacts: Contacts) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Normals, anchors and distances of contacts, with the distance expanded to one for each contact."""
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
    distance: wp.array[wp.float64],  # of each contact, or one for all
    # Out:
    gap: wp.array[wp.float64],
):
    """c = d - n·(Ṽ - U) at the contacts, zero elsewhere."""
    i, _ = wp.tid()  # see compiling.py
    n = normal[i]
    c = wp.float64(0.0)
    if wp.dot(n, n) > c:
        c = distance[wp.min(i, distance.shape[0] - 1)] - wp.dot(n, wp.vec3d(vertices[i]) - anchor[i])
    gap[i] = c
