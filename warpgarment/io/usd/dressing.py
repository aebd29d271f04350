"""Writes what is known of a mesh's looks beside its points: polygons, primvars, materials, GeomSubsets."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.io.surface.mtl import named_from
from warpgarment.io.surface.record import NONE, Coordinates, Labels, Material, Surface, members

from .looks import OBJECTS

GREY = (0.18, 0.18, 0.18)  # displayColor of faces whose colour is not known; USD shows them so anyway
MOST = 16  # entries of groups for each polygon up to which a name of several words is several groups


def identifier(name: str, taken: set[str]) -> str:
    """A name for a prim or a primvar, unlike those that are taken, to which it is added."""
    base = re.sub(r"[^A-Za-z0-9_]", "_", name) or "mesh"
    base = f"_{base}" if base[0].isdigit() else base
    unique, n = base, 1
    while unique in taken:
        unique, n = f"{base}_{n}", n + 1
    taken.add(unique)
    return unique


def dress(mesh: Any, surface: Surface, materials: Callable[[Material], Any]) -> None:
    """Writes a surface on a mesh that has its points.

    Args:
        mesh: The UsdGeom.Mesh.
        surface: The surface.
        materials: Makes a UsdShade.Material of one of ours.
    """
    from pxr import Vt

    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(surface.counts))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.corners))
    names: set[str] = set()
    for number, one in enumerate(surface.coordinates):
        _texture(mesh, one, identifier(one.name or (f"st{number}" if number else "st"), names))
    taken: set[str] = set()
    _subsets(mesh, surface.objects, OBJECTS, taken, words=False)
    _subsets(mesh, surface.groups, "groups", taken, words=True)
    _bind(mesh, surface, [materials(material) for material in surface.materials], taken)


def coordinates_name(surface: Surface) -> str:
    """The name of the first primvar that `dress` writes."""
    return identifier(surface.coordinates[0].name or "st", set()) if surface.coordinates else "st"


def _texture(mesh: Any, one: Coordinates, name: str) -> None:
    from pxr import Sdf, UsdGeom, Vt

    values, corners = one.values, one.corners
    if (corners == NONE).any():  # USD wants one for every corner
        values = np.concatenate([values, np.zeros((1, 2), dtype=np.float32)])
        corners = np.where(corners == NONE, len(values) - 1, corners).astype(np.int32)
    kind = Sdf.ValueTypeNames.TexCoord2fArray
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, UsdGeom.Tokens.faceVarying)
    primvar.Set(Vt.Vec2fArray.FromNumpy(values))
    primvar.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(corners)))


def _subset(mesh: Any, name: str, family: str, polygons: np.ndarray, taken: set[str]) -> Any:
    from pxr import UsdGeom, Vt

    plain = identifier(name, taken)
    subset = UsdGeom.Subset.CreateGeomSubset(
        mesh, plain, UsdGeom.Tokens.face, Vt.IntArray.FromNumpy(polygons.astype(np.int32)), family
    )
    if plain != name:
        subset.GetPrim().SetMetadata("displayName", name)
    return subset


def _subsets(mesh: Any, labels: Labels, family: str, taken: set[str], *, words: bool) -> None:
    """A subset for each name, with `words` for each word of the names."""
    polygons = members(labels.of_polygon)
    entries = sum(len(labels.names[k].split()) * len(polygons[k]) for k in labels.used)
    words = words and entries <= MOST * len(labels.of_polygon)
    parts: dict[str, list[np.ndarray]] = {}
    for k in labels.used:
        for name in dict.fromkeys(labels.names[k].split() if words else [labels.names[k]]):
            parts.setdefault(name, []).append(polygons[k])
    for name, some in parts.items():
        _subset(mesh, name, family, np.sort(np.concatenate(some)), taken)


def _bind(mesh: Any, surface: Surface, made: list[Any], taken: set[str]) -> None:
    """Binds materials, to the mesh where all faces have one, otherwise to subsets; and their colours for display."""
    from pxr import UsdGeom, UsdShade, Vt

    polygons = members(surface.material)
    used = list(polygons)
    if used == [NONE]:
        return
    if len(used) == 1:
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(made[used[0]])
    else:
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).SetMaterialBindSubsetsFamilyType(
            UsdGeom.Tokens.nonOverlapping
        )
        for k in used:
            if k == NONE:
                continue
            name = surface.materials[k].name or "material"
            subset = _subset(mesh, name, "materialBind", polygons[k], taken)
            UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(made[k])
    colors = [GREY if k == NONE else surface.materials[k].color or GREY for k in used]
    if all(k == NONE or surface.materials[k].color is None for k in used):
        return
    interpolation = UsdGeom.Tokens.constant if len(used) == 1 else UsdGeom.Tokens.uniform
    primvar = mesh.CreateDisplayColorPrimvar(interpolation)
    primvar.Set(Vt.Vec3fArray.FromNumpy(np.array(colors, dtype=np.float32)))
    if len(used) > 1:
        primvar.SetIndices(Vt.IntArray.FromNumpy(np.searchsorted(used, surface.material).astype(np.int32)))


class Wardrobe:
    """Materials of a stage, below /root/materials: each is made once.

    Args:
        stage: The stage.
        path: Where it will lie, to which names of pictures are relative.
    """

    def __init__(self, stage: Any, path: Path):
        self._stage, self._folder = stage, path.parent
        self._made: dict[tuple[Material, str], Any] = {}
        self._taken: set[str] = set()

    def material(self, material: Material, coordinates: str) -> Any:
        """The stage's material for one of ours.

        Args:
            material: The material.
            coordinates: The primvar of texture coordinates that its picture is laid out by.
        """
        if (material, coordinates) not in self._made:
            self._made[material, coordinates] = self._make(material, coordinates)
        return self._made[material, coordinates]

    def _make(self, material: Material, coordinates: str) -> Any:
        from pxr import Gf, Sdf, UsdGeom, UsdShade

        UsdGeom.Scope.Define(self._stage, "/root/materials")
        name = identifier(material.name or "material", self._taken)
        made = UsdShade.Material.Define(self._stage, f"/root/materials/{name}")
        if name != material.name:
            made.GetPrim().SetMetadata("displayName", material.name)
        if material.color is None and material.opacity is None and not material.texture:
            return made
        shader = UsdShade.Shader.Define(self._stage, f"{made.GetPath()}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        color = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        if material.color is not None:
            color.Set(Gf.Vec3f(*material.color))
        if material.opacity is not None:
            shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(float(material.opacity))
        if material.texture:
            reader = UsdShade.Shader.Define(self._stage, f"{made.GetPath()}/coordinates")
            reader.CreateIdAttr("UsdPrimvarReader_float2")
            reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(coordinates)
            picture = UsdShade.Shader.Define(self._stage, f"{made.GetPath()}/picture")
            picture.CreateIdAttr("UsdUVTexture")
            file = named_from(self._folder, material.texture)
            picture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(file))
            result = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
            picture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(result)
            color.ConnectToSource(picture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
        made.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
        return made
