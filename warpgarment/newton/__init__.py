"""Neural garments in Newton: a solver for the cloth particles of a `newton.Model` (extra `physics`).

The library never imports this room. See docs/newton.md.
"""

from __future__ import annotations

try:
    import newton as _newton  # noqa: F401
except ImportError as error:
    from warpgarment.errors import MissingExtra

    raise MissingExtra("physics", "The solver for Newton") from error

from .collider import ShapeCollider
from .garments import add_garment
from .solver import SolverNeuralGarment

__all__ = ["ShapeCollider", "SolverNeuralGarment", "add_garment"]
