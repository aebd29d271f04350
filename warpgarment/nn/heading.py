"""Removes the garment's heading from the inputs of the network, and adds it to its output.

Cloth behaves the same whichever way its wearer faces: turning everything about the vertical (+Y) turns the motion.
With `heading="canonical"` the network need not learn this symmetry. The yaw of the newest frame,

    theta = argmax_t tr(R_y(t)^T M) = atan2(M02 - M20, M00 + M22),    M = mean over faces of the deformation gradient,

turns with the garment; inputs of all frames are turned by -theta, outputs by +theta. With G = R_y(-theta):

    Phi -> G Phi       (the rest pose does not turn)     n, c, v, velocities -> G v
    d   -> G d G^T     (body deformation)                Psi -> G Psi G^T            distances, singular values stay
"""

from __future__ import annotations

import torch

from warpgarment.kernels.features.channels import FACE, FEATURES, LAYOUT


def yaw(deformation_gradient: torch.Tensor, face_mask: torch.Tensor | None = None) -> torch.Tensor:
    """The heading of each garment about +Y.

    Args:
        deformation_gradient: Deformation gradients of the newest frame, shape [B,N,3,3].
        face_mask: True where a face is real, shape [B,N]; None where all are.

    Returns:
        Angle [rad], shape [B]; zero for a garment without a heading, where the sum of the gradients has no yaw.
    """
    if face_mask is not None:
        deformation_gradient = torch.where(face_mask[..., None, None], deformation_gradient, 0.0)
    total = deformation_gradient.sum(dim=1)  # the angle of a sum is the angle of the mean
    return torch.atan2(total[:, 0, 2] - total[:, 2, 0], total[:, 0, 0] + total[:, 2, 2])


def rotation_about_up(angle: torch.Tensor) -> torch.Tensor:
    """Rotations about +Y; angles [B] in radians -> [B,3,3]."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    return torch.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], dim=-1).reshape(*angle.shape, 3, 3)


def canonical_frame(face_features: torch.Tensor, face_mask: torch.Tensor | None = None) -> torch.Tensor:
    """The rotation G = R_y(-yaw) that turns each garment to heading zero.

    Args:
        face_features: Stacked features, oldest first, shape [B,N,H*34].
        face_mask: True where a face is real, shape [B,N]; None where all are.

    Returns:
        Rotations, shape [B,3,3].
    """
    newest = face_features[..., -FEATURES:]
    phi = newest[..., LAYOUT["deformation_gradient"]].unflatten(-1, (3, 3))
    return rotation_about_up(-yaw(phi, face_mask))


def rotate_features(face_features: torch.Tensor, frame: torch.Tensor, rest: torch.Tensor | None = None) -> torch.Tensor:
    """Features of a garment and body turned by a rotation.

    Args:
        face_features: Stacked features, shape [B,N,H*34].
        frame: Rotation of each garment and its body, shape [B,3,3].
        rest: Rotation of each rest pose, shape [B,3,3]; None if it is not turned.

    Returns:
        Features, shape [B,N,H*34].
    """
    per_frame = face_features.reshape(len(face_features), -1, FEATURES)
    return torch.bmm(per_frame, FACE.turn(frame, rest).mT).reshape(face_features.shape)


def rotate_vectors(vectors: torch.Tensor, frame: torch.Tensor) -> torch.Tensor:
    """Vectors stacked along the last axis, turned: [B,C,K*3] by [B,3,3] -> [B,C,K*3]."""
    return (vectors.unflatten(-1, (-1, 3)) @ frame[:, None].mT).flatten(-2)


def rotate_matrices(matrices: torch.Tensor, frame: torch.Tensor) -> torch.Tensor:
    """Maps from space to space (Psi, R) turned: G A G^T, [B,N,3,3] by [B,3,3] -> [B,N,3,3]."""
    if torch.is_grad_enabled():  # gradients of one product of matrices 9 x 9 are cheaper than of two of 3 x 3 a face
        both = (frame[:, :, None, :, None] * frame[:, None, :, None, :]).reshape(-1, 9, 9)
        return torch.bmm(matrices.flatten(-2), both.mT).unflatten(-1, (3, 3))
    turn = frame[:, None]
    return turn @ matrices @ turn.mT
