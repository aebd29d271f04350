"""Deformation gradients of triangles, their singular values, and the gradients of the next frame."""

from .gradients import (
    deformation_gradient,
    deformation_gradient_from_inverse,
    face_centroids,
    face_frames,
    face_normals,
    inverse_rest_frames,
    relative_deformation_gradient,
    segment_mean,
)
from .replaced import replace_singular_values, rotation
from .svd import singular_values

__all__ = [
    "deformation_gradient",
    "deformation_gradient_from_inverse",
    "face_centroids",
    "face_frames",
    "face_normals",
    "inverse_rest_frames",
    "relative_deformation_gradient",
    "replace_singular_values",
    "rotation",
    "segment_mean",
    "singular_values",
]
