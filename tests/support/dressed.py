"""A skirt of quads with texture coordinates, materials and groups, and readers of files that share no code with ours.

A file is read as a list of polygons, each a list of corners, each of which is a position and a pair of texture
coordinates, with the name of the polygon's material.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

AROUND, RINGS = 12, 5
COLORS = {"denim": (0.2, 0.3, 0.6), "lace 2": (0.9, 0.8, 0.7)}


class Polygon(NamedTuple):
    """Vertices, texture coordinates (indices of `UV`), and names."""

    vertices: list[int]
    coordinates: list[int]
    material: str
    group: str


def _polygons() -> list[Polygon]:
    def corner(row: int, column: int) -> tuple[int, int]:
        return row * AROUND + column % AROUND, row * (AROUND + 1) + column

    found = []
    for row in range(RINGS - 1):
        for i in range(AROUND):
            ring = [corner(row, i), corner(row, i + 1), corner(row + 1, i + 1), corner(row + 1, i)]
            if (row, i) == (1, 3):  # a pentagon: this quad and half of the next
                ring = [*ring[:2], corner(row, i + 2), *ring[2:]]
            if (row, i) == (1, 4):  # a triangle: the other half
                ring = ring[1:]
            names = "denim" if row < 2 else "lace 2", "front" if i < 6 else "back hem"
            found.append(Polygon([v for v, _ in ring], [t for _, t in ring], *names))
    return found


_angle = np.arange(AROUND) * 2 * np.pi / AROUND
_ring = np.stack([np.sin(_angle), np.zeros(AROUND), np.cos(_angle)], 1) * 0.35
VERTICES = np.concatenate([_ring + [0, y, 0] for y in np.linspace(0.5, 0.95, RINGS)]).astype(np.float32)
UV = np.array([[i / AROUND, 0.9 * r / (RINGS - 1)] for r in range(RINGS) for i in range(AROUND + 1)], np.float32)
POLYGONS = _polygons()
COUNTS = np.array([len(p.vertices) for p in POLYGONS])
CORNERS = np.concatenate([p.vertices for p in POLYGONS])
COORDINATES = np.concatenate([p.coordinates for p in POLYGONS])


def write_obj(path: Path, library: bool = True) -> Path:
    """The skirt as .obj, with a .mtl beside it."""
    lines = ["mtllib skirt.mtl", "o skirt"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in VERTICES.tolist()]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in UV.tolist()]
    for p in POLYGONS:
        lines += [f"g {p.group}", f"usemtl {p.material}"]
        lines.append("f " + " ".join(f"{v + 1}/{t + 1}" for v, t in zip(p.vertices, p.coordinates, strict=True)))
    path.write_text("\n".join(lines))
    if library:
        rows = [f"newmtl {name}\nKd {r} {g} {b}\nd 1.0\nillum 2" for name, (r, g, b) in COLORS.items()]
        (path.parent / "skirt.mtl").write_text("\n\n".join(rows))
    return path


DOUBLED = np.arange(RINGS) * AROUND  # vertices of the column that is there twice in panels


def write_panels(path: Path) -> Path:
    """The skirt as a panel sewn to itself.

    Vertices `DOUBLED` are there twice, and polygons behind the seam name the twins.
    """
    text = write_obj(path).read_text().splitlines()
    first = next(k for k, row in enumerate(text) if row.startswith("vt "))
    text[first:first] = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in VERTICES[DOUBLED].tolist()]
    faces = iter(panel_corners())
    text = [
        "f " + " ".join(f"{v + 1}/{t + 1}" for v, t in next(faces)) if row.startswith("f ") else row for row in text
    ]
    path.write_text("\n".join(text))
    return path


def panel_corners() -> list[list[tuple[int, int]]]:
    """Vertices and texture coordinates of the corners of `write_panels`."""
    twin = {v: len(VERTICES) + k for k, v in enumerate(DOUBLED.tolist())}
    return [
        [(twin[v] if t % (AROUND + 1) == AROUND else v, t) for v, t in zip(p.vertices, p.coordinates, strict=True)]
        for p in POLYGONS
    ]


Corner = tuple[tuple[float, ...], tuple[float, ...]]
Read = list[tuple[list[Corner], str]]


def expected(vertices: np.ndarray) -> Read:
    """What a reader finds where nothing is lost."""
    return [
        ([(_row(vertices[v]), _row(UV[t])) for v, t in zip(p.vertices, p.coordinates, strict=True)], p.material)
        for p in POLYGONS
    ]


def _row(numbers: np.ndarray) -> tuple[float, ...]:
    return tuple(round(float(n), 6) + 0.0 for n in numbers)


def read_obj(path: Path) -> tuple[Read, dict[str, tuple[float, ...]], list[str]]:
    """Polygons of an OBJ file, colours of its materials, and the group or object above each polygon."""
    v, vt, found, colors, groups = [], [], [], {}, []
    material = group = ""
    for line in path.read_text().splitlines():
        key, _, rest = line.partition(" ")
        if key == "v":
            v.append(_row(np.array(rest.split(), float)))
        elif key == "vt":
            vt.append(_row(np.array(rest.split(), float)))
        elif key == "usemtl":
            material = rest
        elif key == "g":
            group = rest
        elif key == "mtllib":
            name = ""
            for row in (path.parent / rest).read_text().splitlines():
                if row.startswith("newmtl "):
                    name = row.partition(" ")[2]
                elif row.startswith("Kd "):
                    colors[name] = tuple(map(float, row.split()[1:]))
        elif key == "f":
            pairs = [word.split("/") for word in rest.split()]
            found.append(([(v[int(p[0]) - 1], vt[int(p[1]) - 1] if len(p) > 1 else ()) for p in pairs], material))
            groups.append(group)
    return found, colors, groups


def read_usd(path: Path, frame: float, coordinates: str = "st") -> tuple[Read, dict[str, tuple[float, ...]], list[str]]:
    """The same of the one mesh of a stage, by USD's own functions."""
    from pxr import Usd, UsdGeom, UsdShade

    stage = Usd.Stage.Open(str(path))
    mesh = next(UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    points, counts = np.array(mesh.GetPointsAttr().Get(frame)), np.array(mesh.GetFaceVertexCountsAttr().Get())
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(coordinates)
    assert primvar.GetInterpolation() == "faceVarying"
    pairs = np.array(primvar.ComputeFlattened())
    materials, groups = [""] * len(counts), [""] * len(counts)
    bound = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
    colors: dict[str, tuple[float, ...]] = {}
    if bound:
        materials = [_named(bound, colors)] * len(counts)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        for face in subset.GetIndicesAttr().Get():
            if subset.GetFamilyNameAttr().Get() == "materialBind":
                bound = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]
                materials[face] = _named(bound, colors)
            elif subset.GetFamilyNameAttr().Get() == "groups":
                groups[face] = f"{groups[face]} {subset.GetPrim().GetName()}".strip()
    found, at = [], 0
    for count, material in zip(counts, materials, strict=True):
        rows = range(at, at + count)
        found.append(([(_row(points[corners[k]]), _row(pairs[k])) for k in rows], material))
        at += count
    return found, colors, groups


def _named(bound, colors: dict[str, tuple[float, ...]]) -> str:
    name = bound.GetPrim().GetMetadata("displayName") or bound.GetPrim().GetName()
    source = bound.ComputeSurfaceSource()[0]
    if source and source.GetInput("diffuseColor").Get() is not None:
        colors[name] = _row(source.GetInput("diffuseColor").Get())
    return name


def read_gltf(path: Path, time: float = 0.0) -> tuple[Read, dict[str, tuple[float, ...]]]:
    """Triangles of all primitives of the first mesh at a time, by the glTF specification; colours of materials."""
    data = path.read_bytes()
    if path.suffix == ".glb":
        magic, version, length, size, kind = struct.unpack_from("<4sIIII", data)
        assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
        document, rest = json.loads(data[20 : 20 + size]), data[20 + size :]
        assert struct.unpack_from("<I", rest, 4)[0] == 0x004E4942
        binary = rest[8:]
    else:
        document = json.loads(data)
        binary = base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])
    assert len(binary) == document["buffers"][0]["byteLength"]

    def array(index: int) -> np.ndarray:
        entry = document["accessors"][index]
        view = document["bufferViews"][entry["bufferView"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[entry["type"]]
        dtype = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[entry["componentType"]]
        start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
        values = np.frombuffer(binary, dtype, entry["count"] * width, start).reshape(-1, width)
        for key, bound in (("min", values.min(0)), ("max", values.max(0))):
            np.testing.assert_array_equal(entry.get(key, bound), bound)
        return values.astype(float)

    mesh = document["meshes"][0]
    weights = np.zeros(len(mesh["primitives"][0].get("targets", [])))
    for animation in document.get("animations", []):
        sampler = animation["samplers"][animation["channels"][0]["sampler"]]
        times = array(sampler["input"])[:, 0]
        values = array(sampler["output"]).reshape(len(times), -1)
        weights = np.array([np.interp(time, times, column) for column in values.T])
    found, colors = [], {}
    for material in document.get("materials", []):
        factor = material["pbrMetallicRoughness"].get("baseColorFactor")
        if factor is not None:
            colors[material["name"]] = _row(np.array(factor[:3]))
    for primitive in mesh["primitives"]:
        points = array(primitive["attributes"]["POSITION"])
        assert {document["accessors"][t["POSITION"]]["count"] for t in primitive.get("targets", [])} <= {len(points)}
        for weight, target in zip(weights, primitive.get("targets", []), strict=True):
            points = points + weight * array(target["POSITION"])
        pairs = array(primitive["attributes"]["TEXCOORD_0"]) * [1, -1] + [0, 1]  # glTF has them upside down
        name = document["materials"][primitive["material"]]["name"] if "material" in primitive else ""
        for face in array(primitive["indices"]).astype(int).reshape(-1, 3):
            found.append(([(_row(points[k]), _row(pairs[k])) for k in face], name))
    return found, colors


def triangles(faces: np.ndarray, vertices: np.ndarray) -> Read:
    """What a reader of triangles finds: `faces` [F,3] are those that were made of the polygons, in their order."""
    found, at = [], 0
    for p in POLYGONS:
        pair = dict(zip(p.vertices, p.coordinates, strict=True))
        for face in faces[at : at + len(p.vertices) - 2].tolist():
            found.append(([(_row(vertices[v]), _row(UV[pair[v]])) for v in face], p.material))
        at += len(p.vertices) - 2
    assert at == len(faces)
    return found


def close(found: Read, wanted: Read, atol: float = 2e-6) -> bool:
    """Whether two lists hold the same polygons in the same order, numbers to within `atol`."""
    return [(len(c), m) for c, m in found] == [(len(c), m) for c, m in wanted] and np.allclose(
        [n for c, _ in found for corner in c for part in corner for n in part],
        [n for c, _ in wanted for corner in c for part in corner for n in part],
        rtol=0,
        atol=atol,
    )


def ordered(polygons: Read) -> Read:
    """Polygons in an order that does not depend on the file's: each from its least corner on."""

    def key(corner: Corner) -> list[float]:
        return [round(n, 4) for part in corner for n in part]

    turned = []
    for corners, material in polygons:
        first = min(range(len(corners)), key=lambda k: key(corners[k]))
        turned.append((corners[first:] + corners[:first], material))
    return sorted(turned, key=lambda polygon: list(map(key, polygon[0])))
