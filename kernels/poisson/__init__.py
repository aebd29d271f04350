"""The Poisson solve: positions whose deformation gradients are nearest to given ones."""

from .solver import PoissonSolver

__all__ = ["PoissonSolver"]
