"""What a network sees of each face: its deformation, its place, and the body nearby."""

from .channels import FEATURES, LAYOUT
from .face import BodyInteraction, body_interaction, face_features

__all__ = ["FEATURES", "LAYOUT", "BodyInteraction", "body_interaction", "face_features"]
