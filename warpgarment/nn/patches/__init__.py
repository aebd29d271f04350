"""A network whose cost is linear in the faces: they are pooled into patches of cloth, which attend to each other."""

from .architecture import PatchesOfCloth

ARCHITECTURE = PatchesOfCloth()
