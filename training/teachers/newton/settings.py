"""Settings of the Newton teacher."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpgarment.kernels.wind import DRAG, LIFT
from warpgarment.training.teachers import ClothScene


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of VBD that gave clean drapes at edges of 25 to 50 mm.

    Attributes:
        substeps: Number of substeps per frame. With fewer than 10, the body goes through the cloth.
        iterations: Number of iterations per substep.
        bend_damping: Damping of an edge's bending [N s].
        contact_stiffness: Stiffness of contact with the body [N/m].
        contact_damping: Damping of contact with the body [N s/m].
        margin: Thickness added to the body [m].
        contact_gap: Distance within which contact with the body is detected [m].
        radius: Particle radius as a share of the edge length; with a smaller one the body pokes through coarse faces.
        self_margin: Distance kept between cloths [m].
        self_gap: Distance beyond `self_margin` within which contact between cloths is detected [m].
        layer_friction: Coefficient of friction between cloths; None takes the mean of the materials of each scene.
        drag, lift: Coefficients of the air forces on each face, without unit.
    """

    substeps: int = 10
    iterations: int = 5
    bend_damping: float = 1e-4
    contact_stiffness: float = 1e4
    contact_damping: float = 0.1
    margin: float = 3e-3
    contact_gap: float = 0.03
    radius: float = 0.19
    self_margin: float = 4e-3
    self_gap: float = 12e-3
    layer_friction: float | None = None
    drag: float = DRAG
    lift: float = LIFT


CONVERGED = NewtonSettings(substeps=20, iterations=10)
"""Settings with which the sheets of :mod:`.checks` stretch as they should."""


def layer_friction(scene: ClothScene, settings: NewtonSettings) -> float:
    """The coefficient of friction between cloths, of which a model has only one."""
    return _mean_friction(scene) if settings.layer_friction is None else settings.layer_friction


def _mean_friction(scene: ClothScene) -> float:
    return float(np.mean([cloth.material.friction for cloth in scene.cloths]))
