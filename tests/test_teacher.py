"""The Newton teacher on a small scene."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import trimesh

from warpgarment.garment import Garment
from warpgarment.training.teacher import ClothSettings, simulate


def _sheet(size: float, cells: int, height: float) -> tuple[Garment, float]:
    grid, faces = igl.triangulated_grid(cells + 1, cells + 1)[:2]
    grid = np.asarray(grid, float) * size - size / 2
    vertices = np.stack([grid[:, 0], np.full(len(grid), height), grid[:, 1]], 1)
    corners = vertices[np.asarray(faces)]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[0, 1] > 0
    faces = np.asarray(faces, np.int32)
    return Garment(vertices.astype(np.float32), faces if up else faces[:, ::-1]), size / cells


def _simulate(body_path: np.ndarray):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.15)
    garment, edge = _sheet(0.5, 12, 0.17)
    body = ball.vertices[None] + body_path[:, None]
    settings = ClothSettings(settle=2, substeps=5)
    frames = np.stack(list(simulate(garment, edge, body, ball.faces, settings=settings)))
    return garment, ball, body, frames


def test_cloth_drapes_over_a_moving_ball_and_stays_outside():
    """If this fails, the teacher lets cloth through, stretches it, or leaves a moving body behind."""
    path = np.zeros((12, 3))
    path[:, 0] = np.cumsum(np.linspace(0, 0.02, 12))
    garment, ball, body, frames = _simulate(path)
    assert frames.shape == (12, len(garment.vertices), 3)
    assert np.isfinite(frames).all()
    distance = igl.signed_distance(
        frames[-1].astype(float), body[-1], ball.faces.astype(np.int64), sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    )[0]
    assert distance.min() > 0.0
    corner = np.linalg.norm(garment.vertices[:, [0, 2]], axis=1).argmax()
    assert frames[-1, corner, 1] < frames[0, corner, 1] - 0.05, "the corners do not fall"
    moved = (frames[-1] - frames[0]).mean(0)
    assert moved[0] == pytest.approx(path[-1, 0], abs=0.06)
    e = garment.edges
    stretch = np.linalg.norm(frames[-1, e[:, 0]] - frames[-1, e[:, 1]], axis=1) / np.linalg.norm(
        garment.vertices[e[:, 0]] - garment.vertices[e[:, 1]], axis=1
    )
    assert np.abs(stretch - 1).mean() < 0.05


def test_the_same_scene_gives_the_same_frames():
    """If this fails, a sequence is no function of its seed."""
    path = np.zeros((3, 3))
    np.testing.assert_array_equal(_simulate(path)[3], _simulate(path)[3])
