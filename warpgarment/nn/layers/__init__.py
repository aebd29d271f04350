"""LayersNet, for outfits of several garments, each of its own material, in the wind."""

from .architecture import Layers

ARCHITECTURE = Layers()
