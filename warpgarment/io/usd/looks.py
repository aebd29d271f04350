"""What a USD mesh says of looks: primvars of texture coordinates, bound materials, GeomSubsets."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.io.surface.mtl import placed
from warpgarment.io.surface.record import NONE, Coordinates, Labels, Material, Surface

TEXTURE = re.compile(r"(st|uv|map|tex)", re.IGNORECASE)  # how names of texture coordinates begin that are plain pairs
PAIRS = ("float2[]", "double2[]", "half2[]")
OBJECTS = "objects"  # family of the GeomSubsets that are objects of the input
DEEPEST = 8  # nodes between a material and its picture


def surface_of(prim: Any, counts: np.ndarray, corners: np.ndarray, points: int, time: Any) -> Surface:
    """The surface of a mesh, its polygons as the file winds them.

    Args:
        prim: The mesh.
        counts: Corners of each polygon [P].
        corners: Points of the corners [C].
        points: How many points there are.
        time: The time code at which the mesh is read.

    Raises:
        MeshError, ValueError: Indices that do not fit.
    """
    materials, material = _materials(prim, len(counts), time)
    subsets = [s for s in _subsets(prim) if s.GetFamilyNameAttr().Get(time) != "materialBind"]
    objects = [s for s in subsets if s.GetFamilyNameAttr().Get(time) == OBJECTS]
    groups = [s for s in subsets if s.GetFamilyNameAttr().Get(time) != OBJECTS]
    return Surface(
        counts,
        corners,
        _coordinates(prim, counts, corners, points, time),
        materials,
        material,
        _labels(objects, len(counts), time, " "),
        _labels(groups, len(counts), time, "_"),
    )


def _coordinates(prim: Any, counts: np.ndarray, corners: np.ndarray, points: int, time: Any) -> tuple[Coordinates, ...]:
    """Texture coordinates of the corners; `st` comes first, as materials read it where nothing else is said."""
    from pxr import UsdGeom

    found = []
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvars():
        name, kind = str(primvar.GetPrimvarName()), str(primvar.GetTypeName())
        if not (kind.startswith("texCoord2") or (kind in PAIRS and TEXTURE.match(name))) or not primvar.HasValue():
            continue
        values = np.array(primvar.Get(time), dtype=np.float32)
        if values.ndim != 2 or values.shape[1] != 2 or not len(values):
            continue  # blocked, or an array of another type in spite of what it says
        owner = {
            UsdGeom.Tokens.constant: np.zeros(len(corners), dtype=np.int64),
            UsdGeom.Tokens.uniform: np.repeat(np.arange(len(counts)), counts),
            UsdGeom.Tokens.vertex: corners,
            UsdGeom.Tokens.varying: corners,
            UsdGeom.Tokens.faceVarying: np.arange(len(corners)),
        }[primvar.GetInterpolation()]
        if primvar.IsIndexed():
            indices = np.array(primvar.GetIndices(time), dtype=np.int64).reshape(-1)
            if len(owner) and owner.max() >= len(indices):
                raise ValueError(f"{name} has {len(indices):,} indices, {int(owner.max()) + 1:,} are needed")
            owner = indices[owner]
        found.append(Coordinates(name, values, owner))
    return tuple(sorted(found, key=lambda one: one.name != "st"))


def _materials(prim: Any, polygons: int, time: Any) -> tuple[tuple[Material, ...], np.ndarray]:
    """Materials that are bound to a mesh or to subsets of it, and the material of each polygon [P]."""
    from pxr import UsdShade

    places: dict[str, int] = {}
    materials: list[Material] = []

    def number(of: Any) -> int:
        binding = UsdShade.MaterialBindingAPI(of)
        purposes = (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview)
        bound = next((found for p in purposes if (found := binding.ComputeBoundMaterial(p)[0])), None)
        if bound is None:
            return NONE
        path = str(bound.GetPath())
        if path not in places:
            places[path] = len(materials)
            materials.append(_material(bound, time))
        return places[path]

    label = np.full(polygons, number(prim), dtype=np.int64)
    for subset in _subsets(prim):
        if subset.GetFamilyNameAttr().Get(time) == "materialBind":
            label[_indices(subset, polygons, time)] = number(subset.GetPrim())
    return tuple(materials), label


def _material(bound: Any, time: Any) -> Material:
    prim = bound.GetPrim()
    found = Material(_shown_name(prim))
    shader = bound.ComputeSurfaceSource()[0]
    if not shader or shader.GetIdAttr().Get(time) != "UsdPreviewSurface":
        return found
    color, picture = _input(shader, "diffuseColor", time)
    opacity = _input(shader, "opacity", time)[0]
    if np.shape(color) == (3,):
        r, g, b = map(float, np.asarray(color))
        found = found._replace(color=(r, g, b))
    if isinstance(opacity, float) and opacity != 1.0:
        found = found._replace(opacity=opacity)
    if picture is None:
        return found
    inside = picture.startswith("/") and "[" in picture  # file.usdz[picture.png]
    return found._replace(embedded=True) if inside else found._replace(texture=picture)


def _input(shader: Any, name: str, time: Any) -> tuple[Any, str | None]:
    """Value of a shader's input, and the file of a picture it is connected to."""
    source = shader.GetInput(name)
    for _ in range(DEEPEST):
        if not source:
            break
        connected = source.GetConnectedSources()[0]
        if not connected:
            return source.Get(time), None
        node, output = connected[0].source, connected[0].sourceName
        file = node.GetInput("file")
        if file:
            asset = file.Get(time)
            said = str(getattr(asset, "path", "") or "")
            where = str(getattr(asset, "resolvedPath", "") or "")
            layer = next((spec.layer.realPath for spec in file.GetAttr().GetPropertyStack(time)), "")
            return None, where or (placed(Path(layer).parent, said) if said else None)
        source = node.GetInput(output)  # a material's own input, by the same name
    return None, None


def _subsets(prim: Any) -> list[Any]:
    from pxr import Usd, UsdGeom

    children = prim.GetFilteredChildren(Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
    found = [UsdGeom.Subset(child) for child in children if child.IsA(UsdGeom.Subset)]
    return [subset for subset in found if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face]


def _indices(subset: Any, polygons: int, time: Any) -> np.ndarray:
    value = subset.GetIndicesAttr().Get(time)
    indices = np.array([] if value is None else value, dtype=np.int64).reshape(-1)
    if len(indices) and (indices.min() < 0 or indices.max() >= polygons):
        raise ValueError(f"subset {subset.GetPrim().GetName()} names faces beyond the {polygons:,}")
    return np.unique(indices)


def _labels(subsets: list[Any], polygons: int, time: Any, space: str) -> Labels:
    """Labels of the polygons: the names of the subsets that they are in, with spaces between; `space` within one."""
    of_polygon: dict[int, list[str]] = {}
    for subset in subsets:
        name = _shown_name(subset.GetPrim()).replace(" ", space)
        for polygon in _indices(subset, polygons, time).tolist():
            of_polygon.setdefault(polygon, []).append(name)
    labels: dict[str, int] = {}
    found = np.full(polygons, NONE)
    for polygon, names in of_polygon.items():
        found[polygon] = labels.setdefault(" ".join(names), len(labels))
    return Labels(tuple(labels), found)


def _shown_name(prim: Any) -> str:
    """The name under which people know a prim: its display name, such as a name that no prim may have."""
    shown = prim.GetMetadata("displayName")
    return str(shown or prim.GetName())
