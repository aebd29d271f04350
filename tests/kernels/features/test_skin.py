"""Garments that move with the body around them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference.features import smooth_skin
from scipy.spatial.transform import Rotation
from support import meshes

from warpgarment.kernels.features.skin import bind


def poses(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A garment's vertices, a body, and three poses of it: bound, bent, and bent and turned."""
    rng = np.random.default_rng(seed)
    body = meshes.posed_body(0.0).vertices + rng.uniform(-1e-3, 1e-3, meshes.posed_body(0.0).vertices.shape)
    bent = meshes.posed_body(0.7).vertices
    turn = Rotation.from_rotvec([0.3, 1.2, -0.4]).as_matrix()
    cloth = meshes.skirt().vertices + rng.uniform(-1e-3, 1e-3, meshes.skirt().vertices.shape)
    return cloth[::5], body, np.stack([body, bent, bent @ turn.T + [0.3, 0.1, -1.0]])


def run(cloth, body, frames, device="cpu"):
    skin = bind(cloth, np.zeros(len(cloth)), body, [0, len(body)], device)
    found = [skin(torch.tensor(np.array(pose)).float().to(device)) for pose in frames]
    return [np.stack([part[k].double().cpu().numpy() for part in found]) for k in range(2)]


def test_agrees_with_its_twin():
    """Cloth would follow other parts of the body than the text says. 2e-5 m, 2e-4 of a rotation: float32 of 2 m."""
    cloth, body, frames = poses()
    turns, places = run(cloth, body, frames)
    expected = smooth_skin(cloth, body, frames)
    assert np.abs(expected[1][1] - cloth).max() > 0.02  # it moves
    assert np.abs(places - expected[1]).max() < 2e-5
    assert np.abs(turns - expected[0]).max() < 2e-4


def test_bound_pose_and_rigid_motion():
    """Cloth would move where the body does not, or be deformed where it only turns. 1e-5 m."""
    cloth, body, _ = poses()
    turn, shift = Rotation.from_rotvec([0.9, -1.9, 0.2]).as_matrix(), np.array([1.0, -0.2, 0.5])
    turns, places = run(cloth, body, [body, body @ turn.T + shift])
    assert np.abs(places[0] - cloth).max() < 1e-5
    assert np.abs(turns[0] - np.eye(3)).max() < 1e-4
    assert np.abs(places[1] - (cloth @ turn.T + shift)).max() < 1e-5
    assert np.abs(turns[1] - turn).max() < 1e-4


def test_several_bodies():
    """A garment would be bound to the body of another. Equal, to 1e-6 m, to each on its own."""
    cloth, body, frames = poses()
    other, moved = body[::-1] + [0.05, 0.0, 0.0], frames[2][::-1]
    skin = bind(
        np.concatenate([cloth, cloth[:7], cloth[9:]]),
        np.repeat([1, 0, 1], [len(cloth), 7, len(cloth) - 9]),
        np.concatenate([other, body]),
        [0, len(body), 2 * len(body)],
        "cpu",
    )
    _, found = skin(torch.from_numpy(np.concatenate([moved, frames[1]])).float())
    alone = run(cloth, body, frames[1:2])[1][0]
    beside = run(cloth[:7], other, moved[None])[1][0]
    assert np.abs(found.numpy() - np.concatenate([alone, beside, alone[9:]])).max() < 1e-6


@pytest.mark.parametrize("count", [4, 30])
def test_small_bodies(count):
    """A body of fewer vertices than a point takes would be refused, or give no number."""
    rng = np.random.default_rng(0)
    body = rng.normal(size=(count, 3)) * 0.1
    turns, places = run(rng.normal(size=(5, 3)), body, [body + 1.0])
    assert np.isfinite(places).all()
    assert np.abs(np.linalg.det(turns) - 1.0).max() < 1e-4
