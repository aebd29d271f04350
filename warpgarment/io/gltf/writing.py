"""Writes a moving mesh as glTF 2.0: triangles, a morph target a frame, an animation that shows one after another.

glTF has neither polygons nor, in its core, animated positions. Each frame after the first is a morph target, the
difference of its positions to those of the first; key k of the animation gives target k the weight 1 and others 0, so
that positions between two frames lie on a line. A vertex with several texture coordinates is repeated for each of them,
and there is a primitive for each material.
"""

from __future__ import annotations

import base64
import json
import struct
import warnings
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from warpgarment.errors import MeshError, OutputError
from warpgarment.io.data import MotionData
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.surface.mtl import named_from
from warpgarment.io.surface.record import NONE, Material, Surface, members, of_triangles
from warpgarment.progress import parts

FLOAT, INDEX = 5126, 5125
LARGEST = 2**32 - 1  # bytes of a .glb


class _Buffer:
    """The binary part in the making: pieces, and the accessors that name them."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, *, bounds: bool = False, target: int | None = None) -> int:
        """The accessor of an array of floats [N], [N,2] or [N,3], or of indices [N]."""
        floats = array.dtype.kind == "f"
        data = np.ascontiguousarray(array, dtype="<f4" if floats else "<u4")
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": data.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        entry = {
            "bufferView": len(self.views) - 1,
            "componentType": FLOAT if floats else INDEX,
            "count": len(data),
            "type": "SCALAR" if data.ndim == 1 else f"VEC{data.shape[1]}",
        }
        if bounds:
            low, high = data.min(axis=0, keepdims=data.ndim == 1), data.max(axis=0, keepdims=data.ndim == 1)
            entry |= {"min": low.tolist(), "max": high.tolist()}
        self.accessors.append(entry)
        self.pieces.append(data.tobytes())
        self.size += data.nbytes
        return len(self.accessors) - 1


def write_gltf(path: Path, data: MotionData) -> None:
    """Writes a motion as .glb, or as .gltf with the buffer inside, completely or not at all.

    Args:
        path: The file.
        data: Positions in metres, Y up. Frames that are not finite repeat the one before them, with a warning.

    Raises:
        MeshError: The first frame is not finite.
        OutputError: More than 4 GB, which .glb cannot hold; or the disk.
    """
    vertices = _finite(path, np.asarray(data.vertices, dtype=np.float32))
    surface = data.surface or of_triangles(data.faces)
    buffer = _Buffer()
    primitives = _primitives(buffer, vertices, np.asarray(data.faces), surface)
    if buffer.size + 4 * len(vertices) ** 2 > LARGEST - (1 << 24):
        raise OutputError(f"{path}: {len(vertices):,} frames are more than the 4 GB of a .glb. Write .usd or .pc2.")
    name = surface.objects.names[surface.objects.used[0]] if surface.objects.whole else data.name or "mesh"
    mesh: dict[str, Any] = {"name": name, "primitives": primitives}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "warpgarment"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": data.name or name, "mesh": 0}],
        "meshes": [mesh],
    }
    if len(vertices) > 1:
        mesh["extras"] = {"targetNames": [f"frame_{k:04d}" for k in range(1, len(vertices))]}
        fps = 30.0 if data.fps is None else data.fps
        seconds = data.seconds if data.seconds is not None else (data.start or 0.0) / fps
        document["animations"] = [_animation(path, buffer, len(vertices), fps, seconds)]
    document |= _materials(surface, path.parent)
    document |= {
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": buffer.size}],
    }
    with atomic_file(path) as temporary:
        _write(temporary, document, buffer, binary=path.suffix.lower() == ".glb")


def _finite(path: Path, vertices: np.ndarray) -> np.ndarray:
    """Positions without NaN: frames that hold some are those before them."""
    whole = np.isfinite(vertices).all(axis=(1, 2))
    if whole.all():
        return vertices
    if not whole[0]:
        raise MeshError(f"{path}: the first frame holds positions that are not finite, which glTF cannot hold.")
    warnings.warn(
        f"{path}: {np.count_nonzero(~whole):,} of {len(whole):,} frames are not finite (first: frame "
        f"{int(np.argmin(whole))}), which glTF cannot hold. They repeat the frame before them.",
        UserWarning,
        stacklevel=5,
    )
    return vertices[np.maximum.accumulate(np.where(whole, np.arange(len(whole)), 0))]


def _primitives(buffer: _Buffer, vertices: np.ndarray, faces: np.ndarray, surface: Surface) -> list[dict[str, Any]]:
    """A primitive for each material, with a morph target for each frame after the first."""
    corners = surface.triangles(vertices[0], faces)
    material = surface.material[surface.polygon_of_corner[corners[:, 0]]]
    found = []
    for number, some in members(material).items():
        chosen = corners[some].reshape(-1)
        columns = [surface.corners[chosen], *(one.corners[chosen] for one in surface.coordinates)]
        rows, index = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)
        positions = vertices[:, rows[:, 0]]
        attributes = {"POSITION": buffer.add(positions[0], bounds=True, target=34962)}
        for k, one in enumerate(surface.coordinates):
            pairs = np.where(rows[:, k + 1, None] == NONE, 0.0, one.values[rows[:, k + 1]])
            flipped = np.stack([pairs[:, 0], 1.0 - pairs[:, 1].astype(np.float64)], axis=1)
            attributes[f"TEXCOORD_{k}"] = buffer.add(flipped, target=34962)
        primitive: dict[str, Any] = {
            "attributes": attributes,
            "indices": buffer.add(index.reshape(-1).astype(np.uint32), target=34963),
        }
        if number != NONE:
            primitive["material"] = number
        if len(vertices) > 1:
            moves = (frame - positions[0] for frame in parts(positions[1:], "writing"))
            primitive["targets"] = [{"POSITION": buffer.add(move, bounds=True, target=34962)} for move in moves]
        found.append(primitive)
    return found


def _animation(path: Path, buffer: _Buffer, frames: int, fps: float, start: float) -> dict[str, Any]:
    """Weights of the morph targets, from the time of the first frame [s] on: at each frame that of its own is 1."""
    if start < 0:
        warnings.warn(
            f"{path}: the motion starts at {start:g} s; times of glTF are 0 or later, so it starts at 0.",
            UserWarning,
            stacklevel=6,
        )
    times = max(start, 0.0) + np.arange(frames) / fps
    weights = np.eye(frames, dtype=np.float32)[:, 1:].reshape(-1)
    sampler = {"input": buffer.add(times, bounds=True), "output": buffer.add(weights), "interpolation": "LINEAR"}
    return {
        "name": "motion",
        "samplers": [sampler],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
    }


def _materials(surface: Surface, folder: Path) -> dict[str, Any]:
    """Materials with their pictures; nothing where there are none."""
    if not surface.materials:
        return {}
    named = dict.fromkeys(material.texture for material in surface.materials if material.texture)
    pictures = {name: k for k, name in enumerate(named) if name}
    found: dict[str, Any] = {"materials": [_material(material, pictures) for material in surface.materials]}
    if pictures:
        found["images"] = [{"uri": quote(named_from(folder, picture), safe="/:")} for picture in pictures]
        found["textures"] = [{"source": k} for k in range(len(pictures))]
    return found


def _material(material: Material, pictures: dict[str, int]) -> dict[str, Any]:
    look: dict[str, Any] = {"metallicFactor": 0.0}
    if material.color is not None or material.opacity is not None:
        color = [*(material.color or (1.0, 1.0, 1.0)), 1.0 if material.opacity is None else material.opacity]
        look["baseColorFactor"] = np.nan_to_num(np.clip(color, 0.0, 1.0)).tolist()
    if material.texture:
        look["baseColorTexture"] = {"index": pictures[material.texture]}
    found = {"name": material.name, "pbrMetallicRoughness": look, "doubleSided": True}
    return found | ({"alphaMode": "BLEND"} if material.opacity is not None and material.opacity < 1.0 else {})


def _write(path: Path, document: dict[str, Any], buffer: _Buffer, *, binary: bool) -> None:
    if not binary:
        content = base64.b64encode(b"".join(buffer.pieces)).decode()
        document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{content}"
        path.write_text(json.dumps(document, allow_nan=False), encoding="utf-8")
        return
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    with open(path, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + buffer.size))
        file.write(struct.pack("<II", len(text), 0x4E4F534A) + text)
        file.write(struct.pack("<II", buffer.size, 0x004E4942))
        file.writelines(buffer.pieces)
