"""Clips of bones (BVH, AMASS) as moving meshes: what `BodyMotion.load` makes of a file that has no surface."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError, UsageError
from warpgarment.io.data import UNITS, MotionData, ReadOptions

from .amass import amass_length, read_amass, read_recorded
from .bvh import bvh_length, read_bvh
from .clip import Clip
from .clips import metres_by_legs, retarget
from .rest import RestBody
from .shapes import Shape, shape_of
from .skeleton import posed
from .smpl import FAMILY, SmplModel

MOST = 1 << 28  # positions of a motion, 3 GB
FAR = 1.6  # ratio of two lengths of legs from which on the unit is probably another
_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def from_bvh(path: Path, options: ReadOptions) -> MotionData:
    """The body of `ReadOptions.shape`, moved by a BVH file.

    The lengths of BVH have no unit. Without one, they are scaled so that the clip's legs are as long as the body's,
    with a warning; with `ReadOptions.unit`, the body moves as far as the file says.
    """
    shape = shape_of(options.shape)
    body = shape.rest() if isinstance(shape, SmplModel) else shape
    if options.rest:
        return _at_rest(body, options)
    _check_size(path, bvh_length(path)[0], body)
    clip = read_bvh(path, options.up)
    try:
        fitted, legs = metres_by_legs(clip, body)
        metres = UNITS[options.unit] if options.unit else fitted
        poses = retarget(clip, body, clip.fps, metres)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None
    if not options.unit:
        warnings.warn(
            f"{path}: BVH has no unit. {metres:.3g} m a unit are taken, with which the clip's legs are as long as "
            f"those of the body ({legs:.2f} m); give it with unit=.",
            UserWarning,
            stacklevel=4,
        )
    elif max(fitted / metres, metres / fitted) > FAR:
        warnings.warn(
            f'{path}: with unit="{options.unit}" the legs would be {legs * metres / fitted:.2g} m long, and those of '
            f"the body are {legs:.2f} m. Is it in another unit?",
            UserWarning,
            stacklevel=4,
        )
    vertices, _ = posed(body, poses)
    return _in_file(vertices, body.faces, clip, options)._replace(metres=metres)


def from_amass(path: Path, options: ReadOptions) -> MotionData:
    """The body of `ReadOptions.shape`, moved by an AMASS file, which is in metres, Z up.

    A model of SMPL's family takes joint angles and translation as they are, and the shape where the file is of this
    model. On other bodies the steps are as long as their legs, and the feet on the floor.
    """
    if options.unit not in (None, "m"):
        raise UsageError(f"{path}: AMASS motions are in metres: leave out unit={options.unit}.")
    shape = shape_of(options.shape)
    _check_size(path, amass_length(path)[0], shape)
    if isinstance(shape, SmplModel):
        recorded = read_recorded(path)
        betas, there = recorded.betas, FAMILY.get(recorded.poses.shape[1], "another model")
        if recorded.poses.shape[1] != shape.joints and len(betas) and betas.any():
            warnings.warn(
                f"{path}: its coefficients of shape are of {there}, not of {FAMILY[shape.joints]}: the mean shape is "
                "taken.",
                UserWarning,
                stacklevel=4,
            )
            betas = np.zeros(0)
        if options.rest:
            return _at_rest(shape.rest(betas), options)
        turned = shape.posed(recorded, betas)
        vertices = turned if options.up == "y" else turned @ _Z_UP_TO_Y_UP.T.astype(np.float32)
        clip = Clip((), np.zeros(0), np.zeros(0), recorded.trans, recorded.fps, options.up or "z")
        return _in_file(vertices, shape.faces, clip, options)._replace(metres=1.0)
    if options.rest:
        return _at_rest(shape, options)
    clip = read_amass(path, options.up or "z")
    vertices, _ = posed(shape, retarget(clip, shape, clip.fps))
    return _in_file(vertices, shape.faces, clip, options)._replace(metres=1.0)


def _check_size(path: Path, frames: int, body: Shape) -> None:
    """Refuses motions that would fill the memory, before anything is allocated for them."""
    if frames * len(body.vertices) > MOST:
        raise MeshError(
            f"{path}: {frames:,} frames of {len(body.vertices):,} vertices are more than {MOST:,} positions. Cut the "
            "clip."
        )


def _at_rest(body: RestBody, options: ReadOptions) -> MotionData:
    """The body in the pose in which it was modelled; in the numbers of `options`, as all that a format returns."""
    still = Clip((), np.zeros(0), np.zeros(0), np.zeros((1, 3)), 30.0)
    return _in_file(body.vertices[None], body.faces, still, options)._replace(metres=1.0, fps=None)


def _in_file(vertices: np.ndarray, faces: np.ndarray, clip: Clip, options: ReadOptions) -> MotionData:
    """A motion, whose positions are given in metres, Y up, in the unit and the axes that the options name."""
    if options.up == "z":
        vertices = vertices @ _Z_UP_TO_Y_UP
    if options.unit:
        vertices = vertices / UNITS[options.unit]
    return MotionData(vertices, faces, clip.fps, up=clip.up)
