"""Straight segments over a surface, all windows of all sources at once, face after face, in NumPy."""

from __future__ import annotations

import numpy as np

from warpgarment.kernels.mesh.windows import DEPTH, LEAST_DEPTH, Surface


def segments(
    surface: Surface, source: np.ndarray, half: np.ndarray, right: np.ndarray, left: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sources, nodes and lengths [m] of all visible segments, without the rules for slender faces and thin tubes.

    Arguments are those of `warpgarment.kernels.mesh.windows.segments`.
    """
    following = np.arange(len(surface.twin))
    following = following - following % 3 + (following + 1) % 3
    ray_right, ray_left = right, left
    reach = reach[source]
    found = [(source[:0], half[:0], right[:0, 0])]
    for depth in range(DEPTH):
        across = surface.twin[half]
        go = across >= 0
        if depth >= LEAST_DEPTH:
            go &= _distance_to_segment(right, left) < reach
        if not go.any():
            break
        source, across, right, left = source[go], across[go], right[go], left[go]
        ray_right, ray_left = ray_right[go], ray_left[go]
        reach = np.maximum(reach[go], surface.crossed_reach[across // 3])
        # The twin runs from left to right with the new face on its far side.
        unit = right - left
        unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-30)
        normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
        apex = left + surface.apex[across, :1] * unit + surface.apex[across, 1:] * normal
        centroid = (left + right + apex) / 3
        for point, node in ((centroid, across // 3), (apex, surface.node[following[following[across]]])):
            size = np.linalg.norm(point, axis=1)
            slack = -1e-9 * size
            visible = (_cross(ray_right, point) >= slack * np.linalg.norm(ray_right, axis=1)) & (node >= 0)
            visible &= _cross(point, ray_left) >= slack * np.linalg.norm(ray_left, axis=1)
            found.append((source[visible], node[visible], size[visible]))
        beside_right, beside_left = _cross(ray_right, apex), _cross(apex, ray_left)
        tiny = 1e-12 * np.linalg.norm(apex, axis=1)
        a = beside_right > tiny * np.linalg.norm(ray_right, axis=1)  # part of the window passes right of the apex
        b = beside_left > tiny * np.linalg.norm(ray_left, axis=1)
        right_side = following[across]
        half = np.concatenate([right_side[a], following[right_side][b]])
        narrowed_left = np.where((beside_left > 0)[:, None], apex, ray_left)
        narrowed_right = np.where((beside_right > 0)[:, None], apex, ray_right)
        source, reach = np.concatenate([source[a], source[b]]), np.concatenate([reach[a], reach[b]])
        right, left = np.concatenate([right[a], apex[b]]), np.concatenate([apex[a], left[b]])
        ray_right = np.concatenate([ray_right[a], narrowed_right[b]])
        ray_left = np.concatenate([narrowed_left[a], ray_left[b]])
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _distance_to_segment(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    d = b - a
    t = np.clip(-np.einsum("ij,ij->i", a, d) / np.maximum(np.einsum("ij,ij->i", d, d), 1e-300), 0, 1)
    return np.linalg.norm(a + t[:, None] * d, axis=1)
