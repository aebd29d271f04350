"""How a frame of a rollout turned out, in terms a user can act on."""

from __future__ import annotations

import enum
from dataclasses import dataclass

PENETRATION_TOLERANCE = 0.01
"""Depth of the deepest point [m] from which a frame counts as penetrating."""


class Verdict(enum.Enum):
    """What is to be said about a frame; `message` names the remedy."""

    OK = "ok"
    PENETRATING = "penetrating"
    NOT_FINITE = "not finite"

    @property
    def message(self) -> str:
        """One sentence for the user."""
        return _MESSAGES[self]


_MESSAGES = {
    Verdict.OK: "Every number is finite and no vertex lies deep in the body.",
    Verdict.PENETRATING: (
        "A vertex lies deep in the body. Start from a garment outside it (wg.fit), raise collision_passes, "
        "or drop squeezed parts such as hands with BodyMotion.submesh."
    ),
    Verdict.NOT_FINITE: (
        "The garment holds NaN or infinite positions from this frame on. Check that the garment and the body are in "
        "metres and that the garment is draped on the body in the first frame (wg.fit)."
    ),
}


@dataclass(frozen=True)
class RolloutStatus:
    """One frame's outcome.

    Attributes:
        frame: Index in the motion, from 0.
        finite: Whether every position is finite.
        max_penetration: Depth of the garment's deepest point below the body's surface [m], at least 0: of its
            vertices, and of points of its edges and faces, see `kernels.surface_depth`.
        poisson_iterations: Conjugate gradient iterations of the Poisson solve, the largest of all components; 0 where
            it was solved directly.
        collision_iterations: The same of the collision refinement.
        verdict: What follows from these.
    """

    frame: int
    finite: bool
    max_penetration: float
    poisson_iterations: int
    collision_iterations: int
    verdict: Verdict

    @classmethod
    def judged(
        cls,
        frame: int,
        finite: bool,
        max_penetration: float,
        poisson_iterations: int = 0,
        collision_iterations: int = 0,
        *,
        tolerance: float = PENETRATION_TOLERANCE,
    ) -> RolloutStatus:
        """A status whose verdict follows from the figures; `tolerance` is the depth [m] that is still fine."""
        if not finite:
            verdict = Verdict.NOT_FINITE
        else:
            verdict = Verdict.PENETRATING if max_penetration > tolerance else Verdict.OK
        return cls(frame, finite, max_penetration, poisson_iterations, collision_iterations, verdict)

    @property
    def message(self) -> str:
        """The verdict's sentence, with the frame it is about."""
        return f"Frame {self.frame}: {self.verdict.message}"
