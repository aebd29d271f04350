"""If these failed, looks would belong to other corners after a mesh was turned, cut or cleaned, or a damaged or hostile
file would take a garment, a file of its owner, or memory with it."""

from __future__ import annotations

import os
import warnings

import numpy as np
import pytest
from support import dressed
from support.dressed import COLORS, COORDINATES, CORNERS, COUNTS, POLYGONS, UV, VERTICES, close, expected

import warpgarment as wg
from warpgarment.io.surface.mtl import OURS
from warpgarment.io.surface.record import Coordinates, Labels, Material, Surface


def load(folder, text: str = "", **options) -> wg.Garment:
    """The skirt, with more lines at its end."""
    path = dressed.write_obj(folder / "skirt.obj")
    path.write_text(path.read_text() + "\n" + text)
    return wg.Garment.load(path, **options)


def heard(call) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    return [str(warning.message) for warning in found]


def pairs_of(surface: Surface) -> set[tuple]:
    """Each corner: its polygon, vertex and texture coordinates."""
    values = surface.coordinates[0].values[surface.coordinates[0].corners]
    return {(int(p), int(v), *map(float, uv)) for p, v, uv in
            zip(surface.polygon_of_corner, surface.corners, values, strict=True)}  # fmt: skip


def test_polygons_that_are_turned_keep_their_coordinates(tmp_path):
    """A body that is inside out is turned round: its polygons would look inwards, or mix texture coordinates."""
    sphere = ["o ball"]
    import trimesh

    ball = trimesh.creation.icosphere(1, 0.3)
    sphere += [f"v {x} {y} {z}" for x, y, z in ball.vertices] + [f"vt {x} {y}" for x, y, _ in ball.vertices]
    inwards = ball.faces[:, ::-1]
    rows = [f"f {a + 1}/{a + 1} {b + 1}/{b + 1} {c + 1}/{c + 1}" for a, b, c in inwards]
    (tmp_path / "ball.obj").write_text("\n".join(sphere + rows))
    with pytest.warns(UserWarning, match="inside out"):
        body = wg.BodyMotion.load(tmp_path / "ball.obj")
    turned = body.surface.corners.reshape(-1, 3)
    assert {tuple(np.roll(f, -int(np.argmin(f)))) for f in turned} == {
        tuple(np.roll(f, -int(np.argmin(f)))) for f in ball.faces
    }
    values = body.surface.coordinates[0].values[body.surface.coordinates[0].corners]
    np.testing.assert_allclose(values, ball.vertices[body.surface.corners][:, :2], atol=1e-7)


def test_polygons_of_any_size_turn_about_their_first_corner():
    """The triangles of a turned pentagon would be others than those that were turned."""
    surface = Surface(COUNTS, CORNERS, (Coordinates("", UV, COORDINATES),))
    mask = np.arange(len(COUNTS)) % 2 == 1
    turned = surface.turned(mask)
    assert pairs_of(turned) == pairs_of(surface)
    at = np.cumsum(COUNTS) - COUNTS
    for k, (start, count) in enumerate(zip(at, COUNTS, strict=True)):
        old, new = CORNERS[start : start + count].tolist(), turned.corners[start : start + count].tolist()
        assert new == ([old[0], *old[:0:-1]] if mask[k] else old)


def test_one_object_of_a_file(tmp_path):
    """The polygons of an object would come with the texture coordinates or names of another."""
    more = ["o box", "usemtl tin", "g box sides"]
    more += [f"v {x} {y} {z}" for x, y, z in [[2, 0, 0], [2.1, 0, 0], [2.1, 0.1, 0], [2, 0.1, 0]]]
    more += ["vt 0.25 0.5", "vt 0.5 0.5", "vt 0.5 0.75", f"f {len(VERTICES) + 1}/-3 -3/-2 -2/-1 -1/-3"]
    garment = load(tmp_path, "\n".join(more), mesh="skirt")
    assert len(garment.surface.counts) == len(POLYGONS)
    assert [m.name for m in garment.surface.materials] == list(COLORS)
    garment.save(tmp_path / "a.obj")
    assert close(dressed.read_obj(tmp_path / "a.obj")[0], expected(VERTICES))
    box = wg.Garment.load(tmp_path / "skirt.obj", mesh="box")
    box.save(tmp_path / "b.obj")
    (found,), colors, (group,) = dressed.read_obj(tmp_path / "b.obj")
    assert ([uv for _, uv in found[0]], found[1]) == ([(0.25, 0.5), (0.5, 0.5), (0.5, 0.75), (0.25, 0.5)], "tin")
    assert (colors, group) == ({}, "box sides")


def test_several_objects_stay_several_and_are_read_back(tmp_path):
    """Names of objects would be lost, or a result of several could not be looked at any more."""
    more = (
        "o box\n" + "\n".join(f"v {x} {y} 0" for x, y in [[2, 0], [2.1, 0], [2.1, 0.1], [2, 0.1]]) + "\nf -4 -3 -2 -1"
    )
    garment = load(tmp_path, more, mesh="*")
    wg.GarmentMotion(garment.vertices[None], garment.faces, surface=garment.surface).save(tmp_path / "frames")
    text = (tmp_path / "frames" / "frame_0000.obj").read_text().splitlines()
    assert [line for line in text if line.startswith("o ")] == ["o skirt", "o box"]
    assert text.index("o box") == len(text) - 2 - sum(line.startswith(("g ", "usemtl ")) for line in text[-4:-1])
    assert len(wg.GarmentMotion.load(tmp_path / "frames", fps=30).vertices[0]) == len(VERTICES) + 4
    with pytest.raises(wg.MeshError, match="2 objects: skirt, box"):
        wg.BodyMotion.load(tmp_path / "frames")


def test_cleaning_keeps_the_polygons_that_it_does_not_drop(tmp_path):
    """Polygons would name vertices that are no more, or those be written that cleaning has said to drop."""
    more = [
        "v {} {} {}".format(*VERTICES[0]),
        "v 9 9 9",
        f"f {len(VERTICES) + 1}/1 2/2 14/3",  # where the first quad's half is
        f"f 1/1 2/2 {len(VERTICES) + 1}/3",  # of two corners, once the double is joined
    ]
    with pytest.warns(UserWarning, match="2 of 98 faces are dropped"):
        garment = load(tmp_path, "\n".join(more), clean=True)
    assert len(garment.vertices) == len(VERTICES) + 2  # all that were brought, in their order
    bare = wg.Garment.cleaned_from(garment.vertices, garment.faces, surface=garment.surface)
    assert len(bare.vertices) == len(VERTICES)
    for one in (garment, bare):
        one.save(tmp_path / "a.obj")
        assert close(dressed.read_obj(tmp_path / "a.obj")[0], expected(VERTICES))


def test_seams_that_are_joined_leave_the_polygons_of_the_file(tmp_path):
    """Panels that are simulated as one would come back with polygons that name other vertices than the file's."""
    with pytest.warns(UserWarning, match="joined"):
        garment = wg.Garment.load(dressed.write_panels(tmp_path / "skirt.obj"), clean=True)
    assert len(garment.vertices) == len(VERTICES) + dressed.RINGS
    assert len(garment.simulated.garment.vertices) == len(VERTICES)
    garment.save(tmp_path / "a.obj")
    assert close(dressed.read_obj(tmp_path / "a.obj")[0], expected(VERTICES))
    with pytest.warns(UserWarning, match="joined"):
        joined = garment.cleaned()
    assert len(joined.vertices) == len(VERTICES)
    joined.save(tmp_path / "b.obj")
    assert close(dressed.read_obj(tmp_path / "b.obj")[0], expected(VERTICES))
    np.testing.assert_array_equal(np.sort(joined.surface.corners), np.sort(CORNERS))


def test_what_cleaning_turns_round_is_turned_in_the_output(tmp_path):
    """Polygons would look inwards that the simulation and its normals have outwards; their coordinates would mix."""
    text = dressed.write_obj(tmp_path / "skirt.obj").read_text().splitlines()
    at = [k for k, line in enumerate(text) if line.startswith("f ")]
    for k in at[5::7]:
        text[k] = " ".join(["f", *reversed(text[k].split()[1:])])
    (tmp_path / "skirt.obj").write_text("\n".join(text))
    with pytest.warns(UserWarning, match="turned round"):
        garment = wg.Garment.load(tmp_path / "skirt.obj", clean=True)
    garment.save(tmp_path / "a.obj")

    def rolled(found: list) -> list:
        return [(corners[(k := corners.index(min(corners))) :] + corners[:k], name) for corners, name in found]

    assert rolled(dressed.read_obj(tmp_path / "a.obj")[0]) == rolled(expected(VERTICES))


def test_numbers_that_are_none_are_not_handed_on(tmp_path):
    """A NaN of a damaged file would be in outputs, where other programs stumble over it."""
    path = dressed.write_obj(tmp_path / "skirt.obj")
    library = tmp_path / "skirt.mtl"
    library.write_text(library.read_text().replace("Kd 0.2", "Kd nan").replace("d 1.0", "d 1e400"))
    garment = wg.Garment.load(path)
    assert [(m.color is None, m.opacity) for m in garment.surface.materials] == [(True, None), (False, None)]
    path.write_text(path.read_text().replace("vt 0.5 ", "vt inf "))
    with pytest.warns(UserWarning, match="5 of 65 texture coordinates are not finite"):
        assert wg.Garment.load(path).surface is None


def test_renumbering_drops_what_is_left_of_polygons():
    """Polygons with two corners left, or a vertex that was removed, would be written."""
    surface = Surface(
        [4, 3, 5, 3], [0, 1, 2, 3, 4, 5, 6, 0, 2, 4, 6, 7, 1, 3, 5],
        (Coordinates("", np.arange(30).reshape(15, 2), np.arange(15)),),
        (Material("a"), Material("b")), [0, 1, 0, 1], groups=Labels(("p", "q"), [1, 1, 0, -1]),
    )  # fmt: skip
    new = np.array([0, 0, 1, 2, 3, 3, 4, 5])  # 0 and 1 are joined, 4 and 5 too
    left = surface.renumbered(new)
    assert left.counts.tolist() == [3, 5, 3]
    assert left.corners.tolist() == [0, 1, 2, 0, 1, 3, 4, 5, 0, 2, 3]
    assert left.coordinates[0].corners.tolist() == [0, 2, 3, 7, 8, 9, 10, 11, 12, 13, 14]
    assert (left.material.tolist(), left.groups.of_polygon.tolist()) == ([0, 0, 1], [1, 0, -1])
    assert surface.renumbered(np.where(new == 1, -1, new)).counts.tolist() == [3]
    assert surface.renumbered(np.zeros(8, int)) is None


WRONG = {
    "counts below three": {"counts": [2, 4]},
    "counts that do not add up": {"counts": [3, 4]},
    "a vertex below zero": {"corners": [0, 1, 2, 0, 2, -1]},
    "fractions": {"corners": np.arange(6) / 2},
    "coordinates beyond the last": {"coordinates": (Coordinates("", np.zeros((5, 2)), np.arange(6)),)},
    "coordinates of fewer corners": {"coordinates": (Coordinates("", np.zeros((9, 2)), np.arange(5)),)},
    "coordinates that are no pairs": {"coordinates": (Coordinates("", np.zeros((9, 3)), np.arange(6)),)},
    "a material that is not there": {"material": [0, 1], "materials": (Material("a"),)},
    "a group that is not there": {"groups": Labels(("a",), [0, 3])},
    "groups of other polygons": {"groups": Labels(("a",), [0, 0, 0])},
}


@pytest.mark.parametrize("kind", WRONG)
def test_indices_are_checked(kind):
    """A writer would read beyond an array, or take corners from its end."""
    with pytest.raises(wg.MeshError):
        Surface(**{"counts": [3, 3], "corners": [0, 1, 2, 0, 2, 3], **WRONG[kind]})


@pytest.mark.parametrize("face", ["1/999 2/1", "1/-999 2/1", "1/x 2/1", "1/99999999999999999999 2/1", "vt a b", "vt"])
def test_damaged_looks_of_obj_are_left_out_aloud(tmp_path, face):
    """A garment would be refused for looks that it is not simulated by, or its looks dropped in silence."""
    path = dressed.write_obj(tmp_path / "skirt.obj")
    rows = path.read_text().splitlines()
    if face.startswith("vt"):
        rows.insert(3, face)
    else:
        first = next(k for k, row in enumerate(rows) if row.startswith("f "))
        rows[first] = f"f {face} 14/1 13/1"
    path.write_text("\n".join(rows))
    with pytest.warns(UserWarning, match="texture coordinates, materials and groups will not be in outputs"):
        garment = wg.Garment.load(path)
    assert garment.surface is None
    np.testing.assert_array_equal(garment.vertices, VERTICES)


def test_damaged_looks_of_other_formats_are_left_out_aloud(tmp_path):
    """The same for USD, glTF and npz, whose damaged numbers would end in another library's error."""
    from pxr import Usd, UsdGeom

    garment = load(tmp_path)
    for name in ("m.usda", "m.glb", "m.npz"):
        garment.save(tmp_path / name)
    stage = Usd.Stage.Open(str(tmp_path / "m.usda"))
    mesh = next(UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").SetIndices([0, 1, 10**6] * 60)
    stage.Save()
    data = (tmp_path / "m.glb").read_bytes()
    (tmp_path / "m.glb").write_bytes(data.replace(b'"TEXCOORD_0": 1', b'"TEXCOORD_0": 9'))
    with np.load(tmp_path / "m.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "m.npz", **{**arrays, "surface_corners": arrays["surface_corners"] + 10})
    for name in ("m.usda", "m.glb", "m.npz"):
        with pytest.warns(UserWarning, match="will not be in outputs, as they are damaged"):
            found = wg.Garment.load(tmp_path / name)
        assert (found.surface, len(found.faces)) == (None, len(garment.faces))
    np.savez(tmp_path / "m.npz", **{k: v for k, v in arrays.items() if k != "surface_uv0"})
    with pytest.warns(UserWarning, match="will not be in outputs, as they are damaged"):
        assert wg.Garment.load(tmp_path / "m.npz").surface is None


def test_libraries_outside_the_folder_are_not_read(tmp_path):
    """A file could make us read other files of its user, or wait for a pipe for ever."""
    (tmp_path / "in").mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl denim\nKd 1 0 0\n")
    os.mkfifo(tmp_path / "in" / "pipe.mtl")
    for name in ("../secret.mtl", str(tmp_path / "secret.mtl"), "pipe.mtl", "none.mtl", ".", "x" * 5000):
        path = dressed.write_obj(tmp_path / "in" / "skirt.obj", library=False)
        path.write_text(path.read_text().replace("mtllib skirt.mtl", f"mtllib {name}"))
        assert [m.color for m in wg.Garment.load(path).surface.materials] == [None, None]


def test_pictures_are_named_from_where_the_output_is(tmp_path):
    """A texture would not be found any more, as its name is relative to the folder of the input."""
    (tmp_path / "in" / "tex").mkdir(parents=True)
    (tmp_path / "in" / "tex" / "blue jeans.png").write_bytes(b"png")
    path = dressed.write_obj(tmp_path / "in" / "skirt.obj")
    library = path.with_suffix(".mtl")
    library.write_text(library.read_text() + "\nmap_Kd -s 2 2 1 tex/blue jeans.png\nmap_Kd none/there.png\n"
                       "newmtl denim\nKd 0.2 0.3 0.6\nmap_Kd -clamp on tex\\blue jeans.png\n")  # fmt: skip
    garment = wg.Garment.load(path)
    (tmp_path / "a" / "b").mkdir(parents=True)
    for name in ("m.obj", "m.usda", "m.gltf"):
        garment.save(tmp_path / "a" / "b" / name)
    text = (tmp_path / "a" / "b" / "m.mtl").read_text()
    assert "map_Kd ../../in/tex/blue jeans.png" in text
    assert "map_Kd none/there.png" in text
    assert "@../../in/tex/blue jeans.png@" in (tmp_path / "a" / "b" / "m.usda").read_text()
    assert '"uri": "../../in/tex/blue%20jeans.png"' in (tmp_path / "a" / "b" / "m.gltf").read_text()
    for name in ("m.obj", "m.usda", "m.gltf"):
        again = wg.Garment.load(tmp_path / "a" / "b" / name).surface.materials
        assert {m.name: m.texture for m in again}["denim"] == str(tmp_path / "in" / "tex" / "blue jeans.png")


def test_a_library_of_somebody_else_stays(tmp_path):
    """Saving x.obj would replace the x.mtl from which it came, with less in it."""
    garment = load(tmp_path)
    before = (tmp_path / "skirt.mtl").read_bytes()
    for _ in range(2):
        garment.save(tmp_path / "skirt.obj")
    assert (tmp_path / "skirt.mtl").read_bytes() == before
    assert (tmp_path / "skirt_1.mtl").read_text().startswith(OURS)
    assert {p.name for p in tmp_path.iterdir()} == {"skirt.obj", "skirt.mtl", "skirt_1.mtl"}
    assert dressed.read_obj(tmp_path / "skirt.obj")[1].keys() == COLORS.keys()
    motion = wg.GarmentMotion(VERTICES[None], garment.faces, surface=garment.surface)
    motion.save(tmp_path / "frames")
    motion.save(tmp_path / "frames")  # an old result, its library included, is replaced
    (tmp_path / "frames" / "other.mtl").write_text("")
    with pytest.raises(FileExistsError, match=r"other\.mtl"):
        motion.save(tmp_path / "frames")


def test_what_a_format_leaves_out_is_said_once(tmp_path):
    """Texture coordinates would go without a word, or with a word for every frame."""
    garment = load(tmp_path)
    surface = garment.surface
    second = Coordinates("second", UV, surface.coordinates[0].corners)
    two = Surface(surface.counts, surface.corners, (*surface.coordinates, second), surface.materials, surface.material,
                  surface.objects, surface.groups)  # fmt: skip
    frames = np.repeat(VERTICES[None], 5, 0)
    motion = wg.GarmentMotion(frames, garment.faces, surface=two)
    assert heard(lambda: motion.save(tmp_path / "m.usda")) == []
    assert heard(lambda: motion.save(tmp_path / "m.npz")) == []
    for name in ("frames", "m.pc2"):
        said = heard(lambda name=name: motion.save(tmp_path / name))
        assert said == [f"{tmp_path / name}: left out: all but 1 of 2 sets of texture coordinates."]
    assert heard(lambda: motion.save(tmp_path / "m.glb")) == [f"{tmp_path / 'm.glb'}: left out: groups."]
    lost = "texture coordinates, materials, groups; polygons became triangles"
    assert heard(lambda: garment.save(tmp_path / "m.ply")) == [f"{tmp_path / 'm.ply'}: left out: {lost}."]
    plain = wg.Garment(garment.vertices, garment.faces)
    for name in ("p.ply", "p.obj", "p.glb", "p.usda", "p.npz"):
        assert heard(lambda name=name: plain.save(tmp_path / name)) == []
        assert wg.Garment.load(tmp_path / name).surface is None or name in ("p.obj", "p.glb")
    again = wg.GarmentMotion.load(tmp_path / "m.npz").surface
    assert [one.name for one in again.coordinates] == ["", "second"]


def test_frames_that_are_not_finite(tmp_path):
    """A rollout that failed could not be written as glTF, which has no NaN, and would be lost."""
    garment = load(tmp_path)
    frames = np.repeat(VERTICES[None], 4, 0) + np.arange(4, dtype=np.float32)[:, None, None] * 0.01
    frames[2:] = np.nan
    motion = wg.GarmentMotion(frames, garment.faces)
    with pytest.warns(UserWarning, match=r"2 of 4 frames are not finite \(first: frame 2\)"):
        motion.save(tmp_path / "m.glb")
    np.testing.assert_allclose(wg.BodyMotion.load(tmp_path / "m.glb").vertices[3], frames[1], atol=1e-7)
