"""If these failed, garments would have the colours of other figures."""

from __future__ import annotations

import igl
import numpy as np
import trimesh

from warpgarment.view.browser import bands
from warpgarment.view.browser.figures import BodyDistance, apart, stretch


def _sheet(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Irregular triangles of a flat sheet."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    rng = np.random.default_rng(seed)
    return mesh.vertices + rng.normal(size=mesh.vertices.shape) * 0.01, np.asarray(mesh.faces)


def test_stretch_is_the_largest_singular_value():
    """It would be stretch of an edge, or in another direction. Against NumPy's SVD of the map D D_rest^+, to 1e-6 %."""
    rest, faces = _sheet()
    moved = rest * [1.3, 0.9, 1.0] + np.random.default_rng(1).normal(size=rest.shape) * 0.004
    expected = []
    for face in faces:
        before, after = ((p[face[1:]] - p[face[0]]).T for p in (rest, moved))
        expected.append(100 * (np.linalg.svd(after @ np.linalg.pinv(before), compute_uv=False)[0] - 1))
    np.testing.assert_allclose(stretch(rest, moved, faces), expected, atol=1e-6)


def test_stretch_does_not_see_rotation_nor_flat_faces():
    """Turning would be coloured, or a face without area at rest would be a number."""
    rest, faces = _sheet()
    turned = rest @ trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3].T + 5.0
    np.testing.assert_allclose(stretch(rest, turned, faces), 0.0, atol=1e-6)
    flat = np.concatenate([rest, rest[:1]])
    assert np.isnan(stretch(flat, flat, np.array([[0, 1, len(rest)]]))).all()


def test_distance_to_the_body_is_that_of_the_frame():
    """The body of another frame would be measured, or inside not be red. Against libigl, to 0.01 mm."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    frames = np.stack([ball.vertices, ball.vertices + [0.05, 0.0, 0.0], ball.vertices * 1.1]).astype(np.float32)
    cloth = trimesh.creation.icosphere(subdivisions=2, radius=0.22)
    distance = BodyDistance(frames, np.asarray(ball.faces))
    for frame in (0, 1, 2, 0):
        found = distance.at(frame, cloth.vertices, cloth.faces)
        body = frames[frame].astype(np.float64)
        kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        exact = igl.signed_distance(cloth.vertices, body, np.asarray(ball.faces, np.int64), kind)[0]
        np.testing.assert_allclose(found, 1e3 * exact[cloth.faces].min(1), atol=0.01)
    inside = distance.at(1, cloth.vertices, cloth.faces) < 0
    assert inside.any()
    np.testing.assert_array_equal(bands.DISTANCE.steps(distance.at(1, cloth.vertices, cloth.faces)) == 0, inside)


def test_distance_to_another_result():
    """Another unit, or distances of other vertices: all vertices moved by 2 cm are 2 cm apart."""
    rest, faces = _sheet()
    np.testing.assert_allclose(apart(rest, rest + [0.0, 0.02, 0.0], faces), 2.0, atol=1e-9)


def test_steps_hold_what_their_labels_say():
    """A legend would be of other colours than the garment: each label's middle is in its step, NaN in none."""
    for scale in (bands.DISTANCE, bands.STRAIN, bands.ERROR):
        assert len(scale.colors) == len(scale.labels) == len(scale.edges) + 1
        assert len(set(scale.colors)) == len(scale.colors)
        middles = [(a + b) / 2 for a, b in zip(scale.edges, scale.edges[1:], strict=False)]
        values = np.array([scale.edges[0] - 1, *middles, scale.edges[-1] + 1, np.nan])
        np.testing.assert_array_equal(scale.steps(values), [*range(len(scale.colors)), -1])


def test_a_split_mesh_is_the_same_mesh():
    """Faces would be lost, shown twice, or have other corners: those of all steps together are the mesh's."""
    vertices, faces = _sheet()
    step = np.random.default_rng(2).integers(-1, 5, len(faces))
    found = {}
    for k, corners, parts in bands.split(vertices, faces, step):
        assert len(corners) == len(np.unique(parts))
        found[k] = corners[parts]
    assert sorted(found) == [0, 1, 2, 3, 4]
    for k, triangles in found.items():
        np.testing.assert_array_equal(triangles, vertices[faces[step == k]])
