"""If these failed, an Alembic file would show other positions, sides or times in the programs of others, or a file of
theirs be read otherwise than Alembic's own library has it."""

from __future__ import annotations

import gc
import os
import subprocess
import sys

import imath
import numpy as np
import pytest
from alembic3d import Abc, AbcCoreAbstract, AbcGeom
from support.dressed import COUNTS, POLYGONS, UV, write_obj
from support.meshes import capsule

import warpgarment as wg
from warpgarment.cli import main
from warpgarment.io.together import write_together

BODY = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2)
FRAMES = BODY.vertices + np.arange(25, dtype=np.float32)[:, None, None] * np.float32([0, 0, 0.01])


def opened(path):
    archive = Abc.IArchive(str(path))
    return AbcGeom.IPolyMesh(archive.getTop(), archive.getTop().getChildHeader(0).getName()).getSchema()


def written(path, frames=FRAMES, fps=24.0, start=0.0, turns=(), faces=BODY.faces, names=("cloth",), inherit=True):
    """An archive by Alembic itself, of meshes below a transform for each of some lists of matrices."""
    archive = Abc.OArchive(str(path))
    sampling = AbcCoreAbstract.TimeSampling(1 / fps, start)
    index, parent = archive.addTimeSampling(sampling), archive.getTop()
    for k, matrices in enumerate(turns):
        parent = AbcGeom.OXform(parent, f"node{k}")
        schema = parent.getSchema()
        schema.setTimeSampling(index)
        for matrix in matrices:
            sample = AbcGeom.XformSample()
            sample.setInheritsXforms(inherit)
            sample.setMatrix(imath.M44d(*matrix.reshape(-1).tolist()))
            schema.set(sample)
    for name in names:
        schema = AbcGeom.OPolyMesh(parent, name).getSchema()
        schema.setTimeSampling(index)
        clockwise = np.ascontiguousarray(np.asarray(faces)[:, [0, 2, 1]].reshape(-1), dtype=np.int32)
        arrays = imath.IntArrayFromBuffer(clockwise), imath.IntArrayFromBuffer(np.full(len(faces), 3, np.int32))
        for points in frames:
            schema.set(AbcGeom.OPolyMeshSchemaSample(imath.V3fArrayFromBuffer(np.ascontiguousarray(points)), *arrays))
    del schema, parent, archive
    gc.collect()
    return path


def test_alembic_reads_what_is_written(tmp_path):
    """Alembic would have other positions, times, polygons or texture coordinates: every frame, by its own library, the
    polygons clockwise as it wants them."""
    garment = wg.Garment.load(write_obj(tmp_path / "skirt.obj"))
    frames = garment.vertices + np.arange(5, dtype=np.float32)[:, None, None] * np.float32([0, 0.01, 0])
    motion = wg.GarmentMotion(frames, garment.faces, 24, start=1001 / 24, name="my/skirt", surface=garment.surface)
    with pytest.warns(UserWarning, match="left out: groups, colours and pictures of materials"):
        motion.save(tmp_path / "m.abc")
    schema = opened(tmp_path / "m.abc")
    assert schema.getNumSamples() == 5
    times = [schema.getTimeSampling().getSampleTime(k) for k in range(5)]
    np.testing.assert_allclose(times, np.arange(1001, 1006) / 24, rtol=0, atol=1e-12)
    for k in range(5):
        np.testing.assert_array_equal(np.array(schema.getValue(k).getPositions()), frames[k])
    value = schema.getValue(4)
    np.testing.assert_array_equal(np.array(value.getFaceCounts()), COUNTS)
    ends = np.cumsum(COUNTS)
    corners = np.split(np.array(value.getFaceIndices()), ends[:-1])
    pairs = np.array(schema.getUVsParam().getExpandedValue(0).getVals())
    for polygon, found, uv in zip(POLYGONS, corners, np.split(pairs, ends[:-1]), strict=True):
        back = [polygon.vertices[0], *polygon.vertices[:0:-1]]
        assert found.tolist() == back
        order = [polygon.coordinates[0], *polygon.coordinates[:0:-1]]
        np.testing.assert_array_equal(uv, UV[order])
    back = wg.GarmentMotion.load(tmp_path / "m.abc").surface
    assert back.coordinates[0].values.shape == UV.shape
    assert [back.materials[k].name for k in back.material] == [polygon.material for polygon in POLYGONS]


def test_several_meshes_have_their_names_and_materials(tmp_path):
    """Garments would lie in one mesh, two of one name be lost, or a program assign no material: by Alembic's own
    library, meshes by name, every frame, and sets of faces by the names of materials."""
    garment = wg.Garment.load(write_obj(tmp_path / "skirt.obj"))
    skirts = garment.vertices + np.arange(25, dtype=np.float32)[:, None, None] * np.float32([0, 0.01, 0])
    meshes = [("skirt", skirts, garment.faces), ("a/b", FRAMES, BODY.faces), ("skirt", FRAMES + 1, BODY.faces)]
    with pytest.warns(UserWarning, match="left out: groups, colours and pictures of materials"):
        write_together(tmp_path / "m.abc", meshes, 24, [garment.surface, None, None], start=1001)
    top = Abc.IArchive(str(tmp_path / "m.abc")).getTop()
    names = [top.getChildHeader(k).getName() for k in range(top.getNumChildren())]
    assert names == ["skirt", "a_b", "skirt_2"]
    for name, (_, frames, _) in zip(names, meshes, strict=True):
        schema = AbcGeom.IPolyMesh(top, name).getSchema()
        assert schema.getNumSamples() == 25
        for k in (0, 7, 24):
            value = schema.getValue(Abc.ISampleSelector((1001 + k) / 24))  # a number is a time [s]
            np.testing.assert_array_equal(np.array(value.getPositions()), frames[k])
    schema = AbcGeom.IPolyMesh(top, "skirt").getSchema()
    assert sorted(schema.getFaceSetNames()) == sorted({polygon.material for polygon in POLYGONS})
    for name in schema.getFaceSetNames():
        faces = schema.getFaceSet(name).getSchema().getValue(0).getFaces()
        assert list(faces) == [k for k, polygon in enumerate(POLYGONS) if polygon.material == name]
    assert len(AbcGeom.IPolyMesh(top, "a_b").getSchema().getFaceSetNames()) == 0
    corners = np.array(AbcGeom.IPolyMesh(top, "skirt_2").getSchema().getValue(0).getFaceIndices()).reshape(-1, 3)
    np.testing.assert_array_equal(corners[:, [0, 2, 1]], BODY.faces)
    back = wg.GarmentMotion.load(tmp_path / "m.abc", mesh="skirt").surface
    assert [back.materials[k].name for k in back.material] == [polygon.material for polygon in POLYGONS]
    with pytest.raises(wg.MeshError, match="5 and 25 frames"):
        write_together(tmp_path / "n.abc", [meshes[0], ("b", FRAMES[:5], BODY.faces)], 24, [None, None])
    assert not (tmp_path / "n.abc").exists()


def test_sets_of_faces_that_overlap_are_no_materials(tmp_path):
    """A selection that somebody kept in a file would become a material. None is read where sets overlap; one that
    names faces that are not there leaves the mesh as it is."""
    for overlapping in (True, False):
        path = tmp_path / f"{overlapping}.abc"
        archive = Abc.OArchive(str(path))
        schema = AbcGeom.OPolyMesh(archive.getTop(), "m").getSchema()
        faces = imath.IntArrayFromBuffer(np.ascontiguousarray(BODY.faces.reshape(-1), dtype=np.int32))
        counts = imath.IntArrayFromBuffer(np.full(len(BODY.faces), 3, np.int32))
        schema.set(AbcGeom.OPolyMeshSchemaSample(imath.V3fArrayFromBuffer(FRAMES[0]), faces, counts))
        for name, rows in (("a", [0, 1, 2]), ("b", [2, 3] if overlapping else [10**6])):
            sample = AbcGeom.OFaceSetSchemaSample()
            sample.setFaces(imath.IntArrayFromBuffer(np.array(rows, np.int32)))
            schema.createFaceSet(name).getSchema().set(sample)
        del schema, archive
        gc.collect()
        if overlapping:
            garment = wg.Garment.load(path)
        else:
            with pytest.warns(UserWarning, match="names polygons beyond"):
                garment = wg.Garment.load(path)
        assert garment.surface is None or not garment.surface.materials
        assert len(garment.faces) == len(BODY.faces)


@pytest.mark.parametrize("fps", [24000 / 1001, 24, 25, 30, 60, 23.976])
def test_times_are_the_frames(tmp_path, fps):
    """Rate and start would be off, so that frame 1001 of a shot is another one."""
    body = wg.BodyMotion.load(written(tmp_path / "m.abc", fps=fps, start=1001 / fps))
    assert body.fps == pytest.approx(fps, rel=2e-6)
    assert body.clock.number == 1001
    np.testing.assert_array_equal(body.vertices, FRAMES)
    np.testing.assert_array_equal(body.faces, BODY.faces)
    again = tmp_path / "again.abc"
    body.save(again)
    back = wg.BodyMotion.load(again)
    assert (back.fps, back.start) == (body.fps, body.start)
    np.testing.assert_array_equal(back.vertices, FRAMES)
    np.testing.assert_array_equal(back.faces, BODY.faces)


def turned(angle, move, scale=1.0):
    """A matrix for rows: scaled, turned about Y, moved."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    matrix[3, :3] = move
    return matrix


def test_transforms_move_the_mesh(tmp_path):
    """A mesh that hangs below moving nodes would stand still, or be moved in another order: by hand, to 1e-6 m."""
    outer = [turned(0.1 * k, (0.02 * k, 0, 1)) for k in range(25)]
    inner = [turned(-0.05, (0, 0.1, 0), 1.5)]
    body = wg.BodyMotion.load(written(tmp_path / "m.abc", FRAMES[:1], turns=(outer, inner), start=2.0))
    assert (body.frames, body.fps, body.start) == (25, 24, 2)
    for k in range(25):
        local = np.c_[FRAMES[0], np.ones(len(FRAMES[0]))] @ inner[0]
        np.testing.assert_allclose(body.vertices[k], (local @ outer[k])[:, :3], atol=1e-6)
    both = wg.BodyMotion.load(written(tmp_path / "m.abc", turns=(outer,)))
    for k in (0, 7, 24):
        world = (np.c_[FRAMES[k], np.ones(len(FRAMES[k]))] @ outer[k])[:, :3]
        np.testing.assert_allclose(both.vertices[k], world, atol=1e-6)
    free = wg.BodyMotion.load(written(tmp_path / "m.abc", FRAMES[:1], turns=(outer, inner), inherit=False))
    np.testing.assert_allclose(
        free.vertices[0], (np.c_[FRAMES[0], np.ones(len(FRAMES[0]))] @ inner[0])[:, :3], atol=1e-6
    )


def test_mirrored_meshes_look_outwards(tmp_path):
    """The other half of a mirrored pair would be inside out."""
    mirror = np.diag([-1.0, 1, 1, 1])
    path = written(tmp_path / "m.abc", FRAMES[:1], turns=([mirror],))
    garment = wg.Garment.load(path)
    a, b, c = (garment.vertices[garment.faces[:, k]].astype(float) for k in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0  # six times the volume


def test_meshes_are_named(tmp_path, capsys):
    """One of several meshes would be taken at random."""
    path = written(tmp_path / "m.abc", names=("shirt", "coat"), turns=([np.eye(4)],))
    with pytest.raises(wg.MeshError, match=r"m\.abc: 2 meshes: /node0/shirt, /node0/coat\. Name one with mesh="):
        wg.BodyMotion.load(path)
    assert wg.BodyMotion.load(path, mesh="coat").frames == 25
    assert wg.Garment.load(path, mesh="/node0/shirt").name == "shirt"
    with pytest.raises(wg.MeshError, match="0 meshes named 'hat'"):
        wg.Garment.load(path, mesh="hat")
    assert main(["info", str(path)]) == 0
    assert "coat" in capsys.readouterr().out


def test_faces_that_change_are_refused(tmp_path):
    """Positions of one topology would be joined by the faces of another."""
    archive = Abc.OArchive(str(tmp_path / "m.abc"))
    schema = AbcGeom.OPolyMesh(archive.getTop(), "m").getSchema()
    points = imath.V3fArrayFromBuffer(FRAMES[0])
    for count in (100, 99):
        faces = imath.IntArrayFromBuffer(np.ascontiguousarray(BODY.faces[:count].reshape(-1), dtype=np.int32))
        schema.set(AbcGeom.OPolyMeshSchemaSample(points, faces, imath.IntArrayFromBuffer(np.full(count, 3, np.int32))))
    del schema, archive
    gc.collect()
    with pytest.raises(wg.MeshError, match=r"its faces change with time \(first: sample 1\)"):
        wg.BodyMotion.load(tmp_path / "m.abc")


def test_damaged_trees_are_refused_before_alembic_looks(tmp_path):
    """A place outside the file, or a group that holds itself, would crash or hang the library: every place in the file
    is replaced in turn. Nothing but an error that names the file, or what is in a sound one, may come."""
    path = written(tmp_path / "m.abc", FRAMES[:2, :], faces=BODY.faces)
    data = path.read_bytes()
    words = [
        k for k in range(8, len(data) - 8) if 16 <= int.from_bytes(data[k : k + 8], "little") & ~(1 << 63) < len(data)
    ]
    for k in words[:: max(1, len(words) // 40)]:
        for value in (len(data), 2**62, (1 << 63) | (len(data) - 4), int.from_bytes(data[8:16], "little")):
            (tmp_path / "d.abc").write_bytes(data[:k] + value.to_bytes(8, "little") + data[k + 8 :])
            unnamed = ""
            try:
                wg.BodyMotion.load(tmp_path / "d.abc", fps=24)
            except wg.MeshError as error:
                unnamed = "" if "d.abc" in str(error) else str(error)
            assert not unnamed


@pytest.mark.parametrize("content", [b"\x89HDF\r\n\x1a\n" + bytes(100), b"Ogawa\0" + bytes(100)])
def test_other_kinds_say_what_to_do(tmp_path, content):
    """The user of an old exporter, or of a file that was cut off, would learn nothing."""
    (tmp_path / "m.abc").write_bytes(content)
    with pytest.raises(wg.MeshError, match=r"export it as Ogawa|not written to its end. Export it again"):
        wg.BodyMotion.load(tmp_path / "m.abc")


def test_a_missing_extra_is_named(tmp_path):
    """Without alembic3d, the remedy would be a traceback."""
    code = (
        "import sys; sys.modules['alembic3d'] = None; from warpgarment.cli import main;"
        f"sys.exit(main(['convert', {str(tmp_path / 'a.npz')!r}, {str(tmp_path / 'b.abc')!r}]))"
    )
    wg.BodyMotion(FRAMES, BODY.faces).save(tmp_path / "a.npz")
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ)
    assert ran.returncode == 2
    assert 'pip install "warpgarment[alembic]"' in ran.stderr
