"""Requirements on a garment before it is simulated, besides being an oriented manifold."""

from __future__ import annotations

from typing import TYPE_CHECKING

import igl
import numpy as np

from warpgarment.bodies.rest import RestBody
from warpgarment.geometry.cutting import boundary_loops
from warpgarment.objects.garment import Garment

from .layers import Sheet

if TYPE_CHECKING:
    from .pattern import Pattern

_LOOPS = {"tshirt": 4, "top": 4, "dress": 4, "jumpsuit": 5, "trousers": 3, "skirt": 2, "jacket": 3, "hooded_jacket": 3}


def expected_loops(pattern: Pattern) -> int:
    """Number of boundary loops: hem or legs, neck, sleeves or armholes; a jacket's opening joins hem and neck."""
    if pattern.neckline == "strapless" and pattern.category in ("top", "dress", "jumpsuit"):
        return _LOOPS[pattern.category] - 2
    return _LOOPS[pattern.category]


def faults(garment: Garment, body: RestBody, pattern: Pattern, gap: float) -> list[str]:
    """Faults of a garment as the start of a simulation; empty if there are none.

    Args:
        garment: Garment on the body in its rest pose.
        body: The body.
        pattern: Pattern from which the garment was made.
        gap: Least distance from the body with which the garment was made [m].
    """
    errors = []
    loops, expected = len(boundary_loops(garment.faces)), expected_loops(pattern)
    euler = len(garment.vertices) - len(garment.edges) + len(garment.faces)
    if garment.components[2] != 1:
        errors.append(f"{garment.components[2]} pieces instead of one")
    elif loops != expected:
        errors.append(f"{loops} boundary loops instead of {expected}")
    elif euler != 2 - loops:  # a sphere with `loops` holes
        errors.append(f"{(2 - loops - euler) // 2} handles")
    points = garment.vertices.astype(np.float64)
    distance = igl.signed_distance(
        points, body.vertices, body.faces.astype(np.int64), sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    )[0]
    if distance.min() < 0.8 * gap:
        errors.append(f"{int((distance < 0.8 * gap).sum()):,} vertices are nearer to the body than {gap * 1e3:.0f} mm")
    crossings = int(Sheet(garment.faces).self_crossings(garment.vertices).sum())
    if crossings:
        errors.append(f"{crossings:,} pairs of its faces cross")
    return errors
