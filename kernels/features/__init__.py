"""What a network sees of each face: its deformation, its place, and the body nearby."""

from .face import FEATURES, LAYOUT, BodyInteraction, body_interaction, face_features

__all__ = ["FEATURES", "LAYOUT", "BodyInteraction", "body_interaction", "face_features"]
