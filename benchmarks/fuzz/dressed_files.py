"""Sound files of meshes with polygons, texture coordinates, materials and groups, and what comes of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.io.polygons import triangulate_counts
from warpgarment.io.surface.record import Coordinates, Labels, Material, Surface
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion

from .mesh_files import Facts, _Gltf
from .shapes import moved, tube

OUTPUTS = (".obj", ".usda", ".glb", ".npz")
MATERIALS = """# a library
newmtl cotton
Kd 0.2 0.3 0.6
d 0.5
map_Kd -s 1 1 1 -clamp on cloth.png
newmtl lace 2
Kd 0.9 0.8 0.7
Tr 0.25
illum 2
"""


def _facts(surface: Surface | None, vertices: np.ndarray) -> Facts:
    """What a surface holds: its polygons as triangles, pairs of corners, labels and materials."""
    if surface is None:
        return {}
    facts: Facts = {"rest 0": vertices, "faces 0": surface.triangles(vertices, np.zeros((1, 3), np.int64))}
    facts["faces 0"] = surface.corners[facts["faces 0"]]
    for k, one in enumerate(surface.coordinates):
        facts |= {f"pairs {k}": one.values[one.corners[one.corners >= 0]], f"set {k}": one.name}
    for k, (name, color, opacity, texture, _) in enumerate(surface.materials):
        facts |= {f"color {k}": np.array(color or ()), f"opacity {k}": -1.0 if opacity is None else opacity}
        facts[f"material {k}"] = f"{name} {texture and Path(texture).name}"
    facts |= {"of polygons": surface.material, "objects": surface.objects.names, "groups": surface.groups.names}
    return facts


def garment(path: Path) -> Facts:
    """What `Garment.load` reads of it, with its seams joined, after it was written in all formats."""
    found = Garment.load(path, mesh=None if path.suffix in (".npz", ".ply", ".off") else "*", clean=True)
    for suffix in OUTPUTS:
        found.save(path.parent / "out" / f"again{suffix}")
    return {"vertices": found.vertices, "faces": found.faces, **_facts(found.surface, found.vertices)}


def stage(path: Path) -> Facts:
    """What `GarmentMotion.load` reads of it, after it was written in all formats."""
    found = GarmentMotion.load(path, fps=30.0)
    vertices = found.vertices if np.isfinite(found.vertices).all() else np.zeros_like(found.vertices)
    if np.isfinite(found.vertices).all():
        for suffix in ("", *OUTPUTS[1:]):
            found.resampled(24.0).save(path.parent / "out" / f"again{suffix}")
    facts = {"vertices": vertices, "faces": found.faces, "fps": found.fps}
    return facts | _facts(found.surface, vertices[0])


def _surface() -> tuple[np.ndarray, Surface]:
    """A tube of quads with a seam of texture coordinates, two materials, an object and groups."""
    vertices, faces = tube()
    quads = np.concatenate([faces[::2], faces[1::2, 2:]], axis=1)
    pairs = np.stack([np.arange(36) % 9 / 8, np.arange(36) // 9 / 4], 1)
    row, column = quads // 8, quads % 8
    column = np.where((column == 0) & (column.max(1, keepdims=True) == 7), 8, column)
    half = (np.arange(len(quads)) < 12).astype(int)
    return vertices, Surface(
        np.full(len(quads), 4),
        quads.reshape(-1),
        (Coordinates("st", pairs, (9 * row + column).reshape(-1)),),
        (Material("cotton", (0.2, 0.3, 0.6), 0.5, "cloth.png"), Material("lace 2", (0.9, 0.8, 0.7))),
        half,
        Labels(("dress",), 0 * half),
        Labels(("front", "back hem"), half),
    )


def _save(path: Path) -> Path:
    vertices, surface = _surface()
    faces = triangulate_counts(vertices, surface.counts, surface.corners)
    GarmentMotion(moved(vertices), faces, 30.0, (), "dress", surface=surface, start=10.0).save(path)
    return path


def write_obj(folder: Path) -> Path:
    """OBJ with a library of materials, by hand, and an empty picture."""
    vertices, surface = _surface()
    pairs, places = surface.coordinates[0].values, surface.coordinates[0].corners.reshape(-1, 4)
    lines = ["mtllib a.mtl", "o dress", *(f"v {x} {y} {z}" for x, y, z in vertices.tolist())]
    lines += [f"vt {u} {v}" for u, v in pairs.tolist()]
    for k, (corners, texture) in enumerate(zip(surface.corners.reshape(-1, 4), places, strict=True)):
        lines += [f"g {'back hem' if k % 3 else 'front'}", f"usemtl {'lace 2' if k % 2 else 'cotton'}"]
        lines.append("f " + " ".join(f"{v + 1}/{t - len(pairs)}" for v, t in zip(corners, texture, strict=True)))
    (folder / "a.obj").write_text("\n".join(lines) + "\n")
    (folder / "a.mtl").write_text(MATERIALS)
    (folder / "cloth.png").write_bytes(b"")
    return folder / "a.obj"


def write_folder(folder: Path) -> Path:
    """Frames as .obj, and materials.mtl, as they are written."""
    return _save(folder / "frames")


def write_npz(folder: Path) -> Path:
    """Arrays, as they are written."""
    return _save(folder / "a.npz")


def write_usda(folder: Path) -> Path:
    """A stage as text with primvars, materials and GeomSubsets, as it is written."""
    return _save(folder / "a.usda")


def write_glb(folder: Path) -> Path:
    """A morph target a frame, materials and pictures, as it is written."""
    return _save(folder / "a.glb")


def write_gltf(folder: Path) -> Path:
    """Two primitives with materials and two sets of texture coordinates, and a picture inside; by hand."""
    file, (vertices, faces) = _Gltf(), tube()
    shared = {"POSITION": file.add(vertices, "f"), "TEXCOORD_0": _pairs(file, vertices[:, :2])}
    parts: list[dict[str, Any]] = [
        {"attributes": shared, "indices": file.add(faces[:20].reshape(-1), "u"), "material": 1},
        {"attributes": shared | {"TEXCOORD_1": _pairs(file, vertices[:, 1:])},
         "indices": file.add(faces[20:].reshape(-1), "u"), "material": 0},
    ]  # fmt: skip
    looks = [
        {"name": "cotton", "pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.3, 0.6, 0.5]}},
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}},
        {"name": "inside", "pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}},
    ]
    document = file.document(
        nodes=[{"mesh": 0, "name": "dress"}], meshes=[{"primitives": parts}], materials=looks,
        textures=[{"source": 0}, {"source": 1}], images=[{"uri": "my%20cloth.png"}, {"uri": "data:image/png;base64,"}],
    )  # fmt: skip
    document["buffers"][0]["uri"] = "a.bin"
    (folder / "a.bin").write_bytes(file.data)
    (folder / "a.gltf").write_text(json.dumps(document, indent=1))
    return folder / "a.gltf"


def _pairs(file: _Gltf, pairs: np.ndarray) -> int:
    """An accessor of texture coordinates."""
    number = file.add(pairs.reshape(-1), "f")
    file.accessors[number] |= {"type": "VEC2", "count": len(pairs)}
    return number


def write_ply(folder: Path) -> Path:
    """PLY as text, a list of texture coordinates for each face."""
    vertices, surface = _surface()
    pairs, places = surface.coordinates[0].values, surface.coordinates[0].corners.reshape(-1, 4)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property float {a}" for a in "xyz")]
    lines += [f"element face {len(places)}", "property list uchar int vertex_indices"]
    lines += ["property list uchar float texcoord", "end_header", *(f"{x} {y} {z}" for x, y, z in vertices.tolist())]
    for corners, texture in zip(surface.corners.reshape(-1, 4), places, strict=True):
        numbers = " ".join(f"{n}" for n in pairs[texture].reshape(-1).tolist())
        lines.append(f"4 {' '.join(map(str, corners.tolist()))} 8 {numbers}")
    (folder / "a.ply").write_text("\n".join(lines) + "\n")
    return folder / "a.ply"
