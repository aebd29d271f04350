"""Bodies for garments: Anny's shape space on a light template, Y up, facing +Z, in metres.

Anny (Apache-2.0 over CC0 data) gives rest vertices, joints and skinning weights for any phenotype. Its surface has
24,540 faces, more than cloth contact and signed distances need, so the template here is that surface remeshed once
to about 6,000 even triangles; each of its vertices is a fixed barycentric point of the original, which makes it valid
for every phenotype. Anny's first load takes minutes; the data used here are kept in a small cache file.
"""

from __future__ import annotations

import contextlib
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError, MissingExtra
from warpgarment.geometry.cutting import averaging, boundary_loops, compacted, without_short_edges
from warpgarment.io.disk.cache import cache_folder
from warpgarment.io.npz import read_npz, write_npz

from .rest import PHENOTYPES, RestBody

TEMPLATE_FACES = 6000
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # Anny is Z up and faces -Y
_CACHE_VERSION = 2
_TEMPLATE = (
    "faces", "corners", "barycentric", "hole_loops", "hole_lengths", "bone_indices", "bone_weights", "bone_names",
    "bone_parents",
)  # fmt: skip


def sampled_phenotype(rng: np.random.Generator) -> dict[str, float]:
    """Anny's values of a random person, 1.4 to 2.1 m tall: a woman or man, teenager (0.5) to old (1), of any build."""
    woman = rng.random() < 0.5
    return {
        "gender": float(rng.uniform(0.85, 1.0) if woman else rng.uniform(0.0, 0.15)),
        "age": float(rng.uniform(0.5, 1.0)),
        "muscle": float(rng.uniform(0.15, 0.85)),
        "weight": float(rng.uniform(0.1, 0.9)),
        "height": float(np.clip(rng.normal(0.5, 0.1), 0.3, 0.7)),
        "proportions": float(rng.uniform(0.2, 0.8)),
    }


class AnnyBodies:
    """Anny's shape space evaluated on the light template; made by :func:`anny_bodies`."""

    def __init__(self, data: dict[str, np.ndarray]):
        self._data = data
        self._model = None

    def rest(self, **phenotype: float) -> RestBody:
        """The body of a phenotype. Values lie in 0..1; those that are not given are 0.5 (age 0.7)."""
        unknown = sorted(set(phenotype) - set(PHENOTYPES))
        if unknown:
            raise ValueError(f"unknown phenotypes {unknown}; Anny has {list(PHENOTYPES)}")
        values = {name: 0.7 if name == "age" else 0.5 for name in PHENOTYPES} | phenotype
        full, joints = _evaluate(_load_anny(), values)
        data = self._data
        loops = np.split(data["hole_loops"], np.cumsum(data["hole_lengths"])[:-1])
        full = _with_hole_centres(full, loops)
        vertices = smoothed(np.einsum("vk,vkc->vc", data["barycentric"], full[data["corners"]]), data["faces"])
        lift = -np.array([0.0, vertices[:, 1].min(), 0.0])  # feet on the floor
        return RestBody(
            vertices=vertices + lift,
            faces=data["faces"],
            joints=joints + lift,
            bone_names=tuple(str(n) for n in data["bone_names"]),
            bone_parents=tuple(int(p) for p in data["bone_parents"]),
            bone_indices=data["bone_indices"],
            bone_weights=data["bone_weights"],
            phenotype=values,
        )


@lru_cache(maxsize=1)
def _load_anny() -> Any:
    try:
        import anny
        import torch
    except ImportError as error:
        raise MissingExtra("bodies", "Making bodies with Anny") from error
    os.environ.setdefault("ANNY_CACHE_DIR", str(cache_folder() / "anny"))
    model = anny.Anny(rig="cmu_mb", topology="notoes", pose_parameterization="world-orient")
    return model.to(torch.float32)


def _evaluate(model: Any, phenotype: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Rest vertices [12272, 3] and bone heads [B, 3] of a phenotype [m], Y up."""
    import torch

    pose = torch.eye(4)[None, None].repeat(1, model.bone_count, 1, 1)
    with torch.no_grad():
        out = model(pose_parameters=pose, phenotype_kwargs=dict(phenotype))
    vertices = out["rest_vertices"][0].double().numpy() @ _Y_UP.T
    joints = out["rest_bone_poses"][0, :, :3, 3].double().numpy() @ _Y_UP.T
    return vertices, joints


@lru_cache(maxsize=1)
def anny_bodies() -> AnnyBodies:
    """Anny on the light template; the first call on a machine builds the cache (about two minutes)."""
    cache = cache_folder() / f"anny_template_{TEMPLATE_FACES}_v{_CACHE_VERSION}.npz"
    data = _read_template(cache)
    if data is None:
        data = _build_template()
        with contextlib.suppress(OSError):  # no room, no permission: it is only a cache
            write_npz(cache, data)
    return AnnyBodies(data)


def _read_template(cache: Path) -> dict[str, np.ndarray] | None:
    """The template from its cache; None where there is none, or it is not what was written (zip's CRCs)."""
    try:
        return {key: array for key, array in read_npz(cache, _TEMPLATE).items() if key in _TEMPLATE}
    except (OSError, MeshError):
        return None


def _build_template() -> dict[str, np.ndarray]:
    """Simplifies Anny's surface once; every template vertex becomes a barycentric point of the original."""
    import igl
    from gpytoolbox import remesh_botsch

    model = _load_anny()
    full, _ = _evaluate(model, {name: 0.7 if name == "age" else 0.5 for name in PHENOTYPES})
    faces = np.asarray(model.faces, dtype=np.int64)
    faces, loops = _holes_without_cavities(full, faces)
    fans = [
        np.stack([np.full(len(loop), len(full) + k), np.roll(loop, -1), loop], axis=1) for k, loop in enumerate(loops)
    ]
    full, faces = _with_hole_centres(full, loops), np.concatenate([faces, *fans])
    area = 0.5 * np.asarray(igl.doublearea(full, faces)).sum()
    edge = float(np.sqrt(area * 4.0 / (np.sqrt(3.0) * TEMPLATE_FACES)))
    vertices, template_faces = remesh_botsch(*compacted(full, faces.astype(np.int32)), i=12, h=edge, project=True)
    vertices, template_faces = without_short_edges(vertices, template_faces, 0.35 * edge)
    _, nearest, points = igl.point_mesh_squared_distance(vertices, full, faces)
    corners = faces[nearest]
    barycentric = _barycentric(points, full[corners])
    bone_indices, bone_weights = _interpolate_weights(
        model.vertex_bone_indices.numpy(),
        model.vertex_bone_weights.numpy(),
        loops,
        corners,
        barycentric,
        model.bone_count,
    )
    return {
        "faces": template_faces.astype(np.int32),
        "corners": corners.astype(np.int32),
        "barycentric": barycentric,
        "hole_loops": np.concatenate(loops).astype(np.int32),
        "hole_lengths": np.array([len(loop) for loop in loops], dtype=np.int32),
        "bone_indices": bone_indices,
        "bone_weights": bone_weights,
        "bone_names": np.array(list(model.bone_labels)),
        "bone_parents": np.array([int(p) for p in model.bone_parents], dtype=np.int32),
    }


def _holes_without_cavities(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Faces of the surface without mouth and eye sockets, which see no daylight, and loops of the new holes."""
    import igl

    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centres = corners.mean(1)
    hidden = np.asarray(igl.ambient_occlusion(vertices, faces, centres + 1e-4 * normals, normals, 64)).ravel() > 0.85
    in_head = centres[:, 1] > vertices[:, 1].max() - 0.3
    open_faces = faces[~(hidden & in_head)]
    _, piece = igl.facet_components(open_faces)
    piece = np.asarray(piece).ravel()
    open_faces = open_faces[piece == np.bincount(piece).argmax()]
    return open_faces, boundary_loops(open_faces)


def _with_hole_centres(values: np.ndarray, loops: list[np.ndarray]) -> np.ndarray:
    """Appends to per-vertex values the mean over each loop, for the vertices that close the holes."""
    return np.concatenate([values, *(values[loop].mean(0, keepdims=True) for loop in loops)])


def _barycentric(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Barycentric coordinates [N, 3] of points [N, 3] in triangles [N, 3, 3], clipped to the triangle."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = points - triangles[:, 0]
    aa, ab, bb = (a * a).sum(1), (a * b).sum(1), (b * b).sum(1)
    pa, pb = (p * a).sum(1), (p * b).sum(1)
    determinant = np.maximum(aa * bb - ab * ab, 1e-30)
    v, w = (bb * pa - ab * pb) / determinant, (aa * pb - ab * pa) / determinant
    weights = np.clip(np.stack([1 - v - w, v, w], 1), 0, 1)
    return weights / weights.sum(1, keepdims=True)


def smoothed(vertices: np.ndarray, faces: np.ndarray, rounds: int = 12) -> np.ndarray:
    """Taubin's smoothing (lambda 0.5, mu -0.53), which removes details that would poke through the faces of a garment.

    Args:
        vertices: Positions [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        rounds: Number of rounds.

    Returns:
        Positions [m], shape [V, 3].
    """
    mean = averaging(faces, len(vertices))
    for _ in range(rounds):
        for step in (0.5, -0.53):
            vertices = vertices + step * (mean @ vertices - vertices)
    return vertices


def _interpolate_weights(
    indices: np.ndarray,
    weights: np.ndarray,
    loops: list[np.ndarray],
    corners: np.ndarray,
    barycentric: np.ndarray,
    bones: int,
    keep: int = 4,
) -> tuple[np.ndarray, np.ndarray]:
    """Skinning weights of the template vertices: interpolated, reduced to the `keep` largest and renormalised."""
    dense = np.zeros((len(indices), bones))
    np.add.at(dense, (np.arange(len(indices))[:, None], indices), weights)
    mixed = np.einsum("vk,vkb->vb", barycentric, _with_hole_centres(dense, loops)[corners])
    order = np.argsort(-mixed, axis=1, kind="stable")[:, :keep]
    kept = np.take_along_axis(mixed, order, 1)
    return order.astype(np.uint8), (kept / kept.sum(1, keepdims=True)).astype(np.float32)
