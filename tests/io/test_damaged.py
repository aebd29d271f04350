"""If these failed, a damaged or hostile file would end in another library's error, in another mesh, or would fill
memory and take minutes: NPZ, PLY and polygons. What holds for all formats is in test_formats.py."""

from __future__ import annotations

import io
import struct
import time
import zipfile

import numpy as np
import pytest
from support.meshes import irregular_grid

import warpgarment as wg
from warpgarment.io import npz, ply
from warpgarment.io.polygons import LARGEST, triangulate_counts

SHEET = irregular_grid(6, 5)


def stored(array: np.ndarray) -> bytes:
    data = io.BytesIO()
    np.save(data, array)
    return data.getvalue()


def header(text: str) -> bytes:
    encoded = text.encode() + b" " * (63 - (10 + len(text)) % 64) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(encoded)) + encoded + bytes(64)


MEMBERS = {
    "text": b"hello world",
    "nothing": b"",
    "records": stored(np.zeros((4, 3), [("x", "f4"), ("y", "i4")])),
    "a shape that would fill memory": header("{'descr': '<f4', 'fortran_order': False, 'shape': (10**12, 3), }"),
    "a shape of a million million": header("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 3), }"),
    "a shape beyond what computers count": header(
        "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999, 3), }"
    ),
    "a negative shape": header("{'descr': '<f4', 'fortran_order': False, 'shape': (-4, -4), }"),
    "an expression": header("__import__('os').getcwd()"),
    "brackets": header("(" * 300),
    "a text without end": header("'''"),
    "version 9": b"\x93NUMPY\x09\0" + stored(SHEET.vertices)[8:],
    "more than the header says": stored(SHEET.vertices) + b"\0\0\0\0",
    "less than the header says": stored(SHEET.vertices)[:-4],
    "objects": stored(np.array([None, 1], dtype=object)),
}


@pytest.mark.parametrize("kind", MEMBERS)
@pytest.mark.parametrize("key", ["vertices", "faces"])
def test_an_array_that_is_none_is_refused_by_name(tmp_path, kind, key):
    """A damaged member would end in an error of zipfile, tokenize or NumPy, or in gigabytes asked for."""
    arrays = {"vertices": stored(SHEET.vertices), "faces": stored(SHEET.faces)} | {key: MEMBERS[kind]}
    with zipfile.ZipFile(tmp_path / "m.npz", "w") as file:
        for name, content in arrays.items():
            file.writestr(f"{name}.npy", content)
    for load in (wg.Garment.load, wg.BodyMotion.load):
        with pytest.raises(wg.MeshError, match=rf"m\.npz: {key}\.npy is not a readable plain array"):
            load(tmp_path / "m.npz")


def test_any_byte_of_an_archive_may_change(tmp_path):
    """A byte that changed on the way would end in an error without the file's name, or in other positions."""
    data = io.BytesIO()
    np.savez_compressed(data, vertices=SHEET.vertices[None], faces=SHEET.faces, fps=24.0)
    whole, refused = data.getvalue(), 0
    for place in range(0, len(whole), 7):
        changed = bytearray(whole)
        changed[place] ^= 0x5A
        (tmp_path / "m.npz").write_bytes(changed)
        try:
            found = wg.BodyMotion.load(tmp_path / "m.npz")
        except wg.MeshError as error:
            refused += "m.npz" in str(error)
        else:  # dates, flags and the like: CRCs guard the arrays
            np.testing.assert_array_equal(found.vertices[0], SHEET.vertices)
            refused += 1
    assert refused == len(range(0, len(whole), 7))


@pytest.mark.parametrize(("local", "central", "value"), [(6, 8, 1), (8, 10, 99)])
def test_encrypted_and_unknown_members_are_refused(tmp_path, local, central, value):
    """zipfile's RuntimeError or NotImplementedError would reach the user."""
    data = io.BytesIO()
    np.savez(data, vertices=SHEET.vertices, faces=SHEET.faces)
    changed = bytearray(data.getvalue())
    changed[local] |= value
    changed[changed.find(b"PK\1\2") + central] |= value
    (tmp_path / "m.npz").write_bytes(changed)
    with pytest.raises(wg.MeshError, match=r"m\.npz"):
        wg.Garment.load(tmp_path / "m.npz")


def test_arrays_of_other_orders_and_types_are_read(tmp_path):
    """Column order, byte order or doubles, as other tools write them, would be shuffled."""
    np.savez(tmp_path / "m.npz", vertices=np.asfortranarray(SHEET.vertices.astype(">f8")), faces=SHEET.faces[:, ::1])
    np.testing.assert_array_equal(wg.Garment.load(tmp_path / "m.npz").vertices, SHEET.vertices)


def test_a_bomb_is_not_unpacked(tmp_path, monkeypatch):
    """A file of some kilobytes would ask for as many gigabytes; arrays nobody needs would be unpacked."""
    monkeypatch.setattr(npz, "LARGE", 100_000)
    np.savez_compressed(tmp_path / "m.npz", vertices=np.zeros((1, 50_000, 3), np.float32), faces=SHEET.faces)
    with pytest.raises(wg.MeshError, match=r"vertices\.npy would unpack .* into 600,128"):
        wg.BodyMotion.load(tmp_path / "m.npz")
    bomb = np.zeros(500_000, np.uint8)
    np.savez_compressed(tmp_path / "m.npz", vertices=SHEET.vertices[None], faces=SHEET.faces, other=bomb)
    np.testing.assert_array_equal(wg.BodyMotion.load(tmp_path / "m.npz").vertices[0], SHEET.vertices)


def test_a_rate_that_is_a_mistake_does_not_fill_memory():
    """12 frames at 0.000001 a second would become 330 million."""
    body = wg.BodyMotion(np.repeat(SHEET.vertices[None], 12, 0), SHEET.faces, 1e-6)
    with pytest.raises(wg.MeshError, match="Is the rate right"):
        body.resampled(30.0)
    assert body.resampled(30.0, frames=3).frames == 3


HEAD = "ply\nformat {order} 1.0\nelement vertex {v}\nproperty float x\nproperty float y\nproperty float z\n{more}"
FACE = "element face {f}\nproperty list {length} {index} vertex_indices\nend_header\n"
TEXTS = {
    "a length of infinity": ("double", "int", "inf 0 1 2"),
    "a length that is no number": ("float", "int", "nan 0 1 2"),
    "a length of three and a half": ("uchar", "int", "3.5 0 1 2"),
    "a negative length": ("char", "int", "-3 0 1 2"),
    "a length beyond the file": ("int", "int", "999999999 0 1 2"),
    "fractions": ("uchar", "float", "3 0.7 1.2 2.9"),
    "indices that are no number": ("uchar", "float", "3 nan nan nan"),
    "an index of twenty digits": ("uchar", "int", "3 0 1 99999999999999999999"),
    "a negative index": ("uchar", "int", "3 0 1 -1"),
    "a word": ("uchar", "int", "3 0 one 2"),
    "two corners": ("uchar", "int", "2 0 1"),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_a_ply_that_makes_no_sense_is_refused(tmp_path, kind):
    """Lengths or indices that are none would end in an error of NumPy, or be cut to whole numbers."""
    length, index, row = TEXTS[kind]
    head = HEAD.format(order="ascii", v=3, more="") + FACE.format(f=1, length=length, index=index)
    (tmp_path / "m.ply").write_text(head + f"0 0 0\n1 0 0\n0 1 0\n{row}\n")
    with pytest.raises(wg.MeshError, match=r"m\.ply: not a readable PLY"):
        wg.Garment.load(tmp_path / "m.ply")


@pytest.mark.parametrize("faces", ["property int vertex_indices", "property list uchar int corners"])
def test_faces_without_a_list_of_corners_are_refused(tmp_path, faces):
    """A face element of another kind would end in a TypeError."""
    head = HEAD.format(order="ascii", v=3, more="") + f"element face 1\n{faces}\nend_header\n"
    (tmp_path / "m.ply").write_text(head + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(wg.MeshError, match=r"m\.ply: .*vertex_indices"):
        wg.Garment.load(tmp_path / "m.ply")


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("element", ["foo 1000000000", "vertex 1000000000", "face 1000000000"])
def test_elements_that_are_not_there_take_no_time(tmp_path, order, element):
    """A number in the header would be believed: a loop of a thousand million turns, or gigabytes."""
    name, count = element.split()
    counts = {"vertex": 3, "face": 1} | {name: count}
    more = f"element foo {count}\n" if name == "foo" else ""
    head = HEAD.format(order=order, v=counts["vertex"], more=more)
    head += FACE.format(f=counts["face"], length="uchar", index="int")
    big = ">" if "big" in order else "<"
    rows = np.eye(3).astype(big + "f4").tobytes() + struct.pack(big + "B3i", 3, 0, 1, 2)
    (tmp_path / "m.ply").write_bytes(head.encode() + (b"1 0 0 0 1 0 0 0 1 3 0 1 2" if order == "ascii" else rows))
    begin = time.process_time()
    if name == "foo":  # has no properties, and so takes no place in the file
        assert len(wg.Garment.load(tmp_path / "m.ply").vertices) == 3
    else:
        with pytest.raises(wg.MeshError, match="do not fit"):
            wg.Garment.load(tmp_path / "m.ply")
    assert time.process_time() - begin < 1


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_mixed_polygons_with_further_properties(tmp_path, order):
    """Polygons of different length, between colours and a second list, would be read from the wrong bytes."""
    big = ">" if "big" in order else "<"
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0], [3, 0.5, 0]], dtype=float)
    polygons = [[0, 1, 2, 3], [1, 4, 2], [2, 4, 6, 5]]
    head = f"ply\nformat {order} 1.0\nelement vertex 7\nproperty double x\nproperty double y\nproperty double z\n"
    head += "element face 3\nproperty uchar red\nproperty list uchar ushort vertex_indices\nproperty float quality\n"
    head += "property list uchar float texcoord\nend_header\n"
    rows = points.astype(big + "f8").tobytes()
    for k, polygon in enumerate(polygons):
        rows += struct.pack(f"{big}BB{len(polygon)}HfB{k}f", 9, len(polygon), *polygon, 0.5, k, *([0.25] * k))
    if order == "ascii":
        text = [" ".join(map(str, p)) for p in points]
        text += [f"9 {len(p)} {' '.join(map(str, p))} 0.5 {k} {'0.25 ' * k}" for k, p in enumerate(polygons)]
        rows = "\n".join(text).encode()
    (tmp_path / "m.ply").write_bytes(head.encode() + rows)
    vertices, faces = ply.read_ply(tmp_path / "m.ply")[:2]
    np.testing.assert_array_equal(vertices, points)
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 2, 3], [1, 4, 2], [2, 4, 6], [2, 6, 5]])


def test_triangles_and_quads_are_read_as_quickly_as_triangles(tmp_path):
    """An ordinary model of 30,000 faces would take seconds; a hundredth of a millisecond a face is allowed."""
    side = 151
    grid = np.stack([*np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), np.zeros((side, side))], -1)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    head = HEAD.format(order="binary_little_endian", v=side * side, more="")
    rows = []
    for k, i in enumerate(a.tolist()):
        quad = (i, i + 1, i + side + 1, i + side)
        rows += [struct.pack("<B4i", 4, *quad)] if k % 2 else [
            struct.pack("<B3i", 3, *quad[:3]), struct.pack("<B3i", 3, quad[0], *quad[2:])
        ]  # fmt: skip
    head += FACE.format(f=len(rows), length="uchar", index="int")
    data = head.encode() + grid.reshape(-1, 3).astype("<f4").tobytes() + b"".join(rows)
    (tmp_path / "m.ply").write_bytes(data)
    ply.read_ply(tmp_path / "m.ply")
    begin = time.process_time()
    faces = ply.read_ply(tmp_path / "m.ply")[1]
    assert time.process_time() - begin < 1e-5 * len(rows) + 0.1
    np.testing.assert_array_equal(faces.reshape(-1, 6)[:, [0, 1, 2, 5]], a[:, None] + [0, 1, side + 1, side])


def test_a_polygon_that_crosses_itself_takes_no_time():
    """600 corners at random places would take seconds, as each search for an ear would begin anew."""
    points = np.random.default_rng(0).random((600, 3))
    begin = time.process_time()
    faces = triangulate_counts(points, np.array([600]), np.arange(600))
    assert time.process_time() - begin < 1
    assert faces.shape == (598, 3)
    assert set(faces.reshape(-1)) == set(range(600))


def test_a_polygon_with_far_too_many_corners_is_refused(tmp_path):
    """Its triangles would be searched for minutes."""
    with pytest.raises(wg.MeshError, match="polygon 1 has 5,001 corners"):
        triangulate_counts(np.zeros((9, 3)), np.array([3, LARGEST + 1]), np.zeros(LARGEST + 4, dtype=int))


def test_concave_quads_among_others_are_covered_once():
    """A quad cut along its outer diagonal folds over: signed areas must be positive and sum to the polygon's."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 1, (2, 500, 1)) + [[[0, 1, 0.2, 0]], [[0, 0, 0.2, 1]]]  # an arrow, moved about
    turn = rng.integers(0, 4, 500)
    order = (np.arange(4) + turn[:, None]) % 4  # the inner corner comes first, second, third or last
    points = np.stack([x, y, 0 * x], axis=-1)
    corners = np.take_along_axis(np.arange(2000).reshape(500, 4), order, axis=1)
    faces = triangulate_counts(points.reshape(-1, 3), np.full(500, 4), corners.reshape(-1))
    p = points.reshape(-1, 3)[faces]
    areas = 0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2].reshape(500, 2)
    assert (areas > 0).all()
    np.testing.assert_allclose(areas.sum(axis=1), 0.2, rtol=1e-9)  # float64 rounding; two triangles of 0.1
