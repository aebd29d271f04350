"""If these failed, a character in .glb would stand still, be somewhere else, or a damaged file fill memory."""

from __future__ import annotations

import base64
import json
import struct
import warnings

import numpy as np
import pytest
import trimesh
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp
from support.meshes import capsule, skirt

import warpgarment as wg

BODY = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2)
V = len(BODY.vertices)
TYPES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
SHAPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class Writer:
    """A glTF file in the making."""

    def __init__(self):
        self.data, self.views, self.accessors = b"", [], []

    def add(self, array, **more):
        array = np.ascontiguousarray(array)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        entry = {"componentType": TYPES[array.dtype.name], "type": SHAPES[array.shape[1:]], "count": len(array)}
        self.accessors.append(entry | {"bufferView": len(self.views) - 1} | more)
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        return len(self.accessors) - 1

    def mesh(self, mesh=BODY, **attributes):
        index = self.add(np.asarray(mesh.faces).reshape(-1).astype(np.uint32))
        return {"attributes": {"POSITION": self.add(mesh.vertices), **attributes}, "indices": index}

    def write(self, path, **document):
        document = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
            "buffers": [{"byteLength": len(self.data)}], "bufferViews": self.views, "accessors": self.accessors,
        } | document  # fmt: skip
        if path.suffix == ".gltf":
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
            document["buffers"][0]["uri"] = uri
            path.write_text(json.dumps(document))
            return
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        rest = (
            struct.pack("<II", len(text), 0x4E4F534A)
            + text
            + struct.pack("<II", len(self.data), 0x004E4942)
            + self.data
        )
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(rest)) + rest)


def moving(writer, times, values, path, node=0, kind="LINEAR"):
    sampler = {"input": writer.add(np.float32(times)), "output": writer.add(np.float32(values)), "interpolation": kind}
    return [{"samplers": [sampler], "channels": [{"sampler": 0, "target": {"node": node, "path": path}}]}]


TURN = Rotation.from_euler("xyz", [[0, 0, 0], [0, 80, 10], [30, 170, 0]], degrees=True)
SLIDE = np.float32([[0, 0, 0], [0.5, 0, 0], [0.5, 1, 0]])


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("parent", [False, True])
def test_moving_nodes(tmp_path, suffix, parent):
    """A body that its node or a parent moves would stand still: against SciPy's slerp, to 1e-5 m."""
    writer = Writer()
    meshes = [{"primitives": [writer.mesh()]}]
    animations = moving(writer, [0, 0.5, 1], TURN.as_quat(), "rotation")
    more = moving(writer, [0, 0.5, 1], SLIDE, "translation")[0]
    animations[0]["samplers"] += more["samplers"]
    animations[0]["channels"].append({"sampler": 1, "target": {"node": 0, "path": "translation"}})
    nodes = [{"children": [1]}, {"mesh": 0, "scale": [1, 2, 1]}] if parent else [{"mesh": 0}]
    writer.write(tmp_path / f"m{suffix}", nodes=nodes, meshes=meshes, animations=animations)
    body = wg.BodyMotion.load(tmp_path / f"m{suffix}")
    assert body.fps >= 24
    time = np.arange(body.frames) / body.fps
    assert time[-1] == pytest.approx(1)
    turn = Slerp([0, 0.5, 1], TURN)(np.minimum(time, 1)).as_matrix()
    slide = np.stack([np.interp(time, [0, 0.5, 1], SLIDE[:, k]) for k in range(3)], axis=1)
    local = BODY.vertices * ([1, 2, 1] if parent else [1, 1, 1])
    np.testing.assert_allclose(body.vertices, local @ turn.transpose(0, 2, 1) + slide[:, None], atol=1e-5)


@pytest.mark.parametrize("kind", ["LINEAR", "STEP", "CUBICSPLINE"])
def test_interpolations(tmp_path, kind):
    """Keys would be joined by other curves than the file says: against NumPy and SciPy, to 1e-5 m."""
    times, values = np.array([0, 0.4, 1.0]), np.array([0, 0.3, -0.2])
    slopes = np.array([0.5, -1.0, 2.0])
    rows = np.zeros((3, 3, 3) if kind == "CUBICSPLINE" else (3, 3))
    if kind == "CUBICSPLINE":
        rows[:, 0, 0], rows[:, 1, 0], rows[:, 2, 0] = slopes, values, slopes
    else:
        rows[:, 0] = values
    writer = Writer()
    meshes = [{"primitives": [writer.mesh()]}]
    animations = moving(writer, times, rows.reshape(-1, 3), "translation", kind=kind)
    writer.write(tmp_path / "m.glb", nodes=[{"mesh": 0}], meshes=meshes, animations=animations)
    body = wg.BodyMotion.load(tmp_path / "m.glb")
    time = np.arange(body.frames) / body.fps
    expected = {
        "LINEAR": np.interp(time, times, values),
        "STEP": values[np.searchsorted(times, time + 1e-6, side="right") - 1],
        "CUBICSPLINE": CubicHermiteSpline(times, values, slopes)(np.minimum(time, 1)),
    }[kind]
    np.testing.assert_allclose(body.vertices[:, 0, 0] - BODY.vertices[0, 0], expected, atol=1e-5)


@pytest.mark.parametrize(("keys", "fps"), [(30, 30), (24, 24), (60, 60), (120, 120)])
@pytest.mark.parametrize("first", [0, 1001])
def test_keyframes_are_frames(tmp_path, keys, fps, first):
    """Baked animations would be resampled, lose their last frame, or begin at 0."""
    writer = Writer()
    meshes = [{"primitives": [writer.mesh()]}]
    slide = np.zeros((keys + 1, 3), np.float32)
    slide[:, 2] = np.sin(np.arange(keys + 1))
    animations = moving(writer, (first + np.arange(keys + 1)) / keys, slide, "translation")
    writer.write(tmp_path / "m.glb", nodes=[{"mesh": 0}], meshes=meshes, animations=animations)
    body = wg.BodyMotion.load(tmp_path / "m.glb")
    assert body.frames == keys + 1
    assert (body.fps, body.clock.number) == (fps, first)
    np.testing.assert_allclose(body.vertices[:, 0, 2] - BODY.vertices[0, 2], slide[:, 2], atol=1e-6)


def test_skins_and_morph_targets(tmp_path):
    """A character would be a statue, or stand where its armature does: linear blend skinning by hand, to 1e-5 m."""
    rng = np.random.default_rng(0)
    writer = Writer()
    upper = np.clip((BODY.vertices[:, 1] - 0.5) / 0.8, 0, 1)
    weights = np.zeros((V, 4), np.uint16)
    weights[:, 1] = np.round(65535 * upper)
    weights[:, 0] = 65535 - weights[:, 1]
    joints = np.tile(np.uint8([0, 1, 0, 0]), (V, 1))
    belly = rng.normal(0, 0.02, (V, 3)).astype(np.float32)
    armature = np.diag([0.01, 0.01, 0.01, 1.0])
    armature[:3, 3] = [0, 1, 0.5]
    hips, chest = np.eye(4), np.eye(4)
    hips[:3, 3], chest[:3, 3] = [0, 10, 0], [0, 80, 0]
    world = [armature @ hips, armature @ hips @ chest]
    bind = np.float32([np.linalg.inv(m).T for m in world])
    primitive = writer.mesh(JOINTS_0=writer.add(joints), WEIGHTS_0=writer.add(weights, normalized=True))
    primitive["targets"] = [{"POSITION": writer.add(belly)}]
    skins = [{"joints": [2, 3], "inverseBindMatrices": writer.add(bind)}]
    turns = Rotation.from_rotvec(np.radians(3) * np.arange(25)[:, None] * [0, 0, 1])
    animations = moving(writer, np.arange(25) / 24, turns.as_quat(), "rotation", node=3)
    extra = moving(writer, [0, 1], [0, 1], "weights", node=1)[0]
    animations[0]["samplers"] += extra["samplers"]
    animations[0]["channels"].append({"sampler": 1, "target": {"node": 1, "path": "weights"}})
    nodes = [
        {"name": "Armature", "children": [1, 2], "scale": [0.01] * 3, "translation": [0, 1, 0.5]},
        {"name": "Body", "mesh": 0, "skin": 0, "translation": [5, 5, 5]},
        {"name": "hips", "translation": [0, 10, 0], "children": [3]},
        {"name": "chest", "translation": [0, 80, 0]},
    ]
    writer.write(
        tmp_path / "m.glb", nodes=nodes, meshes=[{"primitives": [primitive]}], skins=skins, animations=animations
    )
    body = wg.BodyMotion.load(tmp_path / "m.glb")
    assert (body.frames, body.fps) == (25, pytest.approx(24, rel=1e-5))
    share = np.stack([1 - upper, upper], axis=1)
    for t in range(25):
        turned = np.eye(4)
        turned[:3, :3] = turns[t].as_matrix()
        moved = [np.linalg.inv(world[0]), np.linalg.inv(world[1])]
        moved = [world[0] @ moved[0], world[1] @ turned @ moved[1]]
        points = np.concatenate([BODY.vertices + t / 24 * belly, np.ones((V, 1))], axis=1)
        expected = sum(share[:, k, None] * (points @ moved[k].T)[:, :3] for k in range(2))
        np.testing.assert_allclose(body.vertices[t], expected, atol=2e-5)  # weights of 16 bits
    np.testing.assert_allclose(wg.Garment.load(tmp_path / "m.glb").vertices, BODY.vertices, atol=1e-5)


def test_mirrored_nodes_turn_faces(tmp_path):
    """A mirrored mesh would look inwards: trimesh is the oracle for positions, the volume for the outside."""
    writer = Writer()
    meshes = [{"primitives": [writer.mesh()]}]
    matrix = np.diag([-1.0, 1, 1, 1])
    matrix[:3, 3] = [1, 2, 3]
    writer.write(tmp_path / "m.glb", nodes=[{"mesh": 0, "matrix": matrix.T.reshape(-1).tolist()}], meshes=meshes)
    garment = wg.Garment.load(tmp_path / "m.glb")
    np.testing.assert_allclose(garment.vertices, BODY.vertices * [-1, 1, 1] + [1, 2, 3], atol=1e-6)
    assert trimesh.Trimesh(garment.vertices, garment.faces, process=False).volume > 0


def test_strips_fans_and_sparse_accessors(tmp_path):
    """Other ways to store triangles would be read as if they were lists, or changes be passed over."""
    points = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]])
    faces = {5: [[0, 1, 2], [1, 3, 2], [2, 3, 4]], 6: [[1, 2, 0], [2, 3, 0], [3, 4, 0]]}
    for mode, expected in faces.items():
        writer = Writer()
        writer.add(np.uint16([4]))
        writer.add(np.float32([[0, 3, 0]]))
        sparse = {"count": 1, "indices": {"bufferView": 0, "componentType": 5123}, "values": {"bufferView": 1}}
        primitive = {"attributes": {"POSITION": writer.add(points, sparse=sparse)}, "mode": mode}
        writer.write(tmp_path / "m.glb", nodes=[{"mesh": 0}], meshes=[{"primitives": [primitive]}])
        garment = wg.Garment.load(tmp_path / "m.glb", clean=mode == 6)
        assert garment.vertices[4].tolist() == [0, 3, 0]
        assert mode == 6 or garment.faces.tolist() == expected


def test_seams_are_joined_and_objects_are_named(tmp_path):
    """Texture seams would tear a garment, or a whole scene be one garment."""
    cloth = skirt(12, 4)
    corners = np.arange(3 * len(cloth.faces), dtype=np.int64).reshape(-1, 3)
    split = type(cloth)(cloth.vertices[cloth.faces.reshape(-1)], corners)
    writer = Writer()
    meshes = [{"name": "skirt mesh", "primitives": [writer.mesh(split)]}, {"primitives": [writer.mesh()]}]
    nodes = [{"name": "Skirt", "mesh": 0}, {"name": "Avatar", "mesh": 1}]
    writer.write(tmp_path / "m.glb", nodes=nodes, meshes=meshes, scenes=[{"nodes": [0, 1]}])
    for name in ("Skirt", "skirt mesh"):
        garment = wg.Garment.load(tmp_path / "m.glb", mesh=name)
        assert (len(garment.vertices), garment.components[2]) == (len(cloth.vertices), 1)
        corners = garment.vertices[garment.faces]
        np.testing.assert_array_equal(corners, cloth.vertices[cloth.faces])
    with pytest.raises(wg.MeshError, match="2 meshes: Skirt, Avatar"):
        wg.Garment.load(tmp_path / "m.glb")
    with pytest.raises(wg.MeshError, match="no mesh named 'Shoe'; it holds Skirt, Avatar, skirt mesh"):
        wg.BodyMotion.load(tmp_path / "m.glb", mesh="Shoe")
    assert len(wg.Garment.load(tmp_path / "m.glb", mesh="*").faces) == len(cloth.faces) + len(BODY.faces)


def test_one_of_several_animations_is_said(tmp_path):
    """The idle pose would be simulated instead of the dance, unsaid."""
    writer = Writer()
    meshes = [{"primitives": [writer.mesh()]}]
    animations = [
        {**moving(writer, [0, 1], SLIDE[:2], "translation")[0], "name": name} for name in ("idle", "walk")
    ]  # fmt: skip
    writer.write(tmp_path / "m.glb", nodes=[{"mesh": 0}], meshes=meshes, animations=animations)
    with pytest.warns(UserWarning, match=r"2 animations \(idle, walk\); the first is read"):
        wg.BodyMotion.load(tmp_path / "m.glb")


def whole():
    writer = Writer()
    first = np.tile(np.float32([1, 0, 0, 0]), (V, 1))
    primitive = writer.mesh(JOINTS_0=writer.add(np.zeros((V, 4), np.uint8)), WEIGHTS_0=writer.add(first))
    document = {
        "nodes": [{"mesh": 0, "skin": 0}, {"children": [2]}, {}],
        "scenes": [{"nodes": [0, 1]}],
        "meshes": [{"primitives": [primitive]}],
        "skins": [{"joints": [2], "inverseBindMatrices": writer.add(np.eye(4, dtype=np.float32)[None])}],
        "animations": moving(writer, [0, 1], SLIDE[:2], "translation", node=2),
    }
    return writer, document


VALUES = (
    None,
    -1,
    0,
    1,
    2,
    7,
    1e9,
    1e300,
    2**63,
    "0",
    "../../etc/passwd",
    [],
    [0],
    {},
    {"mesh": 0},
    True,
    float("nan"),
)


def test_any_value_of_the_document_may_be_another(tmp_path):
    """A count, index or name that makes no sense would end in an error of Python, NumPy or in endless loops: each
    place of a small document takes each of some values."""
    writer, document = whole()
    writer.write(tmp_path / "m.gltf", **document)
    text = json.loads((tmp_path / "m.gltf").read_text())
    places = []

    def walk(value, path):
        for key, child in value.items() if isinstance(value, dict) else enumerate(value):
            places.append((*path, key))
            if isinstance(child, (dict, list)):
                walk(child, (*path, key))

    walk(text, ())
    read = unnamed = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for n, (*path, last) in enumerate(places):
            for value in VALUES[n % 3 :: 3]:
                changed = json.loads(json.dumps(text))
                parent = changed
                for key in path:
                    parent = parent[key]
                parent[last] = value
                (tmp_path / "x.gltf").write_text(json.dumps(changed))
                try:
                    wg.BodyMotion.load(tmp_path / "x.gltf")
                    read += 1
                except wg.MeshError as error:
                    unnamed += "x.gltf" not in str(error)
    assert unnamed == 0
    assert 0 < read < 3 * len(places)


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_compressions_are_named(tmp_path, name):
    """A compressed file would be called damaged."""
    writer, document = whole()
    writer.write(tmp_path / "m.glb", **document, extensionsRequired=[name])
    with pytest.raises(wg.MeshError, match=f"it needs {name}, which is not read"):
        wg.BodyMotion.load(tmp_path / "m.glb")


def test_buffers_outside_the_folder_are_not_opened(tmp_path):
    """A file from a stranger would read others' files."""
    (tmp_path / "secret.bin").write_bytes(bytes(10_000))
    (tmp_path / "in").mkdir()
    writer, document = whole()
    for uri in ("../secret.bin", str(tmp_path / "secret.bin"), "%2e%2e/secret.bin"):
        document["buffers"] = [{"byteLength": 100, "uri": uri}]
        writer.write(tmp_path / "in" / "m.glb", **document)
        with pytest.raises(wg.MeshError, match="not in its folder"):
            wg.BodyMotion.load(tmp_path / "in" / "m.glb")


def test_a_crowd_of_instances_does_not_fill_memory(tmp_path):
    """A mesh named by ten thousand nodes, over a thousand frames, would ask for gigabytes."""
    writer = Writer()
    meshes = [{"primitives": [writer.mesh()]}]
    animations = moving(writer, np.arange(1001) / 30, np.zeros((1001, 3)), "translation")
    nodes = [{"mesh": 0}] * 10_000
    writer.write(
        tmp_path / "m.glb", nodes=nodes, meshes=meshes, animations=animations, scenes=[{"nodes": list(range(10_000))}]
    )
    with pytest.raises(wg.MeshError, match="frames of 10,000 meshes would take"):
        wg.BodyMotion.load(tmp_path / "m.glb")


def test_a_fault_of_the_reader_is_no_damage(tmp_path, monkeypatch):
    """A fault of this package would be told to users as damage of their file, and never be found."""
    from warpgarment.io.gltf import scene

    path = tmp_path / "m.glb"
    writer, document = whole()
    writer.write(path, **document)
    for fault in (KeyError("x"), IndexError("x"), TypeError("x"), ValueError("x"), AttributeError("x")):

        def broken(*_, fault=fault):
            raise fault

        monkeypatch.setattr(scene.Scene, "placed", broken)
        with pytest.raises(type(fault)) as raised:
            wg.BodyMotion.load(path)
        assert not isinstance(raised.value, wg.MeshError)
