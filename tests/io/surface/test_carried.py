"""If these failed, a garment would come back as bare triangles and could not go back into the scene it is from: files
are compared, corner for corner, with readers that share no code with ours (`support.dressed`), to 2e-6."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import warnings

import numpy as np
import pytest
import trimesh
from support import dressed
from support.dressed import COLORS, POLYGONS, UV, VERTICES, close, expected, ordered, triangles

import warpgarment as wg
from warpgarment.cli import main
from warpgarment.training.teachers.blender.environment import VARIABLE, find_environment

SWAY = np.float32([[0, 0, 0], [0.01, 0, 0.02], [0.03, 0.01, 0.05]])
FRAMES = VERTICES + SWAY[:, None] * (1 + VERTICES[None, :, :1])
GROUPS = [p.group for p in POLYGONS]


def moved(garment: wg.Garment) -> wg.GarmentMotion:
    assert np.array_equal(garment.vertices, VERTICES)
    return wg.GarmentMotion(FRAMES, garment.faces, 24.0, name="skirt", surface=garment.surface)


@pytest.fixture
def skirt(tmp_path) -> wg.Garment:
    (tmp_path / "in").mkdir()
    return wg.Garment.load(dressed.write_obj(tmp_path / "in" / "skirt.obj"))


def check(path, faces, frame: int = 2, start: float = 0.0) -> None:
    """Everything of the skirt is in an output, at a frame."""
    if path.is_dir() or path.suffix == ".pc2":
        single = path.suffix == ".pc2"
        file = path.with_suffix(".obj") if single else sorted(path.glob("*.obj"))[frame]
        found, colors, groups = dressed.read_obj(file)
        assert close(found, expected(FRAMES[0 if single else frame]))
        assert groups == GROUPS
    elif path.suffix in (".glb", ".gltf"):
        found, colors = dressed.read_gltf(path, (start + frame) / 24.0)
        assert close(ordered(found), ordered(triangles(faces, FRAMES[frame])))
    else:
        found, colors, groups = dressed.read_usd(path, start + frame)
        assert close(found, expected(FRAMES[frame]))
        assert groups == GROUPS
    assert colors.keys() == COLORS.keys()
    for name, color in COLORS.items():
        assert colors[name] == pytest.approx(color, abs=1e-6)


OUTPUTS = ["frames", "m.usda", "m.usdc", "m.glb", "m.gltf", "m.pc2"]


@pytest.mark.parametrize("name", OUTPUTS)
def test_quads_of_obj_come_back(tmp_path, skirt, name):
    """Polygons, seams of texture coordinates, materials or groups would be lost on the way from OBJ to a format."""
    moved(skirt).save(tmp_path / name)
    check(tmp_path / name, skirt.faces)


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("between", ["frames", "m.usd", "m.npz", "m.pc2"])
def test_they_come_back_from_every_format_to_every_format(tmp_path, skirt, between, name):
    """`convert` would lose what a format holds: the skirt goes through one format into another."""
    motion = moved(skirt)
    motion.save(tmp_path / "a" / between)
    rate = [] if between in ("m.usd", "m.npz") else ["--input-fps", "24"]
    assert main(["convert", str(tmp_path / "a" / between), str(tmp_path / "b" / name), *rate]) == 0
    check(tmp_path / "b" / name, skirt.faces)


def test_gltf_hands_its_triangles_on(tmp_path, skirt):
    """Texture coordinates and materials of a .glb would be lost; its vertices, which are split at seams, are joined."""
    moved(skirt).save(tmp_path / "m.glb")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wg.BodyMotion.load(tmp_path / "m.glb").save(tmp_path / "m.usda")
        wg.Garment.load(tmp_path / "m.glb").save(tmp_path / "m.obj")
    assert len(wg.Garment.load(tmp_path / "m.glb").vertices) == len(VERTICES)
    wanted = ordered(triangles(skirt.faces, FRAMES[2]))
    assert close(ordered(dressed.read_usd(tmp_path / "m.usda", 2)[0]), wanted)
    found, colors, _ = dressed.read_obj(tmp_path / "m.obj")
    assert close(ordered(found), ordered(triangles(skirt.faces, FRAMES[0])))
    assert set(colors) == set(COLORS)


def test_a_rollout_hands_them_on(tmp_path, capsys):
    """The case users have: a skirt of quads is simulated, and what comes out has lost its texture and materials."""
    dressed.write_obj(tmp_path / "skirt.obj")
    body = trimesh.creation.box((0.4, 1.7, 0.3))
    np.savez(
        tmp_path / "body.npz", vertices=np.repeat(body.vertices[None] + [0, 0.85, 0], 3, 0), faces=body.faces, fps=30.0
    )
    arguments = [str(tmp_path / "skirt.obj"), str(tmp_path / "body.npz"), "--device", "cpu", "--out"]
    assert main(["simulate", *arguments, str(tmp_path / "out.npz")]) == 0
    assert main(["convert", str(tmp_path / "out.npz"), str(tmp_path / "frames")]) == 0
    assert "left out" not in capsys.readouterr().err
    found = dressed.read_obj(tmp_path / "frames" / "frame_0002.obj")[0]
    positions = wg.GarmentMotion.load(tmp_path / "out.npz").vertices[2]
    assert len(positions) == len(VERTICES)
    assert close(found, expected(positions))


def test_other_readers_see_them(tmp_path, skirt):
    """What we write would be read by our own reader alone: trimesh reads OBJ and glb."""
    moved(skirt).save(tmp_path / "frames")
    moved(skirt).save(tmp_path / "m.glb")
    for path in (tmp_path / "frames" / "frame_0000.obj", tmp_path / "m.glb"):
        scene = trimesh.load_scene(path, process=False)
        assert {m.visual.material.name for m in scene.geometry.values()} == set(COLORS)
        for mesh in scene.geometry.values():
            for position, pair in zip(mesh.vertices, mesh.visual.uv, strict=True):
                vertex = int(np.argmin(np.linalg.norm(FRAMES[0] - position, axis=1)))
                own = [UV[t] for p in POLYGONS if p.material == mesh.visual.material.name
                       for v, t in zip(p.vertices, p.coordinates, strict=True) if v == vertex]  # fmt: skip
                assert min(np.abs(pair - one).max() for one in own) < 1e-6


def stage(path, interpolation: str, indexed: bool, *, left: bool = False, mirrored: bool = False):
    """The skirt as USD, made by hand: two bound subsets, or one material; returns the pairs of all corners."""
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

    made = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(made, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(made, 1.0)
    mesh = UsdGeom.Mesh.Define(made, "/skirt")
    points = VERTICES * [-1, 1, 1] if mirrored else VERTICES
    if mirrored:
        mesh.AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    flip = left != mirrored  # wound the other way in the file
    order = np.arange(len(dressed.CORNERS))
    if flip:
        order = np.concatenate([k[::-1] for k in np.split(order, np.cumsum(dressed.COUNTS)[:-1])])
    if left:
        mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.float32(points)))
    mesh.CreateFaceVertexCountsAttr(dressed.COUNTS.tolist())
    mesh.CreateFaceVertexIndicesAttr(dressed.CORNERS[order].tolist())
    size = {"vertex": len(VERTICES), "varying": len(VERTICES), "uniform": len(POLYGONS), "constant": 1}.get(
        interpolation, len(order)
    )
    values = np.random.default_rng(3).random((size, 2)).astype(np.float32)
    if interpolation == "faceVarying":
        values = UV[dressed.COORDINATES[order]]
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("UVMap", Sdf.ValueTypeNames.TexCoord2fArray, interpolation)
    if indexed:
        unique, index = np.unique(values, axis=0, return_inverse=True)
        primvar.Set(Vt.Vec2fArray.FromNumpy(unique))
        primvar.SetIndices(index.reshape(-1).tolist())
    else:
        primvar.Set(Vt.Vec2fArray.FromNumpy(values))
    for number, (name, color) in enumerate(COLORS.items()):
        material = UsdShade.Material.Define(made, f"/materials/{name.replace(' ', '_')}")
        material.GetPrim().SetMetadata("displayName", name)
        shader = UsdShade.Shader.Define(made, f"{material.GetPath()}/s")
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
        material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
        faces = [k for k, p in enumerate(POLYGONS) if p.material == name]
        if number == 0:
            UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)  # faces without a subset have this one
        else:
            subset = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).CreateMaterialBindSubset("second", faces)
            UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    for name in ("front", "back", "hem"):
        faces = [k for k, p in enumerate(POLYGONS) if name in p.group.split()]
        UsdGeom.Subset.CreateGeomSubset(mesh, name, "face", faces, "parts")
    made.Save()
    polygon = np.repeat(np.arange(len(POLYGONS)), dressed.COUNTS)
    corner = dressed.CORNERS[order]
    owner = {"vertex": corner, "varying": corner, "uniform": polygon, "constant": 0 * order}
    rows = values[owner.get(interpolation, np.arange(len(order)))]
    return {(k, v): tuple(pair) for k, v, pair in zip(polygon.tolist(), corner.tolist(), rows, strict=True)}


@pytest.mark.parametrize(
    ("interpolation", "indexed", "left", "mirrored"),
    [
        ("faceVarying", True, False, False), ("faceVarying", False, True, False), ("vertex", False, False, False),
        ("vertex", True, False, True), ("varying", False, False, False), ("uniform", True, False, False),
        ("constant", False, False, False), ("faceVarying", True, True, True),
    ],
)  # fmt: skip
def test_usd_of_every_interpolation(tmp_path, interpolation, indexed, left, mirrored):
    """Texture coordinates of USD would be mixed, or go to other corners where the mesh is wound the other way."""
    pairs = stage(tmp_path / "in.usda", interpolation, indexed, left=left, mirrored=mirrored)
    garment = wg.Garment.load(tmp_path / "in.usda")
    moved(garment).save(tmp_path / "frames")
    moved(garment).save(tmp_path / "out.usda")
    for found, _, groups in (
        dressed.read_obj(tmp_path / "frames" / "frame_0002.obj"),
        dressed.read_usd(tmp_path / "out.usda", 2, "UVMap"),
    ):
        assert groups == GROUPS
        assert [material for _, material in found] == [p.material for p in POLYGONS]
        for k, ((corners, _), polygon) in enumerate(zip(found, POLYGONS, strict=True)):
            start = next(
                i for i, v in enumerate(polygon.vertices) if np.allclose(corners[0][0], FRAMES[2][v], atol=2e-6)
            )
            vertices = polygon.vertices[start:] + polygon.vertices[:start]  # seen from outside: the same way round
            np.testing.assert_allclose([c[0] for c in corners], FRAMES[2][vertices], atol=2e-6)
            np.testing.assert_allclose([c[1] for c in corners], [pairs[k, v] for v in vertices], atol=2e-6)


def glb(path) -> None:
    """Two primitives of one mesh by hand, one of them without texture coordinates, in a tube of 8 by 3 quads."""
    around, pieces, views, accessors = 8, [], [], []

    def add(array, kind, shape):
        data = array.tobytes()
        views.append({"buffer": 0, "byteOffset": sum(map(len, pieces)), "byteLength": len(data)})
        pieces.append(data + bytes(-len(data) % 4))
        accessors.append({"bufferView": len(views) - 1, "componentType": kind, "count": len(array), "type": shape})
        return len(accessors) - 1

    primitives = []
    for material, rows in ((1, (0, 1)), (0, (1, 2, 3))):
        angle = np.arange(around + 1) % around * 2 * np.pi / around  # the seam's vertices are there twice
        grid = np.array([[0.3 * np.sin(a), 0.6 + 0.2 * r, 0.3 * np.cos(a)] for r in rows for a in angle], np.float32)
        uv = np.array([[c / around, r / 3] for r in rows for c in range(around + 1)], np.float32)
        k = np.array([r * (around + 1) + c for r in range(len(rows) - 1) for c in range(around)])
        faces = np.concatenate(
            [np.stack([k, k + 1, k + around + 2], 1), np.stack([k, k + around + 2, k + around + 1], 1)]
        )
        attributes = {"POSITION": add(grid, 5126, "VEC3")}
        if material == 1:
            attributes["TEXCOORD_0"] = add(uv, 5126, "VEC2")
        primitives.append({"attributes": attributes, "indices": add(faces.astype("<u4").reshape(-1), 5125, "SCALAR"),
                           "material": material})  # fmt: skip
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "name": "tube"}],
        "meshes": [{"primitives": primitives}], "bufferViews": views, "accessors": accessors,
        "buffers": [{"byteLength": sum(map(len, pieces))}],
        "materials": [{"name": "plain"}, {"name": "red", "pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 0.5]}}],
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text
    body += struct.pack("<II", sum(map(len, pieces)), 0x004E4942) + b"".join(pieces)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


def test_primitives_of_gltf(tmp_path):
    """Materials would be mixed, or a primitive without texture coordinates take away those of the other."""
    glb(tmp_path / "tube.glb")
    garment = wg.Garment.load(tmp_path / "tube.glb")
    assert len(garment.vertices) == 32  # of 45: seams and borders of primitives are joined
    garment.save(tmp_path / "tube.obj")
    found, colors, _ = dressed.read_obj(tmp_path / "tube.obj")
    assert [material for _, material in found] == ["red"] * 16 + ["plain"] * 32
    assert colors == {"red": (1.0, 0.0, 0.0)}
    assert "d 0.5" in (tmp_path / "tube.mtl").read_text()
    for corners, material in found:
        for position, pair in corners:
            if material == "plain":
                assert pair == ()
                continue
            share = np.arctan2(position[0], position[2]) / (2 * np.pi) % 1.0
            assert min(abs(pair[0] - share), abs(pair[0] - share - 1)) < 1e-6
            assert pair[1] == pytest.approx(1 - (position[1] - 0.6) / 0.6, abs=1e-6)  # glTF counts from above
        if material == "red":
            assert np.ptp([pair[0] for _, pair in corners]) == pytest.approx(1 / 8, abs=1e-6)  # not across the seam


def test_ply_texture_coordinates(tmp_path):
    """Quads and texture coordinates of a PLY, of vertices or of corners, would be lost."""
    rows = [f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in VERTICES.tolist()]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {a}" for a in "xyz")]
    wedges = [np.ravel(UV[p.coordinates]).tolist() for p in POLYGONS]
    faces = [
        " ".join(map(str, [len(p.vertices), *p.vertices, len(w), *w])) for p, w in zip(POLYGONS, wedges, strict=True)
    ]
    tail = [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    text = [*head, *tail, "property list uchar float texcoord", "end_header", *rows, *faces]
    (tmp_path / "wedges.ply").write_text("\n".join(text) + "\n")
    wg.Garment.load(tmp_path / "wedges.ply").save(tmp_path / "a.obj")
    assert close(dressed.read_obj(tmp_path / "a.obj")[0], [(c, "") for c, _ in expected(VERTICES)])
    pairs = np.random.default_rng(0).random((len(rows), 2)).astype(np.float32)
    rows = [f"{row} {u:.9g} {v:.9g}" for row, (u, v) in zip(rows, pairs.tolist(), strict=True)]
    faces = [" ".join(map(str, [len(p.vertices), *p.vertices])) for p in POLYGONS]
    text = [*head, "property float s", "property float t", *tail, "end_header", *rows, *faces]
    (tmp_path / "vertices.ply").write_text("\n".join(text) + "\n")
    wg.Garment.load(tmp_path / "vertices.ply").save(tmp_path / "b.obj")
    found = dressed.read_obj(tmp_path / "b.obj")[0]
    for (corners, _), polygon in zip(found, POLYGONS, strict=True):
        np.testing.assert_allclose([pair for _, pair in corners], pairs[polygon.vertices], atol=2e-6)


BLENDER = """
import json, sys
import bpy

found = []
for path, frame in json.loads(sys.argv[1]):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.endswith(".obj"):
        bpy.ops.wm.obj_import(filepath=path)
    elif path.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=path)
    else:
        bpy.ops.wm.usd_import(filepath=path)
    bpy.context.scene.frame_set(frame)
    one = next(o for o in bpy.data.objects if o.type == "MESH")
    shown = one.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh, polygons = shown.to_mesh(), []
    for polygon in mesh.polygons:
        corners = []
        for loop in polygon.loop_indices:
            x, y, z = one.matrix_world @ mesh.vertices[mesh.loops[loop].vertex_index].co
            corners.append([[x, z, -y], list(mesh.uv_layers[0].data[loop].uv)])
        polygons.append([corners, one.material_slots[polygon.material_index].material.name])
    found.append(polygons)
print("FOUND" + json.dumps(found))
"""


@pytest.mark.skipif(VARIABLE not in os.environ, reason="needs Blender, of which a variable names the Python")
def test_blender_reads_them(tmp_path, skirt):
    """Texture coordinates or materials would not arrive where most users want them: OBJ, USD and glTF, to 2e-6."""
    motion = moved(skirt)
    for name in ("frames", "m.usda", "m.glb"):
        motion.save(tmp_path / name)
    # Blender puts the first key of a glTF animation, at 0 s, into frame 0
    files = [
        (str(tmp_path / "frames" / "frame_0002.obj"), 1),
        (str(tmp_path / "m.usda"), 2),
        (str(tmp_path / "m.glb"), 2),
    ]
    command = [str(find_environment()), "-I", "-c", BLENDER, json.dumps(files)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    polygons = [
        [
            ([tuple(map(dressed._row, corner)) for corner in corners], name.replace("lace_2", "lace 2"))
            for corners, name in one
        ]
        for one in json.loads(said.partition("FOUND")[2].splitlines()[0])
    ]
    wanted = ordered(triangles(skirt.faces, FRAMES[2]))
    assert close(polygons[0], expected(FRAMES[2]))
    assert close(polygons[1], expected(FRAMES[2]))
    assert close(ordered(polygons[2]), wanted)
