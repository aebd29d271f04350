"""If these failed, broken meshes would reach the solvers, or files would come in with vertices split, lost or moved."""

import re

import igl
import numpy as np
import pytest
import torch
import trimesh

import warpgarment as wg
from warpgarment.io.polygons import triangulate_counts


def grid(columns=6, rows=4):
    """A flat, open, consistently oriented sheet."""
    x, y = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 0.7, rows + 1), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    a = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    b = a + rows + 1
    return vertices.astype(np.float32), np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])


def sphere():
    mesh = trimesh.creation.icosphere(1)
    return np.array(mesh.vertices, dtype=np.float32), np.array(mesh.faces)


def test_what_is_given_comes_back():
    """A change of order, type or value would shift every per-vertex array a user holds."""
    vertices, faces = grid()
    garment = wg.Garment(torch.tensor(vertices), faces.tolist(), pins=[3, 1, 3], name="sheet")
    assert garment.vertices.dtype == np.float32
    assert garment.faces.dtype == np.int32
    np.testing.assert_array_equal(garment.vertices, vertices)
    np.testing.assert_array_equal(garment.faces, faces)
    np.testing.assert_array_equal(garment.pins, [1, 3])
    assert wg.Garment(vertices, faces).pins.shape == (0,)


def _broken():
    vertices, faces = sphere()
    nan, inf = vertices.copy(), vertices.copy()
    nan[[7, 9]], inf[11, 1] = np.nan, np.inf
    a, b = faces[0, :2]
    flipped = faces.copy()
    flipped[::4] = flipped[::4, ::-1]  # a quarter: which side is outside would be a guess
    line = np.concatenate([vertices, vertices[:1], vertices[1:2]])  # vertices 42 and 43 lie on 0 and 1
    return {
        "nan": (nan, faces, "2 of 42 vertices are NaN or infinite (first: vertex 7)"),
        "inf": (inf, faces, "1 of 42 vertices are NaN or infinite (first: vertex 11)"),
        "beyond": (
            vertices,
            np.r_[faces, [[0, 1, 42]]],
            "1 of 81 faces name vertices that do not exist: indices must lie",
        ),
        "negative": (vertices, np.r_[[[0, 1, -1]], faces], "(first: face 0)"),
        "repeated": (vertices, np.r_[faces, [[4, 4, 8]]], "1 of 81 faces name a vertex twice (first: face 80)"),
        "no area": (line, np.r_[faces, [[0, 1, 42], [0, 1, 43]]], "2 of 82 faces have no area (first: face 80)"),
        "duplicate": (
            vertices,
            np.r_[faces, faces[4:6, [1, 2, 0]]],
            "2 of 82 faces repeat an earlier face (first: face 80)",
        ),
        "mirrored duplicate": (vertices, np.r_[faces, faces[4:5, ::-1]], "1 of 81 faces repeat"),
        "three faces": (
            np.r_[vertices, [[0, 3, 0]]],
            np.r_[faces, [[a, b, 42]]],
            "1 of 122 edges have more than two faces",
        ),
        "flipped": (vertices, flipped, "of 120 edges join faces that disagree on which side is outside"),
        "left over": (np.r_[vertices, [[0, 0, 3]]], faces, "1 of 43 vertices belong to no face (first: vertex 42)"),
    }


@pytest.mark.parametrize("case", _broken())
def test_bad_meshes_are_refused_with_element_count_and_a_remedy_that_works(case):
    """A broken mesh would pass, or its message would send the user to a remedy that does not help."""
    vertices, faces, message = _broken()[case]
    with pytest.raises(wg.MeshError, match=re.escape(message)) as caught:
        wg.Garment(vertices, faces)
    if case not in ("nan", "inf"):
        assert "cleaned_from" in str(caught.value)
        assert "clean=True" in str(caught.value)
    cleaned = wg.Garment.cleaned_from(vertices, faces)
    assert igl.is_edge_manifold(cleaned.faces.astype(np.int64))
    assert igl.bfs_orient(cleaned.faces.astype(np.int64))[0].shape == cleaned.faces.shape
    if case not in ("nan", "inf", "three faces"):  # these lose vertices of the sphere
        np.testing.assert_array_equal(
            np.sort(np.unique(cleaned.vertices, axis=0)), np.sort(np.unique(sphere()[0], axis=0))
        )


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        ([], []),
        (np.zeros((3, 2)), [[0, 1, 2]]),
        (np.eye(3), []),
        (np.eye(3), [[0, 1, 2, 0]]),
        (np.eye(3), [[0.0, 1.0, 2.0]]),
        ("text", [[0, 1, 2]]),
        (None, [[0, 1, 2]]),
        ([[0, 1, 2], [3]], [[0, 1, 2]]),
    ],
)
def test_other_shapes_and_types_are_refused(vertices, faces):
    """An empty or misshapen array would fail later, in a kernel."""
    with pytest.raises(wg.MeshError):
        wg.Garment(vertices, faces)


def test_pins_out_of_range_are_refused():
    """A pin that does not exist would tie another garment's vertex in a packed batch."""
    for pins in ([0, 99], [-1], [0.5], [[0]]):
        with pytest.raises(wg.MeshError, match="pins"):
            wg.Garment(*grid(), pins=pins)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_area_is_judged_relative_to_size(scale):
    """A garment in millimetres would pass with flat faces, or one in kilometres would lose good ones."""
    vertices, faces = grid()
    wg.Garment(vertices * scale, faces)
    flat = vertices.copy()
    flat[6] = flat[5] * 0.5 + flat[7] * 0.5  # on the line between its neighbours: still fine, no face there spans them
    wg.Garment(flat * scale, faces)
    with pytest.raises(wg.MeshError, match="have no area"):
        wg.Garment(np.r_[vertices, [[0.5, 0.0, 1e-8], [0.25, 0, 0]]] * scale, np.r_[faces, [[0, 35, 36]]])


def test_open_closed_and_several_pieces_are_fine():
    """Legal garments would be refused."""
    (v1, f1), (v2, f2) = grid(), sphere()
    both = wg.Garment(np.r_[v2, v1 + 3], np.r_[f2, f1 + len(v2)])
    vertex_component, face_component, count = both.components
    assert count == 2
    np.testing.assert_array_equal(vertex_component, np.r_[np.zeros(len(v2)), np.ones(len(v1))])
    np.testing.assert_array_equal(face_component, np.r_[np.zeros(len(f2)), np.ones(len(f1))])
    np.testing.assert_array_equal(both.edges, np.array(sorted(map(tuple, igl.edges(both.faces.astype(np.int64))))))


def test_cleaning_sews_a_soup_and_leaves_a_good_mesh_alone():
    """Cleaning would change good meshes, or leave seams open."""
    vertices, faces = sphere()
    soup = vertices[faces].reshape(-1, 3) + np.random.default_rng(0).normal(0, 1e-8, (240, 3))
    sewn = wg.Garment.cleaned_from(soup, np.arange(240).reshape(-1, 3), pins=[0, 239])
    assert (len(sewn.vertices), len(sewn.faces)) == (42, 80)
    assert trimesh.Trimesh(sewn.vertices, sewn.faces, process=False).volume > 0
    np.testing.assert_allclose(
        sewn.vertices[sewn.pins], sorted(soup[[0, 239]].tolist(), key=lambda p: _index(sewn, p)), atol=1e-6
    )
    again = sewn.cleaned()
    np.testing.assert_array_equal(again.vertices, sewn.vertices)
    np.testing.assert_array_equal(again.faces, sewn.faces)


def _index(garment, point):
    return int(np.argmin(np.linalg.norm(garment.vertices - point, axis=1)))


def test_cleaning_orients_by_majority_and_cuts_what_cannot_be_oriented():
    """Flipped faces would stay, the whole mesh would turn inside out, or a Moebius strip would loop for ever."""
    vertices, faces = sphere()
    flipped = faces.copy()
    flipped[::3] = flipped[::3, ::-1]
    cleaned = wg.Garment.cleaned_from(vertices, flipped)
    np.testing.assert_allclose(
        trimesh.Trimesh(cleaned.vertices, cleaned.faces, process=False).volume,
        trimesh.Trimesh(vertices, faces, process=False).volume,
        rtol=1e-6,  # the same float32 vertices; the order of the sum differs
    )
    count = 24
    angle = np.repeat(np.arange(count) * 2 * np.pi / count, 2)
    side = np.tile([-0.2, 0.2], count)
    radius = 1 + side * np.cos(angle / 2)
    strip = np.stack([radius * np.cos(angle), side * np.sin(angle / 2), radius * np.sin(angle)], axis=1)
    band = [[2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 3] for i in range(count - 1)] + [[46, 47, 1, 0]]
    band_faces = np.array([t for a, b, c, d in band for t in ([a, c, b], [b, c, d])])
    with pytest.raises(wg.MeshError, match="disagree"):
        wg.Garment(strip, band_faces)
    assert len(wg.Garment.cleaned_from(strip, band_faces).faces) == 2 * count - 1


def test_nothing_left_after_cleaning_is_an_error():
    """A garment without faces would come out."""
    with pytest.raises(wg.MeshError, match="Nothing is left"):
        wg.Garment.cleaned_from(np.zeros((3, 3)), [[0, 1, 2]])


def test_face_frames_and_laplacian_are_those_of_the_mesh():
    """What is cached would belong to other conventions: compared with libigl, to float32 rounding of unit sizes."""
    garment = wg.Garment(*sphere())
    normals = igl.per_face_normals(garment.vertices.astype(float), garment.faces.astype(np.int64), np.zeros(3))
    normals = normals[0] if isinstance(normals, tuple) else normals
    np.testing.assert_allclose(garment.face_frames[..., 2], normals, atol=1e-6)
    corners = garment.vertices[garment.faces]
    np.testing.assert_allclose(garment.face_frames[..., 0], corners[:, 1] - corners[:, 0], atol=1e-6)
    expected = -igl.cotmatrix(garment.vertices.astype(float), garment.faces.astype(np.int64))
    assert abs(garment.laplacian - expected).max() < 1e-6


OBJ = """# a comment
mtllib x.mtl
o first
v 0 0 0 0.5 0.5 0.5
v 1 0 0
v 1 1 0 # trailing
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
g one
usemtl red
f 1/1/1 2/2/1 3/3/1 4/4/1
v 0.5 0.5 1
g two
usemtl blue
s 1
f -5//1 -1//1 \\
  -4//1
f 5 3/4 2/1
"""


def test_obj_keeps_every_vertex_once_and_in_order(tmp_path):
    """Texture seams, materials, groups or negative indices would split or shuffle vertices."""
    (tmp_path / "a.obj").write_text(OBJ)
    garment = wg.Garment.load(tmp_path / "a.obj")
    np.testing.assert_array_equal(garment.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
    np.testing.assert_array_equal(garment.faces, [[0, 1, 2], [0, 2, 3], [0, 4, 1], [4, 2, 1]])
    assert garment.name == "a"


def test_polygons_are_covered_exactly_once():
    """Concave quads would fold over: the triangles' signed areas must be positive and sum to the polygon's."""
    random = np.random.default_rng(2)
    for corners in (4, 5, 9):
        for _ in range(40):
            angle = np.sort(random.uniform(0, 2 * np.pi, corners))
            if np.diff(np.r_[angle, angle[0] + 2 * np.pi]).max() > np.pi:
                continue  # not around the origin
            radius = random.uniform(0.15, 1, corners)
            flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
            x, y = flat.T
            area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
            axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
            normal = np.cross(axes[0], axes[1])
            points = flat @ axes[:2] + random.normal(size=3)
            faces = triangulate_counts(points, np.array([corners]), np.arange(corners))
            parts = (
                0.5
                * np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
                @ normal
            )
            assert len(faces) == corners - 2
            assert (parts > -1e-12).all()
            np.testing.assert_allclose(parts.sum(), area, rtol=1e-9)  # float64 rounding


PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
element face {faces}
property list uchar int vertex_indices
{more}end_header
0 0 0 9
1 0 0 9
0.2 0.2 0 9
0 1 0 9
"""


def test_ply_polygons_and_texture_coordinates(tmp_path):
    """A concave quad would be cut outside itself, or texture coordinates would split vertices."""
    (tmp_path / "quad.ply").write_text(PLY.format(faces=1, more="") + "4 3 0 1 2\n")
    np.testing.assert_array_equal(np.sort(wg.Garment.load(tmp_path / "quad.ply").faces), [[0, 2, 3], [0, 1, 2]])
    more = "property list uchar float texcoord\n"
    rows = "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 .5 .5 .1 .1 .2 .2\n"
    (tmp_path / "seam.ply").write_text(PLY.format(faces=2, more=more) + rows)
    garment = wg.Garment.load(tmp_path / "seam.ply")
    assert garment.vertices.shape == (4, 3)
    np.testing.assert_array_equal(garment.faces, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("suffix", ["stl", "glb", "ply"])
def test_files_written_by_trimesh(tmp_path, suffix):
    """Formats that repeat vertices would come in as loose triangles."""
    vertices, faces = sphere()
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / f"m.{suffix}")
    garment = wg.Garment.load(tmp_path / f"m.{suffix}")
    assert (len(garment.vertices), len(garment.faces), garment.components[2]) == (42, 80, 1)
    area = trimesh.Trimesh(garment.vertices, garment.faces, process=False).area
    np.testing.assert_allclose(area, trimesh.Trimesh(vertices, faces).area, rtol=1e-6)  # float32 in the file


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_of_both_byte_orders_and_mixed_polygons(tmp_path, order):
    """Lists of different lengths would be read as if they were alike."""
    name = {"<": "little", ">": "big"}[order]
    head = f"ply\nformat binary_{name}_endian 1.0\nelement vertex 5\n"
    head += "property double x\nproperty double y\nproperty double z\n"
    head += "element face 2\nproperty list uchar uint vertex_index\nend_header\n"
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.5, 0]])
    body = points.astype(order + "f8").tobytes()
    for polygon in ([0, 1, 2, 3], [1, 4, 2]):
        body += bytes([len(polygon)]) + np.array(polygon).astype(order + "u4").tobytes()
    (tmp_path / "m.ply").write_bytes(head.encode() + body)
    garment = wg.Garment.load(tmp_path / "m.ply")
    np.testing.assert_array_equal(garment.vertices, points)
    np.testing.assert_array_equal(garment.faces, [[0, 1, 2], [0, 2, 3], [1, 4, 2]])


@pytest.mark.parametrize("suffix", ["obj", "ply", "npz", "usda", "usdc"])
def test_saving_and_loading_loses_nothing(tmp_path, suffix):
    """Float32 positions would be rounded, or the order changed, on the way through a file."""
    vertices, faces = sphere()
    vertices = vertices * np.float32(1 / 3)
    wg.Garment(vertices, faces, pins=[2], name="ball").save(tmp_path / f"m.{suffix}")
    back = wg.Garment.load(tmp_path / f"m.{suffix}")
    np.testing.assert_array_equal(back.vertices, vertices)
    np.testing.assert_array_equal(back.faces, faces)
    assert list(back.pins) == ([2] if suffix == "npz" else [])


@pytest.mark.parametrize("suffix", ["obj", "ply", "npz", "stl", "glb", "usda", "usdc"])
def test_damaged_and_foreign_files_are_named(tmp_path, suffix):
    """A truncated download would show as a stack trace, or worse as half a garment."""
    vertices, faces = sphere()
    whole = tmp_path / f"whole.{suffix}"
    if suffix in ("stl", "glb"):
        trimesh.Trimesh(vertices, faces).export(whole)
    else:
        wg.Garment(vertices, faces).save(whole)
    data = whole.read_bytes()
    broken = {
        "cut": data[: len(data) * 2 // 3],
        "foreign": b"not a mesh at all\n" * 20,
        "noise": bytes(range(256)) * 4,
        "empty": b"",
    }
    for name, content in broken.items():
        path = tmp_path / f"{name}.{suffix}"
        path.write_bytes(content)
        with pytest.raises(wg.MeshError, match=re.escape(str(path))):
            wg.Garment.load(path)


def test_unknown_suffix_and_missing_file(tmp_path):
    """The user would not learn which formats there are."""
    (tmp_path / "a.xyz").write_text("1 2 3")
    with pytest.raises(wg.MeshError, match=r"\.obj"):
        wg.Garment.load(tmp_path / "a.xyz")
    with pytest.raises(FileNotFoundError):
        wg.Garment.load(tmp_path / "missing.obj")


@pytest.mark.parametrize(
    ("unit", "metres"), [("m", 1), ("dm", 0.1), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), (None, 1)]
)
def test_units(tmp_path, unit, metres):
    """A garment in centimetres would be a hundred times too large."""
    vertices, faces = sphere()
    wg.Garment(vertices / metres, faces).save(tmp_path / "m.npz")
    np.testing.assert_allclose(wg.Garment.load(tmp_path / "m.npz", unit=unit).vertices, vertices, rtol=1e-6)


def test_absurd_sizes_warn_and_name_the_unit(tmp_path, recwarn):
    """A 150 m garment would be simulated without a word."""
    vertices, faces = sphere()
    wg.Garment(vertices * 75, faces).save(tmp_path / "big.obj")
    with pytest.warns(UserWarning, match='unit="cm"'):
        wg.Garment.load(tmp_path / "big.obj")
    wg.Garment(vertices * 0.00075, faces).save(tmp_path / "small.obj")
    with pytest.warns(UserWarning, match="unit="):
        wg.Garment.load(tmp_path / "small.obj")
    recwarn.clear()
    wg.Garment.load(tmp_path / "big.obj", unit="cm")
    assert not recwarn.list
    with pytest.raises(ValueError, match="unit must be one of"):
        wg.Garment.load(tmp_path / "big.obj", unit="km")


def test_cleaning_while_loading(tmp_path):
    """The remedy that messages name for files would not work."""
    vertices, faces = sphere()
    lines = [f"v {x} {y} {z}" for x, y, z in np.r_[vertices, vertices[:1]]]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in np.r_[faces, [[0, 1, 42]]]]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    with pytest.raises(wg.MeshError, match="clean=True"):
        wg.Garment.load(tmp_path / "m.obj")
    assert len(wg.Garment.load(tmp_path / "m.obj", clean=True).faces) == 80
