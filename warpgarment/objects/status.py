"""The outcome of a frame of a rollout, in terms a user can act on."""

from __future__ import annotations

import enum
from dataclasses import dataclass

PENETRATION_TOLERANCE = 0.01
"""Depth of the deepest point [m] from which a frame counts as penetrating."""


class Verdict(enum.Enum):
    """Judgement on a frame; `message` names the remedy."""

    OK = "ok"
    PENETRATING = "penetrating"
    CROSSING = "crossing"
    NOT_FINITE = "not finite"

    @property
    def message(self) -> str:
        """One or two sentences for the user."""
        return _MESSAGES[self]


_MESSAGES = {
    Verdict.OK: "Every number is finite and nothing of the garment is deep in the body.",
    Verdict.PENETRATING: (
        "Part of the garment is deep in the body. Start from a garment outside it (wg.dress, --dress; wg.fit, "
        "--fit-rest if it was modelled on this body), raise collision_passes, or drop squeezed parts such as hands "
        "with BodyMotion.submesh."
    ),
    Verdict.CROSSING: (
        "Triangles of the garment cross each other or another garment of its outfit. Layers that cross in the first "
        "frame are moved apart, if `layers` has them innermost first; a garment that crosses itself goes on crossing. "
        "Start from garments that lie over each other."
    ),
    Verdict.NOT_FINITE: (
        "The garment holds NaN or infinite positions from this frame on. Check that the garment and the body are in "
        "metres and that the garment is draped on the body in the first frame (wg.dress, --dress)."
    ),
}


@dataclass(frozen=True)
class RolloutStatus:
    """The outcome of one frame.

    Attributes:
        frame: Index in the motion, from 0.
        finite: Whether every position is finite.
        max_penetration: Depth of the garment's deepest point below the body's surface [m], at least 0. Points are its
            vertices, and points of its edges and faces; see `warpgarment.kernels.sdf.surface_depth`. Of pieces that
            ride on the cloth (`Garment.simulated`), which contacts do not push out, they are the vertices alone.
        poisson_iterations: Number of conjugate gradient iterations of the Poisson solve, the largest of all
            components; 0 if it was solved directly.
        collision_iterations: Number of conjugate gradient iterations of the collision refinement, the largest of all
            components, summed over the passes.
        verdict: Judgement that follows from these figures.
        layer_crossings: Number of pairs of triangles, one of this garment and one of another of its outfit, that cross.
            None if they were not counted, or not all of them: a garment of no outfit, or cloth so crumpled that some
            pairs were not looked at.
        self_crossings: Number of pairs of triangles of this garment, without a common vertex, that cross; or None.
        lag: How far the vertex that stayed behind most, so as not to cross cloth, is from where it should be [m]; None
            if nothing held it, as in the first frame.
    """

    frame: int
    finite: bool
    max_penetration: float
    poisson_iterations: int
    collision_iterations: int
    verdict: Verdict
    layer_crossings: int | None = None
    self_crossings: int | None = None
    lag: float | None = None

    @classmethod
    def judged(
        cls,
        frame: int,
        finite: bool,
        max_penetration: float,
        poisson_iterations: int = 0,
        collision_iterations: int = 0,
        *,
        layer_crossings: int | None = None,
        self_crossings: int | None = None,
        lag: float | None = None,
        tolerance: float = PENETRATION_TOLERANCE,
    ) -> RolloutStatus:
        """A status whose verdict follows from its figures; `tolerance` is the largest acceptable depth [m]."""
        if not finite:
            verdict = Verdict.NOT_FINITE
        else:
            verdict = Verdict.PENETRATING if max_penetration > tolerance else Verdict.OK
            if verdict is Verdict.OK and (layer_crossings or self_crossings):
                verdict = Verdict.CROSSING
        return cls(
            frame,
            finite,
            max_penetration,
            poisson_iterations,
            collision_iterations,
            verdict,
            layer_crossings,
            self_crossings,
            lag,
        )

    @property
    def message(self) -> str:
        """The message of the verdict, with the number of the frame."""
        return f"Frame {self.frame}: {self.verdict.message}"
