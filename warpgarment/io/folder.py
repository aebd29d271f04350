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
from warpgarment.progress import parts

from .data import Format, Holds, MotionData, ReadOptions
from .obj import chosen_polygons, obj_holds, obj_text, read_polygons, surface_of
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
    for file in parts(files[1:], "reading"):
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
    told = _numbers(files)
    numbers = told if told is not None else list(range(len(files)))
    surface = surface_of(files[0], first, options.mesh, used)
    step, vertices = _spread(path, numbers, np.stack(frames))
    with np.errstate(over="ignore"):
        start = numbers[0] / step if told is not None else None
        return MotionData(vertices.astype(np.float32), faces, step=step, start=start, surface=surface)


def _numbers(files: list[Path]) -> list[int] | None:
    """Frame numbers: the last number in each name; None where a name has none, or they do not rise."""
    found = [re.findall(r"\d+", file.stem) for file in files]
    if not all(found):
        return None
    numbers = [int(words[-1][:15]) for words in found]
    return numbers if (np.diff(numbers) > 0).all() else None


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
    """Writes frame_1001.obj, frame_1002.obj, ... from the number of the first frame on, and materials.mtl.

    The latter only where there are materials. A folder that holds nothing else is replaced.

    Warns:
        UserWarning: The first frame lies between two numbers, or before 0; or OBJ cannot hold all of the surface.
    """
    begins = data.start or 0.0
    first = max(round(begins), 0)
    if abs(begins - first) > 1e-3:
        warnings.warn(
            f"{path}: the motion starts at frame {begins:g} of {data.fps or 0:g} a second; files have whole numbers "
            f"from 0 on, so the first one is {first}.",
            UserWarning,
            stacklevel=4,
        )
    say_left_out(path, data.surface, sets=1, keeps=OBJ_KEEPS)
    digits = max(4, len(str(first + len(data.vertices) - 1)))
    library = LIBRARY if has_materials(data.surface) else ""
    around = text_around(data.surface or of_triangles(data.faces), data.name, library)
    with atomic_folder(path, FRAME) as folder:
        if library and data.surface is not None:
            (folder / library).write_text(mtl_text(data.surface, path), encoding="utf-8")
        for frame, positions in enumerate(parts(data.vertices, "writing"), first):
            text = obj_text(positions, data.faces, data.name, around)
            (folder / f"frame_{frame:0{digits}d}.obj").write_text(text, encoding="utf-8")


def _holds(path: Path) -> Holds:
    first = next((file for file in sorted(path.glob("[!.]*")) if file.suffix.lower() == ".obj"), None)
    return obj_holds(first) if first else Holds()


FORMAT = Format(read_motion=read_folder, write_motion=write_folder, named=True, holds=_holds)
