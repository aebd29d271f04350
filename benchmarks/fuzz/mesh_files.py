"""Sound files of meshes and of meshes in motion, and what their readers make of a file."""

from __future__ import annotations

import base64
import json
import struct
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.io.npz import write_npz
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion

from .shapes import FRAMES, box, moved, transforms, tube

Facts = dict[str, Any]


def garment(path: Path) -> Facts:
    """What `Garment.load` reads."""
    found = Garment.load(path)
    return {"vertices": found.vertices, "faces": found.faces, "pins": found.pins, "name": found.name}


def everything(path: Path) -> Facts:
    """What `Garment.load` reads of all objects together."""
    found = Garment.load(path, mesh="*", clean=True)
    return {"vertices": found.vertices, "faces": found.faces}


def body(path: Path) -> Facts:
    """What `BodyMotion.load` reads, and half as many frames of it again."""
    found = BodyMotion.load(path)
    facts = {"vertices": found.vertices, "faces": found.faces, "fps": found.fps}
    return facts | {"resampled": found.resampled(45.0, min(found.frames, 5)).vertices}


def motion(path: Path) -> Facts:
    """What `GarmentMotion.load` reads. It says which frames of a rollout that failed are not finite."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = GarmentMotion.load(path)
    told = any("NaN or infinity" in str(one.message) for one in said) or not all(s.finite for s in found.status)
    vertices = np.nan_to_num(found.vertices) if told else found.vertices
    return {"vertices": vertices, "faces": found.faces, "fps": found.fps, "frames": found.frames}


def write_obj(folder: Path) -> Path:
    """Quads and triangles with seams, groups, materials and a line that is continued."""
    vertices, faces = tube()
    lines = ["# a garment", "mtllib a.mtl", "o dress", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist())]
    lines += ["vt 0 0", "vn 0 1 0", "g front", "usemtl cotton", "s 1"]
    for k in range(0, len(faces), 2):
        a, b, c, d = faces[k][0] + 1, faces[k][1] + 1, faces[k][2] + 1, faces[k + 1][2] + 1
        if k % 3:
            lines.append(f"f {a}/1/1 {b}/1/1 {c}/1/1 {d}/1/1")
        else:
            lines += [f"f {a}//1 {b}//1 \\", f"  {c}//1", f"f {a - 1 - len(vertices)} {c} {d}"]
    (folder / "dress.obj").write_text("\n".join(lines) + "\n")
    return folder / "dress.obj"


def write_objects(folder: Path) -> Path:
    """Two objects in one file."""
    lines = []
    for k, radius in enumerate((0.3, 0.4)):
        vertices, faces = tube(6, 3, radius)
        lines += [f"o part_{k}", *(f"v {x} {y} {z}" for x, y, z in vertices.tolist())]
        lines += ["f " + " ".join(str(i + 1 + k * len(vertices)) for i in face) for face in faces.tolist()]
    (folder / "parts.obj").write_text("\n".join(lines) + "\n")
    return folder / "parts.obj"


def write_folder(folder: Path) -> Path:
    """Frames as .obj."""
    vertices, faces = box()
    for t, frame in enumerate(moved(vertices)):
        lines = [f"v {x} {y} {z}" for x, y, z in frame.tolist()]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
        (folder / f"frame_{t:04d}.obj").write_text("\n".join(lines) + "\n")
    return folder


def write_off(folder: Path) -> Path:
    """OFF with comments."""
    vertices, faces = tube()
    lines = ["OFF # a comment", f"{len(vertices)} {len(faces)} 0", *(f"{x} {y} {z}" for x, y, z in vertices.tolist())]
    lines += ["3 " + " ".join(map(str, face)) for face in faces.tolist()]
    (folder / "a.off").write_text("\n".join(lines) + "\n")
    return folder / "a.off"


def write_ply_text(folder: Path) -> Path:
    """PLY as text, with colours and lists of different lengths."""
    vertices, faces = tube()
    lines = ["ply", "format ascii 1.0", "comment made by nobody", f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"] + ["property uchar red"]
    lines += [f"element face {len(faces) - 1}", "property list uchar int vertex_indices", "end_header"]
    lines += [f"{x} {y} {z} 255" for x, y, z in vertices.tolist()]
    a, b, c, d = *faces[0].tolist(), int(faces[1][2])
    lines += [f"4 {a} {b} {c} {d}", *("3 " + " ".join(map(str, face)) for face in faces[2:].tolist())]
    (folder / "a.ply").write_text("\n".join(lines) + "\n")
    return folder / "a.ply"


def write_ply_binary(folder: Path) -> Path:
    """PLY, big end first."""
    vertices, faces = tube()
    head = f"ply\nformat binary_big_endian 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + f"element face {len(faces)}\n"
    head += "property list uchar int vertex_indices\nproperty short mark\nend_header\n"
    body = b"".join(struct.pack(">ddd", *v) for v in vertices.tolist())
    body += b"".join(struct.pack(">Biiih", 3, *face, 7) for face in faces.tolist())
    (folder / "a.ply").write_bytes(head.encode() + body)
    return folder / "a.ply"


def write_stl_text(folder: Path) -> Path:
    """STL as text."""
    vertices, faces = tube()
    lines = ["solid a"]
    for face in faces.tolist():
        lines += ["facet normal 0 0 0", "outer loop", *(f"vertex {x} {y} {z}" for x, y, z in vertices[face].tolist())]
        lines += ["endloop", "endfacet"]
    (folder / "a.stl").write_text("\n".join([*lines, "endsolid a"]) + "\n")
    return folder / "a.stl"


def write_stl_binary(folder: Path) -> Path:
    """STL, binary."""
    vertices, faces = tube()
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *vertices[face].reshape(-1).tolist(), 0) for face in faces)
    (folder / "a.stl").write_bytes(bytes(80) + struct.pack("<I", len(faces)) + body)
    return folder / "a.stl"


_COMPONENTS = {"u": 5125, "f": 5126, "B": 5121}
_SHAPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class _Gltf:
    """A glTF document in the making."""

    def __init__(self) -> None:
        self.data, self.views, self.accessors = b"", [], []  # type: ignore[var-annotated]

    def add(self, array: Any, kind: str) -> int:
        """An accessor of an array, by its index."""
        array = np.ascontiguousarray(array, {"u": "<u4", "f": "<f4", "B": "u1"}[kind])
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        entry = {"componentType": _COMPONENTS[kind], "type": _SHAPES[array.shape[1:]], "count": len(array)}
        self.accessors.append(entry | {"bufferView": len(self.views) - 1})
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        return len(self.accessors) - 1

    def document(self, **parts: Any) -> dict[str, Any]:
        """The document."""
        return {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
            "buffers": [{"byteLength": len(self.data)}], "bufferViews": self.views, "accessors": self.accessors,
            **parts,
        }  # fmt: skip

    def binary(self, **parts: Any) -> bytes:
        """A .glb."""
        text = json.dumps(self.document(**parts)).encode()
        text += b" " * (-len(text) % 4)
        rest = (
            struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(self.data), b"BIN\0") + self.data
        )
        return struct.pack("<4sII", b"glTF", 2, 12 + len(rest)) + rest


def write_glb(folder: Path) -> Path:
    """A garment with a node that is scaled and turned."""
    file, (vertices, faces) = _Gltf(), tube()
    primitive = {"attributes": {"POSITION": file.add(vertices, "f")}, "indices": file.add(faces.reshape(-1), "u")}
    nodes = [{"mesh": 0, "name": "dress", "scale": [1, 2, 1], "rotation": [0, 1, 0, 0], "translation": [0, 1, 0]}]
    (folder / "a.glb").write_bytes(file.binary(nodes=nodes, meshes=[{"primitives": [primitive], "name": "tube"}]))
    return folder / "a.glb"


def _animated(file: _Gltf) -> dict[str, Any]:
    """A body that two joints, two morph targets and a node move."""
    vertices, faces = box()
    count = len(vertices)
    high = (vertices[:, 1] > 0.5).astype(int)
    joints = np.stack([high, 0 * high, 0 * high, 0 * high], 1)
    attributes = {
        "POSITION": file.add(vertices, "f"), "JOINTS_0": file.add(joints, "B"),
        "WEIGHTS_0": file.add(np.tile([1.0, 0, 0, 0], (count, 1)), "f"),
    }  # fmt: skip
    targets = [{"POSITION": file.add(vertices * 0.1, "f")}, {"POSITION": file.add(-vertices * 0.1, "f")}]
    primitive = {"attributes": attributes, "indices": file.add(faces.reshape(-1), "u"), "targets": targets}
    times = file.add(np.arange(FRAMES) / 30.0, "f")
    turns = np.zeros((FRAMES, 4))
    turns[:, 3] = 1
    samplers = [
        {"input": times, "output": file.add(turns, "f")},
        {"input": times, "output": file.add(np.linspace(0, 1, 2 * FRAMES), "f"), "interpolation": "LINEAR"},
        {"input": times, "output": file.add(np.ones((3 * FRAMES, 3)), "f"), "interpolation": "CUBICSPLINE"},
    ]
    targeted = (("rotation", 2), ("weights", 0), ("translation", 1))
    channels = [{"sampler": k, "target": {"node": n, "path": path}} for k, (path, n) in enumerate(targeted)]
    bind = np.tile(np.eye(4), (2, 1, 1))
    return {
        "nodes": [{"mesh": 0, "skin": 0, "weights": [0, 0]}, {"children": [2]}, {"translation": [0, 0.5, 0]}],
        "scenes": [{"nodes": [0, 1]}],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": file.add(bind, "f")}],
        "meshes": [{"primitives": [primitive]}],
        "animations": [{"samplers": samplers, "channels": channels, "name": "walk"}],
    }


def write_skinned_glb(folder: Path) -> Path:
    """A body in motion."""
    file = _Gltf()
    (folder / "a.glb").write_bytes(file.binary(**_animated(file)))
    return folder / "a.glb"


def write_gltf(folder: Path) -> Path:
    """The same with a buffer beside it, and with one in the text."""
    file = _Gltf()
    document = file.document(**_animated(file))
    half = "data:application/octet-stream;base64," + base64.b64encode(bytes(8)).decode()
    document["buffers"] = [{"uri": "a.bin", "byteLength": len(file.data)}, {"uri": half, "byteLength": 8}]
    (folder / "a.gltf").write_text(json.dumps(document, indent=1))
    (folder / "a.bin").write_bytes(file.data)
    return folder / "a.gltf"


def write_usda(folder: Path) -> Path:
    """A body in motion as text, Z up, in centimetres, below a moving transform."""
    vertices, faces = box()
    lines = ["#usda 1.0", "(", '    upAxis = "Z"', "    metersPerUnit = 0.01", "    timeCodesPerSecond = 24", ")"]
    lines += ['def Xform "up"', "{", "    double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 4: (10, 0, 0) }"]
    lines += ['    uniform token[] xformOpOrder = ["xformOp:translate"]', '    def Mesh "body"', "    {"]
    lines += [f"        int[] faceVertexCounts = {[3] * len(faces)}", '        token visibility = "inherited"']
    lines += [
        f"        int[] faceVertexIndices = {faces.reshape(-1).tolist()}",
        "        point3f[] points.timeSamples = {",
    ]
    lines += [
        f"            {t}: {[tuple(p) for p in (100 * frame).tolist()]}," for t, frame in enumerate(moved(vertices), 1)
    ]
    (folder / "a.usda").write_text("\n".join([*lines, "        }", "    }", "}"]) + "\n")
    return folder / "a.usda"


def write_skeleton(folder: Path) -> Path:
    """A body that a skeleton and a blend shape move."""
    vertices, faces = box()
    points = [tuple(p) for p in vertices.tolist()]
    one = "( (1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1) )"
    text = f"""#usda 1.0
(
    upAxis = "Y"
    metersPerUnit = 1
    timeCodesPerSecond = 30
    startTimeCode = 0
    endTimeCode = 3
)
def SkelRoot "root"
{{
    def Skeleton "skeleton" (prepend apiSchemas = ["SkelBindingAPI"])
    {{
        uniform token[] joints = ["a", "a/b"]
        uniform matrix4d[] bindTransforms = [{one}, {one}]
        uniform matrix4d[] restTransforms = [{one}, {one}]
        rel skel:animationSource = </root/move>
    }}
    def SkelAnimation "move"
    {{
        uniform token[] joints = ["a", "a/b"]
        float3[] translations.timeSamples = {{ 0: [(0,0,0), (0,0,0)], 3: [(0.1,0,0), (0,0.1,0)] }}
        quatf[] rotations = [(1,0,0,0), (1,0,0,0)]
        half3[] scales = [(1,1,1), (1,1,1)]
        uniform token[] blendShapes = ["wide"]
        float[] blendShapeWeights.timeSamples = {{ 0: [0], 3: [1] }}
    }}
    def Mesh "body" (prepend apiSchemas = ["SkelBindingAPI"])
    {{
        int[] faceVertexCounts = {[3] * len(faces)}
        int[] faceVertexIndices = {faces.reshape(-1).tolist()}
        point3f[] points = {points}
        int[] primvars:skel:jointIndices = {[0, 1] * len(vertices)} ( elementSize = 2; interpolation = "vertex" )
        float[] primvars:skel:jointWeights = {[0.5, 0.5] * len(vertices)} ( elementSize = 2; interpolation = "vertex" )
        matrix4d primvars:skel:geomBindTransform = {one}
        rel skel:skeleton = </root/skeleton>
        uniform token[] skel:blendShapes = ["wide"]
        rel skel:blendShapeTargets = </root/body/wide>
        def BlendShape "wide"
        {{
            uniform vector3f[] offsets = [(0.1, 0, 0), (0, 0.1, 0)]
            uniform int[] pointIndices = [0, 1]
        }}
    }}
}}
"""
    (folder / "a.usda").write_text(text)
    return folder / "a.usda"


def write_usdc(folder: Path) -> Path:
    """A garment in motion, binary, by USD's own writer."""
    vertices, faces = tube()
    GarmentMotion(moved(vertices), faces, 30.0, (), "dress").save(folder / "a.usdc")
    return folder / "a.usdc"


def write_usdz(folder: Path) -> Path:
    """The same in an archive: not compressed, the data at multiples of 64 bytes."""
    content = write_usdc(folder).read_bytes()
    (folder / "a.usdc").unlink()
    entry = zipfile.ZipInfo("a.usdc")
    entry.extra = struct.pack("<HH", 0x1986, 64 - 30 - 6 - 4) + bytes(64 - 30 - 6 - 4)
    with zipfile.ZipFile(folder / "a.usdz", "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(entry, content)
    return folder / "a.usdz"


def write_pc2(folder: Path) -> Path:
    """A point cache with its mesh beside it."""
    vertices, faces = tube()
    GarmentMotion(moved(vertices), faces, 30.0, (), "dress").save(folder / "a.pc2")
    return folder / "a.pc2"


def write_abc(folder: Path) -> Path:
    """An Alembic archive of a mesh in motion."""
    vertices, faces = tube(8, 4, 0.3)
    GarmentMotion(moved(vertices), faces, 24.0, (), "dress", start=2.0).save(folder / "a.abc")
    return folder / "a.abc"


def write_mdd(folder: Path) -> Path:
    """A cache with the time of each frame, and its mesh."""
    vertices, faces = tube(8, 4, 0.3)
    GarmentMotion(moved(vertices), faces, 24.0, (), "dress", start=2.0).save(folder / "a.mdd")
    return folder / "a.mdd"


def write_garment_npz(folder: Path) -> Path:
    """A garment with pins."""
    vertices, faces = tube()
    Garment(vertices, faces, pins=[0, 1, 2], name="dress").save(folder / "a.npz")
    return folder / "a.npz"


def write_motion_npz(folder: Path) -> Path:
    """A rollout with its statuses."""
    vertices, faces = tube()
    write_npz(folder / "a.npz", {
        "vertices": moved(vertices), "faces": faces, "fps": np.array(30.0), "name": np.array("dress"),
        "status_frame": np.arange(FRAMES), "status_finite": np.ones(FRAMES, bool),
        "status_max_penetration": np.zeros(FRAMES), "status_poisson_iterations": np.ones(FRAMES, int),
        "status_collision_iterations": np.ones(FRAMES, int), "status_verdict": np.array(["ok"] * FRAMES),
    })  # fmt: skip
    return folder / "a.npz"


def write_body_npz(folder: Path) -> Path:
    """A body that bones move, with a mask of colliders."""
    vertices, faces = box()
    write_npz(folder / "a.npz", {
        "rest_vertices": vertices, "faces": faces, "bone_indices": np.zeros((len(vertices), 2), np.uint8),
        "bone_weights": np.full((len(vertices), 2), 0.5, np.float32), "bone_transforms": transforms(),
        "collider_faces": np.arange(len(faces)) < 10, "mocap_framerate": np.array(60.0), "frame_rate": np.array(60.0),
    })  # fmt: skip
    return folder / "a.npz"
