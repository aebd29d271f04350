"""If these failed, OBJ files as other programs write them would lose vertices, faces, objects or frames."""

from __future__ import annotations

import codecs
import warnings

import numpy as np
import pytest
from support.meshes import capsule, skirt

import warpgarment as wg
from warpgarment.io.obj import obj_text

SHEET = skirt(8, 3)
ROWS = obj_text(SHEET.vertices, SHEET.faces).splitlines()
V = len(SHEET.vertices)
FIRST, LAST = ROWS[0].rpartition(" "), ROWS[-1].rpartition(" ")
TWICE = ["f \\", LAST[0][2:] + "\\", LAST[2] + "\\"]
TEXTS = {
    "as it is": "\n".join(ROWS).encode(),
    "a byte-order mark before a vertex": codecs.BOM_UTF8 + "\n".join(ROWS).encode(),
    "a byte-order mark before a comment": codecs.BOM_UTF8 + "\n".join(["# a", *ROWS]).encode(),
    "sixteen bits, little": codecs.BOM_UTF16_LE + "\n".join(ROWS).encode("utf-16-le"),
    "sixteen bits, big": codecs.BOM_UTF16_BE + "\n".join(ROWS).encode("utf-16-be"),
    "line ends of Windows": "\r\n".join(ROWS).encode(),
    "line ends of old Macs": "\r".join(ROWS).encode(),
    "names of another code page": "\n".join(["usemtl stra\u00dfe", *ROWS]).encode("latin-1"),
    "a library whose path ends in a backslash": "\n".join(["mtllib C:\\cloth\\", *ROWS]).encode(),
    "a material whose path ends in a backslash": "\n".join([*ROWS[:V], "usemtl a\\", *ROWS[V:]]).encode(),
    "an object whose name ends in a backslash": "\n".join(["o a\\", *ROWS]).encode(),
    "a comment that ends in a backslash": "\n".join(["# from D:\\", *ROWS]).encode(),
    "a face continued": "\n".join([*ROWS[:-1], f"{LAST[0]} \\", LAST[2]]).encode(),
    "a face continued with a comment between": "\n".join([*ROWS[:-1], f"{LAST[0]} \\ # more", LAST[2]]).encode(),
    "a face continued twice, last of the file": "\n".join([*ROWS[:-1], *TWICE]).encode(),
    "a vertex continued": "\n".join([FIRST[0] + " \\", FIRST[2], *ROWS[1:]]).encode(),
    "tabs and spaces": "\n".join(row.replace(" ", " \t ") + "  " for row in ROWS).encode(),
    "indented": "\n".join("   " + row for row in ROWS).encode(),
}  # fmt: skip


@pytest.mark.parametrize("kind", TEXTS)
def test_the_same_mesh_from_every_text(tmp_path, kind):
    """A vertex would be lost behind a byte-order mark, or a line swallowed by the one before."""
    (tmp_path / "m.obj").write_bytes(TEXTS[kind])
    garment = wg.Garment.load(tmp_path / "m.obj")
    np.testing.assert_array_equal(garment.vertices, SHEET.vertices)
    np.testing.assert_array_equal(garment.faces, SHEET.faces)


BODY, SHIRT = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2), skirt(12, 4)
PARTS = {"Avatar": BODY, "Shirt": SHIRT, "Under Skirt": skirt(10, 3, waist=0.25)}


def scene(head="o {name}\n"):
    text, base = "", 1
    for name, mesh in PARTS.items():
        text += head.format(name=name)
        text += "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in mesh.vertices.tolist())
        text += "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + base).tolist())
        base += len(mesh.vertices)
    return text


@pytest.mark.parametrize("head", ["o {name}\n", "g {name}\n", "o {name}\ng {name}\nusemtl x\n", "g {name}\no {name}\n"])
@pytest.mark.parametrize("load", [wg.Garment.load, wg.BodyMotion.load])
def test_a_named_object_is_read_alone(tmp_path, head, load):
    """An avatar would be simulated as cloth together with its clothes, or a name be passed over."""
    (tmp_path / "m.obj").write_text(scene(head))
    for name, mesh in PARTS.items():
        if load is wg.Garment.load or name == "Avatar":
            found = load(tmp_path / "m.obj", mesh=name)
            np.testing.assert_array_equal(found.vertices.reshape(-1, 3), mesh.vertices)
            np.testing.assert_array_equal(found.faces, mesh.faces)
    with pytest.raises(wg.MeshError, match="no mesh named 'Shoe'; it holds Avatar, Shirt, Under Skirt"):
        load(tmp_path / "m.obj", mesh="Shoe")
    whole = load(tmp_path / "m.obj", mesh="*")
    assert len(whole.faces) == sum(len(mesh.faces) for mesh in PARTS.values())


def test_several_objects_ask_and_several_groups_are_said(tmp_path):
    """Three objects in one file would be one garment, unsaid."""
    (tmp_path / "o.obj").write_text(scene())
    with pytest.raises(wg.MeshError, match=r"3 objects: Avatar, Shirt, Under Skirt\. Name one with mesh="):
        wg.Garment.load(tmp_path / "o.obj")
    (tmp_path / "g.obj").write_text(scene("g {name}\n"))
    with pytest.warns(UserWarning, match="3 groups that are not connected .*: Avatar, Shirt, Under Skirt"):
        wg.Garment.load(tmp_path / "g.obj")


@pytest.mark.parametrize("word", ["o", "g"])
def test_parts_of_one_connected_mesh_are_one_mesh(tmp_path, word, recwarn):
    """A garment with an object or a group for each material would be refused, or lose all but one of them."""
    rows = [*ROWS[:V], f"{word} front", *ROWS[V : V + 20], f"{word} back", *ROWS[V + 20 :]]
    (tmp_path / "m.obj").write_text("\n".join(rows))
    assert len(wg.Garment.load(tmp_path / "m.obj").faces) == len(SHEET.faces)
    assert len(wg.Garment.load(tmp_path / "m.obj", mesh="front").faces) == 20
    assert not recwarn.list


def test_a_word_of_a_groups_line_names_it(tmp_path):
    """`g cloth left` belongs to two groups."""
    rows = [*ROWS[:V], "g cloth left", *ROWS[V : V + 8], "g cloth right", *ROWS[V + 8 :]]
    (tmp_path / "m.obj").write_text("\n".join(rows))
    for name, count in (("cloth", len(SHEET.faces)), ("left", 8), ("cloth left", 8)):
        assert len(wg.Garment.load(tmp_path / "m.obj", mesh=name).faces) == count


@pytest.mark.parametrize("suffix", [".ply", ".off", ".stl", ".npz"])
def test_a_name_is_never_passed_over(tmp_path, suffix):
    """`mesh=` would be accepted, and mean nothing, for formats without names."""
    import trimesh

    path = tmp_path / f"m{suffix}"
    if suffix in (".off", ".stl"):
        trimesh.Trimesh(SHEET.vertices, SHEET.faces, process=False).export(path)
    else:
        wg.Garment(SHEET.vertices, SHEET.faces, name="skirt").save(path)
    for load in (wg.Garment.load, wg.BodyMotion.load):
        with pytest.raises(wg.MeshError, match="no mesh named 'NoSuchThing'"):
            load(path, mesh="NoSuchThing")
    if suffix == ".npz":
        assert wg.Garment.load(path, mesh="skirt").name == "skirt"


def frames(folder, numbers, suffix=".obj", text=None):
    folder.mkdir()
    for n in numbers:
        moved = BODY.vertices + np.float32([0, 0, 0.01 * n])
        (folder / f"walk_{n:04d}{suffix}").write_text(text(moved) if text else obj_text(moved, BODY.faces))
    return folder


def travel(body):
    return body.vertices[:, 0, 2] - BODY.vertices[0, 2]


def test_upper_case_and_hidden_files(tmp_path):
    """.OBJ would not be found, and what macOS leaves beside files be called damaged."""
    folder = frames(tmp_path / "f", range(3), ".OBJ")
    (folder / "._walk_0000.obj").write_bytes(b"\0\5\x16\7" + bytes(60))
    (folder / "notes.txt").write_text("take 3")
    assert wg.BodyMotion.load(folder, fps=24).frames == 3


@pytest.mark.parametrize(
    ("numbers", "fps", "times", "said"),
    [
        ([0, 1, 2, 4, 5], 30, np.arange(6), "1 of 6 frames are missing (first: number 3)"),
        ([1001, 1002, 1009], 30, np.arange(1001, 1010), "6 of 9 frames are missing (first: number 1003)"),
        ([0, 2, 4, 6], 15, np.arange(0, 7, 2), "from 0 to 6 in steps of 2"),
        ([10, 15, 25], 6, np.arange(10, 26, 5), "1 of 4 frames are missing (first: number 20)"),
        ([7, 8, 9], 30, np.arange(7, 10), None),
    ],
)
def test_gaps_keep_their_time(tmp_path, numbers, fps, times, said):
    """A gap would close up: later frames come too early. Positions are on a line in time, to float32 rounding."""
    folder = frames(tmp_path / "f", numbers)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        body = wg.BodyMotion.load(folder, fps=30)
    assert [str(w.message) for w in heard if said and said in str(w.message)] or said is None
    assert len(heard) == (said is not None)
    assert body.fps == pytest.approx(fps)
    np.testing.assert_allclose(travel(body), 0.01 * times, atol=1e-6)


def test_one_file_of_another_sequence_is_refused(tmp_path):
    """A stray file number 9000000 would ask for millions of frames."""
    folder = frames(tmp_path / "f", [0, 1, 2, 9_000_000])
    with pytest.raises(wg.MeshError, match="no frames between the numbers 2 and 9000000"):
        wg.BodyMotion.load(folder)


def test_names_without_numbers_are_in_order(tmp_path):
    """A folder whose names do not count would be refused."""
    folder = tmp_path / "f"
    folder.mkdir()
    for k, name in enumerate(("a", "b", "c")):
        (folder / f"{name}.obj").write_text(obj_text(BODY.vertices + np.float32([0, 0, 0.01 * k]), BODY.faces))
    np.testing.assert_allclose(travel(wg.BodyMotion.load(folder, fps=30)), [0, 0.01, 0.02], atol=1e-6)


def test_one_object_of_every_frame(tmp_path):
    """Frames of a scene would be read with everything in them."""

    def text(moved):
        shift = SHIRT.faces + len(moved) + 1
        rows = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in SHIRT.vertices.tolist()]
        rows += [f"f {a} {b} {c}" for a, b, c in shift.tolist()]
        return obj_text(moved, BODY.faces, "body") + "o shirt\n" + "\n".join(rows)

    folder = frames(tmp_path / "f", range(3), text=text)
    body = wg.BodyMotion.load(folder, fps=30, mesh="body")
    assert body.vertices.shape == (3, *BODY.vertices.shape)
    np.testing.assert_allclose(travel(body), [0, 0.01, 0.02], atol=1e-6)
    with pytest.raises(wg.MeshError, match="2 objects: body, shirt"):
        wg.BodyMotion.load(folder, fps=30)
