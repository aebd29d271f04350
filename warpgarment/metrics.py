"""Errors of a prediction against the ground truth, and collisions with the body or another layer.

All functions take NumPy arrays or torch tensors, one frame or a sequence, and return a float. The figure of a sequence
is the mean over its frames (the largest for `max_penetration`). If any position is not finite, the figure is nan.
"""

from __future__ import annotations

from typing import Any

import igl
import numpy as np
import torch

from warpgarment.geometry.checks import check_edges, checked_faces, to_numpy
from warpgarment.geometry.geodesics import distances_from, surface_graph
from warpgarment.geometry.orientation import turned_outward
from warpgarment.kernels.sdf.bodies import BodyMeshes


def mean_vertex_error(pred: Any, truth: Any) -> float:
    """Mean distance between corresponding vertices, in **centimetres** (section 5.1: mean over vertices and frames).

    Args:
        pred: Predicted positions [m], shape [V,3] or [T,V,3].
        truth: True positions [m], in the shape of `pred`.

    Raises:
        ValueError: The shapes are others, or differ.
    """
    pred, truth = _frames(pred, "pred"), _frames(truth, "truth")
    if pred.shape != truth.shape:
        raise ValueError(
            f"pred is {list(pred.shape)} and truth {list(truth.shape)}; both need the same frames and vertices"
        )
    return 100.0 * float(np.linalg.norm(pred.astype(np.float64) - truth, axis=-1).mean())


def chamfer_distance(points_a: Any, points_b: Any) -> float:
    """Chamfer distance [m^2]: the mean of the two directed means of squared nearest distances,

        (mean_a min_b |a - b|^2 + mean_b min_a |a - b|^2) / 2.

    Args:
        points_a: Points [m], shape [N,3] or [T,N,3].
        points_b: Points [m], shape [M,3] or [T,M,3].

    Raises:
        ValueError: The shapes are others, or the numbers of frames differ.
    """
    a, b = _frames(points_a, "points_a"), _frames(points_b, "points_b")
    a, b = _same_frames(a, b, "points_a", "points_b")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return float("nan")
    both = [0.5 * (_directed(x, y) + _directed(y, x)) for x, y in zip(a, b, strict=True)]
    return float(np.mean(both))


def _directed(a: np.ndarray, b: np.ndarray) -> float:
    from scipy.spatial import cKDTree  # where it is used: a rollout starts a tenth of a second earlier

    return float(np.mean(cKDTree(b.astype(np.float64)).query(a.astype(np.float64))[0] ** 2))


def geodesic_distortion(pred: Any, truth: Any, faces: Any, *, sources: int = 32, seed: int = 0) -> float:
    """Mean |D_pred - D_truth| [m] over sampled pairs of faces, where D is the distance over the surface (section 5.1).

    The pairs are all faces with `sources` of them, which are drawn at random without repetition, once for all frames;
    with as many sources as faces, these are all pairs. Pairs on different components are left out.

    Args:
        pred: Predicted positions [m], shape [V,3] or [T,V,3].
        truth: True positions [m], in the shape of `pred`.
        faces: Vertex indices, shape [F,3].
        sources: Number of faces from which distances are measured.
        seed: Seed of the random choice of sources.

    Raises:
        ValueError: The shapes are others, the mesh is not a manifold (MeshError), there is a single face, or no source.
    """
    pred, truth = _frames(pred, "pred"), _frames(truth, "truth")
    if pred.shape != truth.shape:
        raise ValueError(
            f"pred is {list(pred.shape)} and truth {list(truth.shape)}; both need the same frames and vertices"
        )
    faces = checked_faces(faces, pred.shape[1])
    check_edges(faces)
    count = len(faces)
    if sources < 1 or count < 2:
        raise ValueError(f"need two faces and one source to form a pair, got {count} and {sources}")
    if not (np.isfinite(pred).all() and np.isfinite(truth).all()):
        return float("nan")
    drawn = np.random.default_rng(seed).choice(count, min(sources, count), replace=False)
    total, pairs = 0.0, 0
    for a, b in zip(pred, truth, strict=True):
        d_pred, d_truth = (distances_from(surface_graph(v, faces), drawn, count).astype(np.float64) for v in (a, b))
        reachable = np.isfinite(d_truth)
        reachable[np.arange(len(drawn)), drawn] = False
        total += np.abs(d_pred[reachable] - d_truth[reachable]).sum()
        pairs += int(np.count_nonzero(reachable))
    return float(total / pairs) if pairs else 0.0


def body_collision(vertices: Any, body_vertices: Any, body_faces: Any) -> float:
    """Share (0 to 1) of garment vertices with negative signed distance to the body; the sign is by winding numbers.

    Args:
        vertices: Garment positions [m], shape [V,3] or [T,V,3].
        body_vertices: Body positions [m], shape [U,3] or [T,U,3]; a single frame is used for all garment frames.
        body_faces: Vertex indices, shape [G,3]; faces that look inwards are turned round, with a warning.

    Raises:
        ValueError: The shapes are others, or an index is out of range.
    """
    distance = _body_distance(vertices, body_vertices, body_faces)
    return float((distance < 0).mean()) if np.isfinite(distance).all() else float("nan")


def max_penetration(vertices: Any, body_vertices: Any, body_faces: Any) -> float:
    """Depth of the deepest garment vertex of all frames below the body's surface [m], at least 0.

    Arguments and errors are those of `body_collision`.
    """
    distance = _body_distance(vertices, body_vertices, body_faces)
    return max(0.0, -float(distance.min())) if np.isfinite(distance).all() else float("nan")


def layer_collision(outer_vertices: Any, inner_vertices: Any, inner_faces: Any) -> float:
    """Share (0 to 1) of an outer garment's vertices that have gone through the inner one.

    Garments are open, so winding numbers do not define an inside. A vertex has gone through if its closest point on the
    inner garment is not on the border and the vertex lies behind the surface there, by the angle-weighted normal
    (Baerentzen and Aanaes 2005). Past the border, as for a coat longer than the shirt below it, the two sides are not
    defined and the vertex does not count.

    Args:
        outer_vertices: Positions of the outer garment [m], shape [V,3] or [T,V,3].
        inner_vertices: Positions of the inner garment [m], shape [W,3] or [T,W,3]; a single frame is used for all
            frames of the outer garment.
        inner_faces: Vertex indices of the inner garment, counter-clockwise seen from outside, shape [G,3].

    Raises:
        ValueError: The shapes are others, an index is out of range, or the inner mesh is not a manifold.
    """
    outer, inner = _frames(outer_vertices, "outer_vertices"), _frames(inner_vertices, "inner_vertices")
    outer, inner = _same_frames(outer, inner, "outer_vertices", "inner_vertices")
    faces = checked_faces(inner_faces, inner.shape[1], name="inner_faces").astype(np.int64)
    check_edges(faces)
    if not (np.isfinite(outer).all() and np.isfinite(inner).all()):
        return float("nan")
    edges = np.sort(faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)  # edge k is opposite to corner k
    _, edge_of, uses = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    border_edge = (uses == 1)[edge_of.reshape(-1)].reshape(-1, 3)
    border_vertex = np.zeros(inner.shape[1], dtype=bool)
    border_vertex[edges[border_edge.reshape(-1)]] = True
    border_corner = border_vertex[faces]
    shares = [_through(o, i, faces, border_edge, border_corner) for o, i in zip(outer, inner, strict=True)]
    return float(np.mean(shares))


def _through(
    outer: np.ndarray, inner: np.ndarray, faces: np.ndarray, border_edge: np.ndarray, border_corner: np.ndarray
) -> float:
    """Share in one frame. A barycentric coordinate of 0 puts the closest point on an edge, one of 1 on a corner."""
    inner = np.ascontiguousarray(inner, dtype=np.float64)
    sign = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    distance, face, closest, _ = igl.signed_distance(np.ascontiguousarray(outer, dtype=np.float64), inner, faces, sign)
    a, b, c = (inner[faces[face, k]] for k in range(3))
    barycentric = _barycentric(closest, a, b, c)
    at_border = ((barycentric < 1e-6) & border_edge[face]).any(axis=1)
    at_border |= ((barycentric > 1 - 1e-6) & border_corner[face]).any(axis=1)
    return float(((distance < 0) & ~at_border).mean())


def _barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = (np.einsum("ij,ij->i", x, y) for x, y in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    area = np.maximum(uu * vv - uv * uv, 1e-300)
    beta, gamma = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    return np.stack([1 - beta - gamma, beta, gamma], axis=1)


def _frames(positions: Any, name: str) -> np.ndarray:
    array = to_numpy(positions)
    if array.ndim not in (2, 3) or array.shape[-1] != 3 or array.size == 0 or array.dtype.kind not in "fiu":
        raise ValueError(
            f"{name} must have shape [V,3] or [T,V,3] and hold numbers, got {array.dtype} {list(array.shape)}"
        )
    return array[None] if array.ndim == 2 else array


def _same_frames(a: np.ndarray, b: np.ndarray, name_a: str, name_b: str) -> tuple[np.ndarray, np.ndarray]:
    frames = max(len(a), len(b))
    if any(len(x) not in (1, frames) for x in (a, b)):
        raise ValueError(f"{name_a} has {len(a)} frames and {name_b} {len(b)}; give the same number, or one for all")
    return np.broadcast_to(a, (frames, *a.shape[1:])), np.broadcast_to(b, (frames, *b.shape[1:]))


def _body_distance(vertices: Any, body_vertices: Any, body_faces: Any) -> np.ndarray:
    """Signed distances [m], shape [T,V]; nan where a position is not finite."""
    points, body = _frames(vertices, "vertices"), _frames(body_vertices, "body_vertices")
    faces = checked_faces(body_faces, body.shape[1], name="body_faces")
    points, body = _same_frames(points, body, "vertices", "body_vertices")
    if not np.isfinite(body).all():
        return np.full(points.shape[:2], np.nan)
    faces = turned_outward(body[0], faces, "the body")
    meshes = BodyMeshes(_tensor(body[0]), torch.from_numpy(faces))
    result = np.empty(points.shape[:2])
    still = body.strides[0] == 0
    for frame, (p, u) in enumerate(zip(points, body, strict=True)):
        if frame and not still:
            meshes.update(_tensor(u))
        result[frame] = meshes.query(_tensor(p)).distance.numpy()
    return result


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))
