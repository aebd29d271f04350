"""The result as a mesh cache: a PC2 file, and the modifier that shows it in place of the garment's own vertices."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from .scene import DEFORMS

NAME = "warpgarment"
SWITCHED = "warpgarment_switched_off"  # property of the garment: modifiers that the cache stands for


def write(path: Path, vertices: np.ndarray, first_frame: int) -> None:
    """Writes positions [T,V,3] in the garment's own coordinates, completely or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, vertices.shape[1], float(first_frame), 1.0, len(vertices))
    unfinished = path.with_name(f"{path.name}.part")
    try:
        with open(unfinished, "wb") as file:
            file.write(head)
            file.write(np.ascontiguousarray(vertices, "<f4").tobytes())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def attach(garment: Any, path: Path, first_frame: int) -> None:
    """Shows a cache: as the garment's first modifier, in place of those that moved it."""
    detach(garment)
    switched = []
    for modifier in garment.modifiers:
        if modifier.type not in DEFORMS:
            break
        if modifier.show_viewport or modifier.show_render:
            switched.append(f"{modifier.name}\t{int(modifier.show_viewport)}{int(modifier.show_render)}")
            modifier.show_viewport = modifier.show_render = False
    garment[SWITCHED] = "\n".join(switched)
    modifier = garment.modifiers.new(NAME, "MESH_CACHE")
    modifier.cache_format, modifier.filepath = "PC2", str(path)
    modifier.frame_start, modifier.interpolation, modifier.deform_mode = float(first_frame), "LINEAR", "OVERWRITE"
    garment.modifiers.move(len(garment.modifiers) - 1, 0)
    garment.update_tag()


def detach(garment: Any) -> None:
    """Takes the cache away, and switches on again what it stood for."""
    old = garment.modifiers.get(NAME)
    if old is not None:
        garment.modifiers.remove(old)
    for line in str(garment.get(SWITCHED, "")).splitlines():
        name, _, shown = line.rpartition("\t")
        modifier = garment.modifiers.get(name)
        if modifier is not None:
            modifier.show_viewport, modifier.show_render = shown[0] == "1", shown[1] == "1"
    if SWITCHED in garment:
        del garment[SWITCHED]


def place_of(path: str, garment: Any) -> Path:
    """The file of a cache: as it is set, or beside the .blend, or among Blender's temporary files."""
    if path:
        return Path(bpy.path.abspath(path)).with_suffix(".pc2")
    folder = Path(bpy.data.filepath).parent if bpy.data.filepath else Path(bpy.app.tempdir)
    return folder / f"warpgarment_{bpy.path.clean_name(garment.name)}.pc2"
