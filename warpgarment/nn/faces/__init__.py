"""The paper's network: every face of a garment is a token."""

from .architecture import Faces

ARCHITECTURE = Faces()
