"""Linear blend skinning: a body's motion as bone transforms, a few hundred numbers a frame."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from warpgarment.errors import MeshError

from .checks import checked_positions, complain, to_numpy

MOST = 250_000  # numbers of the blended transforms of a block of frames: 2 MB, which stay in the cache of a core


def linear_blend_skinning(
    rest_vertices: np.ndarray, bone_indices: np.ndarray, bone_weights: np.ndarray, bone_transforms: np.ndarray
) -> np.ndarray:
    """Posed vertices v' = sum_k w_k (R_k v + t_k), over the bones k that move a vertex.

    The blended transform of each vertex is one sparse product for a block of frames, summed in float64.

    Args:
        rest_vertices: Positions in the rest pose [m], shape [V,3].
        bone_indices: Bones that move each vertex, integers, shape [V,K].
        bone_weights: Weight of each of these bones, every row summing to 1, shape [V,K].
        bone_transforms: Rest-to-posed transforms [R | t] of each bone, shape [T,B,3,4].

    Returns:
        Posed positions [m], float32, shape [T,V,3].

    Raises:
        MeshError: Shapes do not fit each other, a bone does not exist, weights do not sum to 1, or a number is not
            finite.
    """
    rest = checked_positions(rest_vertices, name="rest_vertices").astype(np.float64)
    indices, weights, transforms = map(to_numpy, (bone_indices, bone_weights, bone_transforms))
    for name, array in (("bone_weights", weights), ("bone_transforms", transforms)):
        if array.dtype.kind not in "fiu":
            raise MeshError(f"{name} must be numbers, got {array.dtype}.")
    weights, transforms = weights.astype(np.float64), transforms.astype(np.float64)
    count = len(rest)
    if indices.ndim != 2 or len(indices) != count or weights.shape != indices.shape or indices.dtype.kind not in "iu":
        raise MeshError(
            f"bone_indices and bone_weights must be [V,K] with V = {count:,} as in rest_vertices, "
            f"got {indices.dtype} {list(indices.shape)} and {list(weights.shape)}."
        )
    if transforms.ndim != 4 or transforms.shape[2:] != (3, 4) or transforms.size == 0:
        raise MeshError(f"bone_transforms must have shape [T,B,3,4], got {list(transforms.shape)}.")
    frames, bones = transforms.shape[:2]
    lost = ((indices < 0) | (indices >= bones)).any(axis=1)
    complain(lost, "vertices", f"name bones beyond the {bones} of bone_transforms", "Repair bone_indices.", "vertex")
    uneven = ~(np.abs(weights.sum(axis=1) - 1.0) < 1e-3)
    complain(uneven, "vertices", "have bone weights that do not sum to 1", "Normalise bone_weights.", "vertex")
    broken = np.asarray(~np.isfinite(transforms).all(axis=(1, 2, 3)))
    complain(
        broken, "frames", "have bone transforms that are NaN or infinite",
        "Drop these frames or repair what wrote them.",
    )  # fmt: skip
    rows = np.repeat(np.arange(count), indices.shape[1])
    blend = csr_matrix((weights.reshape(-1), (rows, indices.reshape(-1).astype(np.int64))), shape=(count, bones))
    posed = np.empty((frames, count, 3), dtype=np.float32)
    block = max(1, MOST // (12 * count))
    for start in range(0, frames, block):
        part = transforms[start : start + block]
        flat = part.transpose(1, 0, 2, 3).reshape(bones, -1)
        vertex_transforms = (blend @ flat).reshape(count, -1, 3, 4)
        moved = np.einsum("vtij,vj->tvi", vertex_transforms[..., :3], rest)
        posed[start : start + block] = moved + vertex_transforms[..., 3].transpose(1, 0, 2)
    return posed
