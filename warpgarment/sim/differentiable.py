"""The geometry of a frame with gradients: what `Scene` does in fused launches without them, operator by operator.

Training through several frames (`training/unroll.py`) needs them. Values are the same up to rounding.
"""

from __future__ import annotations

import torch

from warpgarment.kernels.deformation.gradients import face_centroids, segment_mean
from warpgarment.kernels.deformation.svd import replace_singular_values
from warpgarment.kernels.features.channels import LAYOUT
from warpgarment.kernels.features.face import body_interaction, face_features
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.nn.parametrisation import Step
from warpgarment.objects.pack import PackedGarments


def components_mean(packed: PackedGarments, vertices: torch.Tensor) -> torch.Tensor:
    """Mean face centroid of each component [m], [V,3] -> [C,3]."""
    return segment_mean(face_centroids(vertices, packed.faces), packed.face_component, packed.component_count)


def features(
    packed: PackedGarments,
    inverse_rest: torch.Tensor,
    vertices: torch.Tensor,
    body_of_face: torch.Tensor,
    bodies: BodyMeshes,
    next_body: torch.Tensor,
) -> torch.Tensor:
    """Features of a frame [F,34]; which body face is nearest is held fixed in the gradient."""
    centroids = face_centroids(vertices, packed.faces)
    interaction = body_interaction(centroids, body_of_face, bodies, next_body)
    mean = segment_mean(centroids, packed.garment_of_face, packed.count)
    return face_features(inverse_rest, vertices, packed.faces, packed.garment_of_face, mean, interaction)


def next_gradients(
    packed: PackedGarments, features: torch.Tensor, step: Step, *, replace: bool, smallest: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Deformation gradients of the next frame [F,3,3], and which garments are finite [B]; see the kernel's module."""
    phi = features[:, LAYOUT["deformation_gradient"]].reshape(-1, 3, 3)
    sound = torch.isfinite(step.psi).flatten(1).all(1) & torch.isfinite(step.singular_values).all(1)
    sound &= torch.isfinite(step.velocity).all(1)[packed.face_component.long()]
    owner = packed.garment_of_face.long()
    broken = torch.zeros(packed.count, dtype=torch.int32, device=phi.device).index_add(0, owner, (~sound).int())
    finite = broken == 0
    kept = finite[owner]
    target = (torch.where(kept[:, None, None], step.psi, torch.eye(3, device=phi.device)) @ phi).contiguous()
    if replace:
        stretch = torch.where(kept[:, None], step.singular_values, 1.0).clamp(min=smallest)
        target = replace_singular_values(target, stretch)
    return target, finite
