"""Settings of the Warp teacher."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from warpgarment.kernels.wind import DRAG, LIFT


@dataclass(frozen=True)
class WarpSettings:
    """Settings of the implicit solver and of contact.

    Attributes:
        substeps: Number of steps per frame.
        iterations: Evaluations of energy and gradient per step.
        tolerance: Root of the mean square of an iteration's step [m] at which iterations end early; 0: never.
        scheme: Scheme of time integration: implicit Euler, or BDF2, which damps less.
        memory: Pairs of the quasi-Newton method.
        bend_damping: Damping of an edge's bending [N s].
        contact_stiffness: Stiffness of contact with the body, per area [N/m^3].
        margin: Thickness added to the body [m].
        radius: Thickness of cloth as a share of the edge length; with a smaller one the body pokes through coarse
            faces, since contact is at vertices.
        contact_gap: Distance beyond both within which contact with the body is detected [m].
        slip: Speed [m/s] below which friction is not yet full.
        self_contact: Whether cloth meets cloth.
        self_margin: Distance kept between cloths [m].
        self_stiffness: Stiffness of contact between cloths, of a pair of faces [N/m].
        drag, lift: Coefficients of the air forces on each face, without unit.
    """

    substeps: int = 10
    iterations: int = 15
    tolerance: float = 0.0
    scheme: Literal["euler", "bdf2"] = "euler"
    memory: int = 20
    bend_damping: float = 1e-4
    contact_stiffness: float = 1e5
    margin: float = 3e-3
    radius: float = 0.19
    contact_gap: float = 0.02
    slip: float = 5e-3
    self_contact: bool = True
    self_margin: float = 4e-3
    self_stiffness: float = 20.0
    drag: float = DRAG
    lift: float = LIFT
