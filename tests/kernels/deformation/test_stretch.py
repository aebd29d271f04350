"""Deformation gradients of known frames and their singular values, beside NumPy in float64."""

import numpy as np
import pytest
import torch
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels.deformation.gradients import inverse_rest_frames
from warpgarment.kernels.deformation.stretch import stretch


def frames(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Q of each face in float64, [F,3,3]."""
    a, b, c = vertices[faces].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    return np.stack([b - a, c - a, normal / np.linalg.norm(normal, axis=1, keepdims=True)], axis=2)


def test_gradients_and_singular_values_agree_with_numpy(monkeypatch):
    """Training would aim at another stretch than the recording has. 1e-5: products of float32."""
    poisoned = poison_outputs(monkeypatch)
    mesh, rng = meshes.icosphere(4), np.random.default_rng(0)
    moved = (mesh.vertices * [1.2, 0.7, 1.0] + 0.01 * rng.normal(size=mesh.vertices.shape)).astype(np.float32)
    faces = torch.tensor(mesh.faces)
    inverse = inverse_rest_frames(torch.tensor(mesh.vertices), faces)
    phi, values = stretch(inverse, torch.tensor(moved), faces)
    assert len(poisoned) == 3  # with the inverse
    expected = frames(moved, mesh.faces) @ np.linalg.inv(frames(mesh.vertices, mesh.faces))
    np.testing.assert_allclose(phi.numpy(), expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(values.numpy(), np.linalg.svd(expected, compute_uv=False), rtol=1e-5, atol=1e-5)


def test_a_face_out_of_range_is_nan_and_none_are_none():
    """Memory that is not a vertex would be read."""
    mesh = meshes.icosphere(2)
    faces = torch.tensor(mesh.faces)
    inverse, vertices = inverse_rest_frames(torch.tensor(mesh.vertices), faces), torch.tensor(mesh.vertices)
    faces[3, 1] = len(vertices)
    phi, values = stretch(inverse, vertices, faces)
    assert values.isnan().all(1).nonzero().flatten().tolist() == [3]
    assert phi.isnan().flatten(1).all(1).nonzero().flatten().tolist() == [3]
    assert stretch(inverse[:0], vertices, faces[:0])[1].shape == (0, 3)
    with pytest.raises(ValueError, match="inverse_rest"):
        stretch(inverse[1:], vertices, faces)
