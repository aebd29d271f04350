"""The scene that is timed: the bundled dress and walk, remeshed to a number of faces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import igl
import numpy as np
from gpytoolbox import remesh_botsch

from warpgarment import demo
from warpgarment.geometry.cutting import without_short_edges
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment

MOST_REMESHED = 100_000  # largest number of faces by remeshing; beyond it each face is cut into four instead


@dataclass(frozen=True)
class Dressed:
    """A garment on a moving body: vertices in two frames, and the first frame pressed 6 mm into the body, [V,3] [m]."""

    garment: Garment
    body: BodyMotion
    first: np.ndarray
    second: np.ndarray
    pressed: np.ndarray


@lru_cache(maxsize=8)
def remeshed(faces: int, name: str = "dress") -> tuple[Garment, np.ndarray, np.ndarray]:
    """The bundled garment with about `faces` faces; old face of each new vertex, and barycentric coordinates on it."""
    item = demo.assets().garments[name]
    rest, old = item.garment.vertices.astype(np.float64), item.garment.faces.astype(np.int64)
    if faces > MOST_REMESHED:
        coarse = remeshed(faces // 4, name)[0]
        vertices, triangles = igl.upsample(coarse.vertices.astype(np.float64), coarse.faces.astype(np.int64))
    else:
        area = 0.5 * np.asarray(igl.doublearea(rest, old)).sum()
        edge = float(np.sqrt(area * 4.0 / (np.sqrt(3.0) * faces)))
        vertices, triangles = remesh_botsch(rest, old.astype(np.int32), i=10, h=edge, project=True)
        vertices, triangles = without_short_edges(vertices, triangles, 0.3 * edge)
    _, nearest, closest = igl.point_mesh_squared_distance(vertices, rest, old)
    corners = [rest[old[nearest, k]] for k in range(3)]
    weights = np.asarray(igl.barycentric_coordinates(closest, *corners)).reshape(-1, 3)
    garment = Garment(vertices.astype(np.float32), triangles.astype(np.int32), name=f"{name}_{faces}")
    return garment, nearest, weights


@lru_cache(maxsize=64)
def dressed(faces: int, name: str = "dress", start: int = 40) -> Dressed:
    """The bundled garment with about `faces` faces, on the body from frame `start` of the walk on."""
    garment, nearest, weights = remeshed(faces, name)
    bundle = demo.assets()
    item = bundle.garments[name]
    old = item.garment.faces.astype(np.int64)

    def carried(frame: np.ndarray) -> np.ndarray:
        return np.einsum("vk,vkc->vc", weights, frame.astype(np.float64)[old[nearest]]).astype(np.float32)

    motion = bundle.collider
    moving = BodyMotion(motion.vertices[start:], motion.faces, motion.fps)
    first, second = carried(item.truth.vertices[start]), carried(item.truth.vertices[start + 1])
    distance, _, point, *_ = igl.signed_distance(
        first.astype(np.float64),
        moving.vertices[0].astype(np.float64),
        moving.faces.astype(np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )
    near = (np.asarray(distance) < 0.03)[:, None]
    inward = np.asarray(point) - first
    inward /= np.linalg.norm(inward, axis=1, keepdims=True) + 1e-12
    depth = np.minimum(np.asarray(distance), 0.03)[:, None] + 0.006
    pressed = (first + np.where(near, inward * depth, 0.0)).astype(np.float32)
    return Dressed(garment, moving, first, second, pressed)
