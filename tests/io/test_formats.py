"""If these failed for a format, what is written would not be read, or a damaged file would end in another library's
error, or worse as half a mesh. Every entry of `FORMATS` is tried; one that is added needs a line in `DAMAGE`."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path

import numpy as np
import pytest
import trimesh

import warpgarment as wg
from warpgarment.io.data import MeshData, MotionData
from warpgarment.io.files import FORMATS, format_of, read_mesh, read_motion, suffixes, write_mesh, write_motion

EVERY = [suffix for every in FORMATS for suffix in every]
BONES = [".bvh"]  # motions that hold no positions: tests/bodies
MESHES, MOTIONS = suffixes("read_mesh"), [suffix for suffix in suffixes("read_motion") if suffix not in BONES]
OF_POSITIONS = [suffix for suffix in EVERY if suffix not in BONES]
ball = trimesh.creation.icosphere(1)
FACES = np.array(ball.faces)
REST = (np.array(ball.vertices) / 3 + [0, 1, 0]).astype(np.float32)  # thirds: no round numbers in a text
FRAMES = (REST + np.random.default_rng(0).normal(0, 0.01, (3, *REST.shape))).astype(np.float32)
GLTF = (".glb", ".gltf")
TEXT = (".obj", "")  # formats that do not say how much is to come: cut at a line's end, they are whole


def made(path: Path, motion: bool, vertices: np.ndarray = FRAMES) -> Path:
    """A file of the ball; formats that this package does not write are written by others."""
    suffix = path.suffix
    whole = np.isfinite(vertices).all() or suffix not in GLTF  # this package writes no glTF with NaN in it
    if whole and motion and suffix in suffixes("write_motion"):
        write_motion(path, MotionData(vertices, FACES, 24.0))
    elif whole and suffix in suffixes("write_mesh"):
        write_mesh(path, MeshData(vertices[0], FACES))
    elif suffix == ".usdz":
        from pxr import Sdf, UsdUtils

        inner = made(path.with_suffix(".usdc"), motion, vertices)
        assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(inner)), str(path))
        inner.unlink()
    elif suffix == ".gltf":
        files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.Trimesh(vertices[0], FACES, process=False)))
        for name, content in files.items():
            (path if name == "model.gltf" else path.with_name(name)).write_bytes(content)
    else:
        trimesh.Trimesh(vertices[0], FACES, process=False).export(path)
    return path


def loaded(path: Path, motion: bool) -> np.ndarray:
    """Vertices of the object that is made of a file, [T,V,3]."""
    return wg.BodyMotion.load(path).vertices if motion else wg.Garment.load(path).vertices[None]


def one(path: Path) -> Path:
    """The file itself, or one from the middle of a folder."""
    return sorted(path.iterdir())[1] if path.is_dir() else path


@pytest.mark.parametrize("suffix", EVERY)
def test_an_entry_names_a_format_whose_extra_exists(suffix):
    """A suffix would be offered that nothing reads, or whose remedy cannot be installed."""
    format = format_of(suffix)
    assert format.read_mesh or format.read_motion
    assert format.extra in (None, *metadata.metadata("warpgarment").get_all("Provides-Extra"))
    assert set(format.only_read) <= {s for every in FORMATS if suffix in every for s in every}
    assert EVERY.count(suffix) == 1
    assert format.bones == (suffix in BONES)


def test_asking_for_formats_imports_no_extra():
    """A message about suffixes, or `--help`, would need USD, or wait for trimesh."""
    code = (
        "import sys; from warpgarment.io import files; files.suffixes('read_motion');"
        "sys.exit(bool({'pxr', 'trimesh', 'torch', 'warp'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize("suffix", MESHES)
def test_a_mesh_comes_back(tmp_path, suffix):
    """Vertices would be moved, reordered or split on the way through a file."""
    found = read_mesh(made(tmp_path / f"m{suffix}", motion=False))
    corners = np.asarray(found.vertices)[np.asarray(found.faces)]
    if suffix == ".stl":  # repeats vertices: in the order of the faces
        np.testing.assert_array_equal(corners, FRAMES[0][FACES])
    elif suffix == ".off":  # trimesh writes ten decimals
        np.testing.assert_allclose(found.vertices, FRAMES[0], atol=1e-7)
        np.testing.assert_array_equal(found.faces, FACES)
    else:
        np.testing.assert_array_equal(found.vertices, FRAMES[0])
        np.testing.assert_array_equal(found.faces, FACES)


@pytest.mark.parametrize("suffix", MOTIONS)
def test_a_motion_comes_back(tmp_path, suffix):
    """Frames would be lost, in another order, or at another rate."""
    found = read_motion(made(tmp_path / f"m{suffix}", motion=True))
    whole = suffix in suffixes("write_motion") or suffix == ".usdz"
    expected = FRAMES if whole else FRAMES[:1]
    corners = np.asarray(found.vertices)[:, np.asarray(found.faces)]
    # trimesh writes ten decimals of OFF; glTF has differences to the first frame, rounded to float32
    atol = {".off": 1e-7, ".glb": 4e-9, ".gltf": 4e-9}.get(suffix, 0)
    np.testing.assert_allclose(corners, expected[:, FACES], rtol=0, atol=atol)
    assert found.fps in ((24.0, None) if whole else (None,))


@pytest.mark.parametrize(
    ("suffix", "motion"), [*((suffix, False) for suffix in MESHES), *((suffix, True) for suffix in MOTIONS)]
)
def test_a_file_cut_short_is_refused(tmp_path, suffix, motion):
    """Half a download would be read as half a mesh, or end in an error of another library: cut at 60 places."""
    path = made(tmp_path / f"m{suffix}", motion)
    whole, file = loaded(path, motion), one(path)
    data = file.read_bytes()
    size = data.index(b"\nf ") if suffix in TEXT else len(data)
    for end in sorted({*np.linspace(0, size - 1, 58).astype(int).tolist(), size - 1, 1}):
        file.write_bytes(data[:end])
        try:
            found = loaded(path, motion)
        except wg.MeshError as error:
            unnamed = str(path) not in str(error)
        else:  # what was lost was the last line's end, or zeros that fill a block
            unnamed = False
            np.testing.assert_array_equal(found, whole, err_msg=f"{end} of {len(data)} bytes")
        assert not unnamed


def replaced(pattern: bytes, by: bytes):
    def damage(path: Path) -> None:
        file = one(path)
        data, count = re.subn(pattern, by, file.read_bytes(), count=1, flags=re.DOTALL)
        assert count == 1
        file.write_bytes(data)

    return damage


def archive(path: Path) -> None:
    with np.load(path) as found:
        arrays = dict(found)
    np.savez(path, **{**arrays, "vertices": arrays["vertices"][..., :-1, :]})


def stage(path: Path) -> None:
    from pxr import Usd, UsdGeom

    opened = Usd.Stage.Open(str(path))
    mesh = next(UsdGeom.Mesh(p) for p in opened.Traverse() if p.IsA(UsdGeom.Mesh))
    mesh.GetFaceVertexCountsAttr().Set([3] * 79 + [4])
    opened.Save()


def package(path: Path) -> None:
    """A stage is not changed inside a package: change it, then pack it."""
    from pxr import Sdf, UsdUtils

    inner = made(path.with_suffix(".usdc"), motion=True)
    stage(inner)
    path.unlink()
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(inner)), str(path))


def beyond(path: Path) -> None:
    """An archive of the same mesh, one of whose faces names a vertex that is not there: made by Alembic itself."""
    import gc

    import imath
    from alembic3d import Abc, AbcGeom

    corners = np.append(FACES[:, ::-1].reshape(-1)[:-1], len(REST)).astype(np.int32)
    arrays = imath.IntArrayFromBuffer(corners), imath.IntArrayFromBuffer(np.full(80, 3, np.int32))
    archive = Abc.OArchive(str(path))
    schema = AbcGeom.OPolyMesh(archive.getTop(), "m").getSchema()
    schema.set(AbcGeom.OPolyMeshSchemaSample(imath.V3fArrayFromBuffer(REST), *arrays))
    del archive, schema
    gc.collect()


DAMAGE = {  # what makes the counts in a file disagree with what it holds
    ".obj": replaced(rb"v [^\n]*\n", b""),
    ".ply": replaced(rb"element vertex 42", b"element vertex 41"),
    ".npz": archive,
    ".off": replaced(rb"\n42 80", b"\n43 80"),
    ".stl": replaced(rb"^(.{80})....", b"\\1\x51\0\0\0"),
    ".glb": replaced(rb'"count": ?42', b'"count":99'),
    ".gltf": replaced(rb'"count": ?42', b'"count":99'),
    ".usd": stage,
    ".usda": stage,
    ".usdc": stage,
    ".usdz": package,
    ".pc2": replaced(rb"^(POINTCACHE2\0....)....", b"\\1\x29\0\0\0"),
    ".abc": beyond,
    ".mdd": replaced(rb"^(....)....", b"\\1\0\0\0\x29"),
    "": replaced(rb"v [^\n]*\n", b""),
}


@pytest.mark.parametrize("suffix", OF_POSITIONS)
def test_counts_that_do_not_fit_are_refused(tmp_path, suffix):
    """A vertex or face more or less than there are would shift everything after it."""
    path = made(tmp_path / f"m{suffix}", motion=True)
    DAMAGE[suffix](path)
    for motion in (True, False):
        if suffix in (MOTIONS if motion else MESHES):
            with pytest.raises(wg.MeshError, match=re.escape(str(path))):
                loaded(path, motion)


@pytest.mark.parametrize("suffix", OF_POSITIONS)
def test_positions_that_are_not_finite_are_refused(tmp_path, suffix):
    """NaN would reach the solvers."""
    broken = FRAMES.copy()
    broken[:, 7] = np.nan
    path = made(tmp_path / f"m{suffix}", True, broken)
    for motion in (True, False):
        if suffix in (MOTIONS if motion else MESHES):
            with pytest.raises(wg.MeshError, match=re.escape(str(path))):
                loaded(path, motion)


@pytest.mark.parametrize("suffix", OF_POSITIONS)
def test_files_of_another_kind_are_refused(tmp_path, suffix):
    """Text, noise, nothing, or another format's file under this name would end in another library's error."""
    path = made(tmp_path / f"m{suffix}", motion=True)
    file = one(path)
    for content in (b"not a mesh at all\n" * 20, bytes(range(256)) * 4, b"", b"\0" * 4096):
        file.write_bytes(content)
        for motion in (True, False):
            if suffix in (MOTIONS if motion else MESHES):
                with pytest.raises(wg.MeshError, match=re.escape(str(path))):
                    loaded(path, motion)


def test_messages_name_the_formats_there_are(tmp_path):
    """The user would not learn what can be read or written, or be sent to a format that cannot be."""
    (tmp_path / "a.xyz").write_text("1 2 3")
    (tmp_path / "bare").write_text("1 2 3")
    for name in ("a.xyz", "bare"):
        with pytest.raises(wg.MeshError, match=r"\.npz.*\.usdz.*\.pc2, \.mdd, \.bvh or a folder"):
            wg.BodyMotion.load(tmp_path / name)
        with pytest.raises(wg.MeshError, match=r"\.obj, \.ply, \.off, \.npz.* or \.usdz\.$"):
            wg.Garment.load(tmp_path / name)
    with pytest.raises(
        ValueError, match=r"cannot write \.usdz; use \.npz, \.glb, \.gltf, \.abc, \.usd, .*\.pc2, \.mdd or a folder"
    ):
        wg.BodyMotion(FRAMES, FACES).save(tmp_path / "a.usdz")
    with pytest.raises(ValueError, match=r"cannot write \.stl; use \.obj, \.ply, \.npz, \.glb, \.gltf, .* or \.usdc"):
        wg.Garment(REST, FACES).save(tmp_path / "a.stl")
    with pytest.raises(FileNotFoundError):
        wg.BodyMotion.load(tmp_path / "none.obj")


@pytest.mark.parametrize("verb", ["shot", "convert", "view"])
def test_help_names_no_format_that_is_not_there(verb):
    """The command line would promise a format that no module reads."""
    options = Path(import_module(f"warpgarment.cli.{verb}").__file__).read_text()
    options = re.split("def run|class Checked", options)[0]
    named = set(re.findall(r"\.[a-z0-9]{3,4}\b(?=[,;:)\s])", options)) - {
        ".body",
        ".data",
        ".view",
        ".wind",
    }  # modules that are imported
    assert {".npz", ".usd", ".pc2", ".obj"} <= named
    others = {".csv", ".json"} if verb == "shot" else set()  # of winds and materials
    assert named <= {*EVERY, ".mp4", ".png", *others}
