"""Folders of OBJ files, one a frame, with the same faces."""

from __future__ import annotations

import re
import warnings
from math import gcd
from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.atomic import atomic_folder
from warpgarment.io.surface.mtl import mtl_text
from warpgarment.io.surface.obj import OBJ_KEEPS, has_materials, text_around
from warpgarment.io.surface.record import of_triangles, say_left_out

from .data import Format, MotionData, ReadOptions
from .obj import chosen_polygons, obj_text, read_polygons, surface_of
from .polygons import triangulate_counts

LIBRARY = "materials.mtl"
FRAME = ("frame_*.obj", LIBRARY)
LONGEST = 10_000  # frames that are missing in a row


def read_folder(path: Path, options: ReadOptions) -> MotionData:
    """The frames of a folder, at the numbers that their names end in.

    Hidden files are passed over. Numbers in even steps (every second frame) are frames so far apart; where single ones
    are missing, positions between are interpolated, with a warning.

    Raises:
        MeshError: No .obj files, one that cannot be read, numbers that occur twice or leave out far too many, or frames
            of different topology.
    """
    files = sorted(
        (file for file in path.iterdir() if file.suffix.lower() == ".obj" and not file.name.startswith(".")),
        key=lambda file: [int(n) if n.isdigit() else n for n in re.split(r"(\d+)", file.name)],
    )
    if not files:
        raise MeshError(f"{path}: no .obj files in this folder.")
    first = read_polygons(files[0])
    used, _, counts, corners = chosen_polygons(files[0], first, options.mesh)
    frames = [first.vertices[used]]
    for file in files[1:]:
        found = read_polygons(file, dressed=False)
        same = np.array_equal(found.counts, first.counts) and np.array_equal(found.corners, first.corners)
        if found.vertices.shape != first.vertices.shape or not same:
            raise MeshError(
                f"{file}: {len(found.vertices):,} vertices and {len(found.counts):,} faces, unlike {files[0].name} "
                f"with {len(first.vertices):,} and {len(first.counts):,}, or in another order. All frames must share "
                "one topology."
            )
        frames.append(found.vertices[used])
    try:
        faces = triangulate_counts(frames[0], counts, corners)
    except MeshError as error:
        raise MeshError(f"{files[0]}: {error}") from None
    numbers = _numbers(files)
    surface = surface_of(files[0], first, options.mesh, used)
    step, vertices = _spread(path, numbers, np.stack(frames))
    with np.errstate(over="ignore"):
        return MotionData(vertices.astype(np.float32), faces, step=step, start=numbers[0] / step, surface=surface)


def _numbers(files: list[Path]) -> list[int]:
    """Frame numbers: the last number in each name, where every name has one, otherwise the places in the list."""
    found = [re.findall(r"\d+", file.stem) for file in files]
    if not all(found):
        return list(range(len(files)))
    numbers = [int(words[-1][:15]) for words in found]
    return numbers if (np.diff(numbers) > 0).all() else list(range(len(files)))


def _spread(path: Path, numbers: list[int], frames: np.ndarray) -> tuple[int, np.ndarray]:
    """Numbers from one frame to the next, and frames [T,V,3] without gaps."""
    gaps = np.diff(numbers)
    if len(gaps) == 0:
        return 1, frames
    step = gcd(*gaps.tolist())
    if gaps.max() == step:
        if step > 1:
            warnings.warn(
                f"{path}: the numbers of the frames go from {numbers[0]} to {numbers[-1]} in steps of {step}: they are "
                f"{step} frames of the rate apart.",
                UserWarning,
                stacklevel=6,
            )
        return step, frames
    if gaps.max() > LONGEST * step:
        raise MeshError(f"{path}: no frames between the numbers {numbers[gaps.argmax()]} and "
                        f"{numbers[gaps.argmax() + 1]}: is it one sequence?")  # fmt: skip
    wanted = np.arange(numbers[0], numbers[-1] + 1, step)
    warnings.warn(
        f"{path}: {len(wanted) - len(numbers):,} of {len(wanted):,} frames are missing (first: number "
        f"{sorted(set(wanted.tolist()) - set(numbers))[0]}). The gaps are filled in a straight line.",
        UserWarning,
        stacklevel=6,
    )
    before = np.clip(np.searchsorted(numbers, wanted, side="right") - 1, 0, len(numbers) - 2)
    at = np.array(numbers)
    share = ((wanted - at[before]) / (at[before + 1] - at[before]))[:, None, None]
    return step, frames[before] * (1 - share) + frames[before + 1] * share


def write_folder(path: Path, data: MotionData) -> None:
    """Writes frame_0000.obj, frame_0001.obj, ..., and materials.mtl where there are materials.

    A folder that holds nothing else is replaced.
    """
    say_left_out(path, data.surface, sets=1, keeps=OBJ_KEEPS)
    digits = max(4, len(str(len(data.vertices) - 1)))
    library = LIBRARY if has_materials(data.surface) else ""
    around = text_around(data.surface or of_triangles(data.faces), data.name, library)
    with atomic_folder(path, FRAME) as folder:
        if library and data.surface is not None:
            (folder / library).write_text(mtl_text(data.surface, path), encoding="utf-8")
        for frame, positions in enumerate(data.vertices):
            (folder / f"frame_{frame:0{digits}d}.obj").write_text(
                obj_text(positions, data.faces, data.name, around), encoding="utf-8"
            )


FORMAT = Format(read_motion=read_folder, write_motion=write_folder, named=True)
