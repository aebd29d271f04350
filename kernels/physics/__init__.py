"""Energies of cloth, and implicit steps that lower them."""

from .cloth import PhysicsCloth, Sheet
from .solver import ImplicitSolver

__all__ = ["ImplicitSolver", "PhysicsCloth", "Sheet"]
