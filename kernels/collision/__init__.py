"""Collision refinement: vertices that are too close to a body are moved out, and the cloth around them follows."""

from .body_contacts import contacts
from .solver import CollisionSolver, refine

__all__ = ["CollisionSolver", "contacts", "refine"]
