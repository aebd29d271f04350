"""Models with the arrays of SMPL's family, of random numbers: a real one may not be passed on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from warpgarment.bodies.amass import _JOINTS

_BODY = [parent for _, parent, _ in _JOINTS]
_FINGERS = [-1, 0, 1] * 5  # of a hand, relative to it: -1 hangs on the wrist


def _hands(first: int) -> list[int]:
    found = []
    for wrist, start in ((20, first), (21, first + 15)):
        found += [wrist if step == -1 else start + 3 * (k // 3) + step for k, step in enumerate(_FINGERS)]
    return found


PARENTS = {24: [*_BODY, 20, 21], 52: [*_BODY, *_hands(22)], 55: [*_BODY, 15, 15, 15, *_hands(25)]}


def write_model(path: Path, joints: int, count: int, **change: np.ndarray | None) -> tuple[Path, dict[str, np.ndarray]]:
    """Writes a model; returns its path and arrays.

    Args:
        path: File to write.
        joints: Number of joints: 24, 52 or 55.
        count: Number of vertices.
        change: Arrays by name in place of the model's; None leaves one out of the file.
    """
    rng = np.random.default_rng(joints)
    offsets = np.array([offset for _, _, offset in _JOINTS])
    places = np.zeros((joints, 3))
    for joint, parent in enumerate(PARENTS[joints][1:], start=1):
        places[joint] = places[parent] + (offsets[joint] if joint < len(offsets) else [0.03, 0.0, 0.0])
    sphere = np.array(trimesh.creation.icosphere(2).vertices)[:count]
    hull = trimesh.convex.convex_hull(sphere)  # a closed surface of the first vertices
    faces = np.array([[int(np.abs(sphere - hull.vertices[v]).sum(1).argmin()) for v in face] for face in hull.faces])
    template = sphere * [0.3, 0.9, 0.2] + rng.normal(0, 0.01, (count, 3))
    regressor = np.linalg.lstsq(np.c_[template, np.ones(count)].T, np.c_[places, np.ones(joints)].T, rcond=None)[0].T
    weights = rng.dirichlet(np.full(joints, 0.05), count)
    tree = np.array([[2**32 - 1, *PARENTS[joints][1:]], range(joints)], dtype=np.uint32)
    data = {
        "v_template": template, "f": faces.astype(np.uint32), "J_regressor": regressor, "weights": weights,
        "kintree_table": tree, "shapedirs": rng.normal(0, 0.01, (count, 3, 4)),
        "posedirs": rng.normal(0, 0.01, (count, 3, 9 * (joints - 1))),
    }  # fmt: skip
    np.savez(path, **{name: array for name, array in (data | change).items() if array is not None})
    return path, data
