"""Settings of the Newton teacher."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpgarment.kernels.wind import DRAG, LIFT
from warpgarment.training.teachers import ClothScene


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of VBD that gave clean drapes at 25 to 50 mm edges. SI units.

    Attributes:
        substeps, iterations: Per frame and per substep. Fewer than 10 substeps let the body through.
        bend_damping: Damping of an edge's bending [N s].
        contact_stiffness, contact_damping: Body contact [N/m], [N s/m].
        margin: Thickness added to the body [m].
        contact_gap: Distance at which body contact is looked for [m].
        radius: Particle radius as a share of the edge length; coarse faces let the body poke through otherwise.
        self_margin, self_gap: Distance kept between cloths, and how much farther contact is looked for [m].
        layer_friction: Coefficient between cloths; None: of each scene its own, the mean of its materials.
        drag, lift: Coefficients of the air forces per face.
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
    """The coefficient between cloths, of which a model has one."""
    return _mean_friction(scene) if settings.layer_friction is None else settings.layer_friction


def _mean_friction(scene: ClothScene) -> float:
    return float(np.mean([cloth.material.friction for cloth in scene.cloths]))
