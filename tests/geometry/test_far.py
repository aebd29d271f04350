"""If these failed, scenes kilometres from the origin would lose their shape to float32 without a word."""

import warnings

import numpy as np
import pytest
import trimesh

import warpgarment as wg


def test_a_body_far_from_the_origin_is_said_to_be():
    """A body would lose a third of its faces to float32 without a word. 20 km: steps of 2 mm."""
    mesh = trimesh.creation.icosphere(4, 0.5)
    far = np.asarray(mesh.vertices)[None] + [2e4, 0, 2e4]
    with pytest.warns(
        UserWarning, match=r"20 km from the origin.* 2 mm apart: [\d,]+ of 5,120 faces have no area there"
    ):
        wg.BodyMotion(far, mesh.faces)
    walked = np.asarray(mesh.vertices)[None] + np.array([0, 0, 5e4])[None, None] * np.arange(3)[:, None, None]
    with pytest.warns(UserWarning, match=r"the body in frame 2 is 100 km from the origin"):
        wg.BodyMotion(walked.astype(np.float32), mesh.faces)  # as most readers give it
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wg.BodyMotion(np.asarray(mesh.vertices)[None] + [300.0, 0, 0], mesh.faces)


def test_a_garment_far_from_the_origin_is_said_to_be():
    """Faces would be lost to float32, and the remedy named be to drop them."""
    mesh = trimesh.creation.icosphere(1)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    with pytest.warns(UserWarning, match=r"100 km from the origin, where positions in float32 are 7.8 mm apart"):
        wg.Garment(vertices.astype(float) * 0.5 + [1e5, 0, 0], faces)
    small = vertices.astype(float) * 0.01 + [2e4, 0, 0]
    with pytest.raises(wg.MeshError, match=r"have no area .* Move garment and body to the origin"):
        wg.Garment(small, faces)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wg.Garment(vertices.astype(float) + [500.0, 0, 0], faces)
