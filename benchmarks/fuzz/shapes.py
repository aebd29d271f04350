"""A small garment and a small body: what the sound files hold."""

from __future__ import annotations

import numpy as np

FRAMES = 4


def tube(around: int = 8, rings: int = 4, radius: float = 0.36) -> tuple[np.ndarray, np.ndarray]:
    """An open tube about +Y that looks outwards: vertices [m], float32 [V,3], and faces, int32 [F,3]."""
    angle = np.arange(around) * 2 * np.pi / around
    circle = np.stack([np.sin(angle), np.zeros(around), np.cos(angle)], 1) * radius
    vertices = np.concatenate([circle + [0, y, 0] for y in np.linspace(0.8, 1.3, rings)])
    faces = []
    for r in range(rings - 1):
        for i in range(around):
            a, b = r * around + i, r * around + (i + 1) % around
            faces += [[a, b, b + around], [a, b + around, a + around]]
    return vertices.astype(np.float32), np.array(faces, np.int32)


def box() -> tuple[np.ndarray, np.ndarray]:
    """A closed box of a body's size that looks outwards: vertices [m], float32 [8,3], and faces, int32 [12,3]."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - [0.5, 0.0, 0.5]
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
        [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return (corner * [0.4, 1.7, 0.3]).astype(np.float32), np.array(faces, np.int32)


def moved(vertices: np.ndarray, frames: int = FRAMES) -> np.ndarray:
    """Vertices that slide along X, float32 [T,V,3]."""
    slide = np.zeros((frames, 1, 3), np.float32)
    slide[:, 0, 0] = np.arange(frames) * 0.01
    return vertices[None] + slide


def transforms(frames: int = FRAMES, bones: int = 1) -> np.ndarray:
    """The same as transforms of bones, float32 [T,B,3,4]."""
    moves = np.zeros((frames, bones, 3, 4), np.float32)
    moves[..., :3] = np.eye(3)
    moves[..., 0, 3] = (np.arange(frames) * 0.01)[:, None]
    return moves
