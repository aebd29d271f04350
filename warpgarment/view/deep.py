"""Says where cloth is in the body after a rollout, and whether the body left it any room."""

from __future__ import annotations

import numpy as np

from warpgarment.geometry.depth import DeepPlace, deep_place
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.motion import GarmentMotion
from warpgarment.progress import parts

from .matched import matched

DEEP = 2e-3
"""Depth from which it is said where [m]."""
MOST = 8
"""Frames that are looked at, the deepest ones."""


def depth_lines(motion: GarmentMotion, body: BodyMotion, keep: float) -> list[str]:
    """Sentences on the frames in which a garment is deep in the body; none where there are none.

    Args:
        motion: The garment, with its statuses.
        body: The body with which it collided, at any rate.
        keep: Distance that its vertices keep from the body [m], see `clearance`.
    """
    depths = np.array([status.max_penetration for status in motion.status])
    if len(depths) != motion.frames or not (depths > DEEP).any():
        return []
    deep = np.flatnonzero(depths > DEEP)
    chosen = np.sort(deep[np.argsort(-depths[deep], kind="stable")][:MOST])
    shown, below = matched([motion, body], ["the garment", "the body"])
    places = {
        int(frame): deep_place(shown.vertices[frame], motion.faces, below.vertices[frame], body.faces)
        for frame in parts(chosen, "looking where it is deep")
        if frame < shown.frames
    }
    if not places:
        return []
    worst = max(places, key=lambda frame: places[frame].depth)
    held = [frame for frame, one in places.items() if not one.free(keep)]
    count = f"{len(deep):,} of {motion.frames:,} frames are deeper than {1e3 * DEEP:.0f} mm"
    looked = "all of them were" if len(places) == len(deep) else f"the {len(places)} deepest were"
    lines = [f"{count}; {looked} looked at. {_one(worst, places[worst], keep)}"]
    if held:
        frames = ", ".join(map(str, held))
        lines.append(
            f"in {len(held)} of these {len(places)} frames ({frames}) the body goes through itself, or leaves less "
            "room than cloth keeps on both sides: no cloth can be free there. Move the limbs apart, or leave them out "
            "of the body with which it collides."
        )
    return lines


def _one(frame: int, found: DeepPlace, keep: float) -> str:
    where = ", ".join(f"{value:.2f}" for value in found.place)
    text = f"Deepest is {1e3 * found.depth:.1f} mm in frame {frame}, at ({where}) m"
    through, room = f"{1e3 * found.through:.0f} mm", f"{1e3 * found.room:.0f} mm"
    if found.parts > 1:
        return f"{text}, inside {found.parts} parts of the body, which goes through itself by {through} there."
    if found.through >= 1e-3:
        return f"{text}, where the body goes through itself by {through}."
    if not found.free(keep):
        return f"{text}, where the body leaves {room} of room and cloth keeps {1e3 * keep:.0f} mm on both sides."
    return f"{text}; the body leaves room there."
