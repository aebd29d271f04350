"""What a glTF file says of looks: texture coordinates and materials of primitives, names of nodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from warpgarment.io.surface.mtl import placed as placed_picture
from warpgarment.io.surface.record import NONE, Coordinates, Labels, Material, Surface

from .container import Document
from .scene import Placed

SETS = 8  # sets of texture coordinates that are looked for


def surface_of(
    path: Path, document: Document, placed: Sequence[Placed], split: np.ndarray, faces: np.ndarray
) -> Surface:
    """The surface of some meshes.

    Args:
        path: The file.
        document: The document.
        placed: The meshes, one after another.
        split: Triangles among the vertices as the primitives have them, [F,3].
        faces: The same among the joined vertices, [F,3].

    Raises:
        ValueError, KeyError, ...: It is damaged.
    """
    parts = [part for one in placed for part in one.parts]
    sizes = [part.faces for part in parts]
    sets = []
    for number in range(SETS):
        found = _coordinates(document, [part.primitive for part in parts], [part.vertices for part in parts], number)
        if found is not None:
            values, has = found
            corners = split.reshape(-1)
            sets.append(Coordinates("", values, np.where(has[corners], corners, NONE)))
    used = [part.primitive.get("material") for part in parts]
    known = sorted({number for number in used if number is not None})
    materials = tuple(_material(path, document, number) for number in known)
    place = {number: k for k, number in enumerate(known)}
    label = [NONE if number is None else place[number] for number in used]
    names = {name: k for k, name in enumerate(dict.fromkeys(one.name for one in placed))}
    owner = np.repeat([names[one.name] for one in placed], [len(one.faces) for one in placed])
    return Surface(
        np.full(len(faces), 3),
        faces.reshape(-1),
        tuple(sets),
        materials,
        np.repeat(np.array(label, dtype=np.int64), sizes),
        Labels(tuple(names), owner),
    )


def _coordinates(
    document: Document, primitives: Sequence[dict[str, Any]], counts: Sequence[int], number: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """A set, upside down as glTF has it: pairs of all vertices [V,2], and which have one [V]; None: no primitive."""
    key, values, has = f"TEXCOORD_{number}", [], []
    for primitive, count in zip(primitives, counts, strict=True):
        there = key in primitive["attributes"]
        pairs = document.array(primitive["attributes"][key]) if there else np.zeros((count, 2))
        if pairs.shape != (count, 2):
            raise ValueError(f"{key} of shape {list(pairs.shape)} for {count:,} vertices")
        values.append(pairs.astype(np.float64))
        has.append(np.full(count, there))
    if not any(map(np.any, has)):
        return None
    together = np.concatenate(values)
    together[:, 1] = 1.0 - together[:, 1]
    return together.astype(np.float32), np.concatenate(has)


def _material(path: Path, document: Document, number: Any) -> Material:
    entry = document.item("materials", number)
    found = Material(str(entry.get("name", "")) or f"material {number}")
    look = entry.get("pbrMetallicRoughness", {})
    if "baseColorFactor" in look:
        r, g, b, opacity = map(float, look["baseColorFactor"])
        found = found._replace(color=(r, g, b), opacity=None if opacity == 1.0 else opacity)
    if "baseColorTexture" in look:
        texture = document.item("textures", look["baseColorTexture"]["index"])
        uri = document.item("images", texture["source"]).get("uri") if "source" in texture else None
        if uri is None or str(uri).startswith("data:"):
            return found._replace(embedded=True)
        found = found._replace(texture=placed_picture(path.parent, unquote(str(uri))))
    return found
