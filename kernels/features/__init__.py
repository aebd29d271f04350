"""Features of each face for a network: its deformation, its position, and the body nearby."""

from .channels import FEATURES, LAYOUT
from .face import BodyInteraction, body_interaction, face_features

__all__ = ["FEATURES", "LAYOUT", "BodyInteraction", "body_interaction", "face_features"]
