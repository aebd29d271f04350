"""From a plan to the start of its simulation: the posed body, and its garments at the start of the motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from warpgarment.bodies.anny import anny_bodies
from warpgarment.bodies.clips import jumps, list_clips, read_clip, retarget
from warpgarment.bodies.rest import RestBody, bundled_body
from warpgarment.bodies.skeleton import (
    PoseSequence,
    arms_abducted,
    blended_in,
    facing_forward,
    longest_run,
    mirrored,
    posed,
)
from warpgarment.geometry.skinning import linear_blend_skinning
from warpgarment.objects.garment import Garment
from warpgarment.training.bodies.limb_clearance import resolve_clearance
from warpgarment.training.data.encoding import stored_body, stored_transforms
from warpgarment.training.garments.make import make_garment
from warpgarment.training.garments.outfits import make_outfit
from warpgarment.training.garments.seams import cut_seams, parted
from warpgarment.training.motions.procedural import procedural
from warpgarment.training.teachers import Cloth

from .recipes import BLEND, FPS, GenerateConfig, Plan

ABDUCTION = 15.0  # angle by which the upper arms are lifted off the torso throughout [degrees]
GAP = 0.02  # gap between limbs and torso under one garment [m]
LAYER_GAP = 0.02  # additional gap for each further garment [m]
PARTED = 0.008  # distance between the two sides of a cut at the start [m]


class UnusableMotion(ValueError):
    """A motion in which limbs and torso stay too close for clothes, or that is torn."""


def rest_body(plan: Plan) -> RestBody:
    """The body of a plan in its rest pose."""
    if plan.body == "anny":
        return anny_bodies().rest(**plan.phenotype)
    if plan.body == "bundled":
        return bundled_body()
    from warpgarment.training.bodies.other import creature_body, mannequin_body

    return mannequin_body() if plan.body == "mannequin" else creature_body()


def body_motion(plan: Plan, config: GenerateConfig) -> tuple[RestBody, np.ndarray, np.ndarray]:
    """The body of a plan and its motion: window of a clip, limbs cleared, torn frames cut, blended in from rest.

    Returns:
        The rest body; bone transforms, float32 [T, B, 3, 4]; vertices [m], float32 [T, U, 3]. They have the values that
        will be read back from the stored sequence.

    Raises:
        UnusableMotion: Too few frames have space for clothes.
    """
    body = rest_body(plan)
    vertices, indices, weights = stored_body(body.vertices, body.bone_indices, body.bone_weights)
    body = replace(body, vertices=vertices.astype(np.float64), bone_indices=indices, bone_weights=weights)
    poses = _poses(plan, config, body)
    if plan.mirror:
        poses = mirrored(body, poses)
    gap = GAP + LAYER_GAP * (len(plan.outfit.layers) - 1)
    broken = jumps(body, poses)
    cleared = resolve_clearance(body, arms_abducted(body, poses, ABDUCTION), gap)
    poses = cleared.poses[longest_run(cleared.unresolved | broken)]
    least = min(config.least_frames, plan.frames)
    if len(poses) < least:
        raise UnusableMotion(
            f"no room for clothes: limbs and torso come closer than {gap * 1e3:.0f} mm in "
            f"{int(cleared.unresolved.sum())} of {len(broken)} frames of {plan.motion}, and the capture jumps in "
            f"{int(broken.sum())}; {len(poses)} in a row without are fewer than {least}."
        )
    _, transforms = posed(body, blended_in(body, facing_forward(poses), BLEND))
    transforms = stored_transforms(transforms)
    return body, transforms, linear_blend_skinning(body.vertices, body.bone_indices, body.bone_weights, transforms)


def _poses(plan: Plan, config: GenerateConfig, body: RestBody) -> PoseSequence:
    if plan.motion.startswith("procedural:"):
        return procedural(body, plan.motion.split(":")[1], plan.frames, seed=plan.number, fps=FPS)
    if config.motions is None:
        raise UnusableMotion(f"{plan.motion} is a clip, and no folder of clips was given")
    path = next(p for p in list_clips(Path(config.motions)) if p.stem == plan.motion)
    poses = retarget(read_clip(path), body, FPS)
    lead = 8 if len(poses) > plan.frames + 8 else min(2, len(poses) - 2)  # the first frames are often a T-pose
    start = lead + int(plan.start * max(0, len(poses) - lead - plan.frames))
    return poses[start : start + plan.frames]


def clothed(plan: Plan, body: RestBody, transforms: np.ndarray) -> tuple[tuple[Garment, ...], tuple[Cloth, ...]]:
    """The garments of a plan at rest, and at the start of the simulation, innermost first.

    The body at rest stands at the origin; the motion starts in the rest pose at another place, a rigid motion away.
    """
    if len(plan.outfit.layers) == 1:
        made: tuple[tuple[Garment, float], ...] = (make_garment(body, plan.outfit.layers[0], plan.outfit.gaps[0]),)
    else:
        made = make_outfit(body, plan.outfit)
    if plan.seams:
        made = tuple((cut_seams(garment, plan.seams), edge) for garment, edge in made)
    first = transforms[0, 0].astype(np.float64)
    cloths = []
    for (garment, edge), material in zip(made, plan.materials, strict=True):
        start = garment.vertices @ first[:, :3].T + first[:, 3]
        if plan.seams:
            start = parted(garment, start, PARTED)
        cloths.append(Cloth(garment, edge, start.astype(np.float32), material))
    return tuple(garment for garment, _ in made), tuple(cloths)
