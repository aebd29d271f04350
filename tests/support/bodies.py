"""The bundled rest body, and writers of BVH and AMASS files for the tests of motions."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from support import meshes
from warpgarment.bodies.rest import RestBody, bundled_body

SMPL_JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip


@lru_cache(maxsize=1)
def rest_body() -> RestBody:
    """The demo's body in its rest pose."""
    return bundled_body()


def write_bvh(path: Path, joints: list[tuple[str, str | None, tuple[float, float, float]]], frames, fps=30.0) -> Path:
    """Writes a BVH file.

    Args:
        path: File to write.
        joints: Name, parent (None for the root) and offset from the parent of each joint; parents come first.
        frames: For each frame, the root's position, then Z, X, Y rotations of every joint in depth-first order
            [degrees].
        fps: Frames per second.
    """
    children = {name: [j for j in joints if j[1] == name] for name, _, _ in joints}
    lines = ["HIERARCHY"]

    def write(joint, depth):
        name, parent, offset = joint
        pad = "  " * depth
        lines.append(f"{pad}{'ROOT' if parent is None else 'JOINT'} {name}")
        lines.append(pad + "{")
        lines.append(f"{pad}  OFFSET {offset[0]} {offset[1]} {offset[2]}")
        position = "6 Xposition Yposition Zposition" if parent is None else "3"
        lines.append(f"{pad}  CHANNELS {position} Zrotation Xrotation Yrotation")
        for child in children[name]:
            write(child, depth + 1)
        if not children[name]:
            lines.extend([f"{pad}  End Site", pad + "  {", f"{pad}    OFFSET 0 1 0", pad + "  }"])
        lines.append(pad + "}")

    write(joints[0], 0)
    lines += ["MOTION", f"Frames: {len(frames)}", f"Frame Time: {1.0 / fps:.7f}"]
    lines += [" ".join(f"{v:.6f}" for v in frame) for frame in frames]
    path.write_text("\n".join(lines))
    return path


def write_amass(path: Path, turns: dict[str, np.ndarray], frames: int, rate: float | None = 120.0, **more) -> Path:
    """Writes an AMASS motion in SMPL-H's order.

    Args:
        path: File to write.
        turns: Axis-angles of the joints that turn, by SMPL's names [rad], shape [T, 3] or [3].
        frames: Number of frames T.
        rate: Frames per second; None leaves the rate out of the file.
        more: Other arrays by name, which replace those made here; None leaves an array out of the file.
    """
    poses = np.zeros((frames, 52, 3))
    for name, turn in turns.items():
        poses[:, SMPL_JOINTS.index(name)] = turn
    arrays = {"poses": poses.reshape(frames, -1), "trans": np.zeros((frames, 3)), "betas": np.zeros(16)}
    arrays |= {"gender": np.array("neutral"), "mocap_framerate": None if rate is None else np.array(rate)} | more
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def points_around(mesh: meshes.Mesh, count: int = 1500, seed: int = 0) -> np.ndarray:
    """Points [m], float32 [N, 3]: half of them anywhere in a box around the mesh, half close to its surface, within a
    few hundredths of the mesh's size."""
    rng = np.random.default_rng(seed)
    low, high = mesh.vertices.min(0).astype(float), mesh.vertices.max(0).astype(float)
    size = np.linalg.norm(high - low)
    anywhere = rng.uniform(low - 0.3 * size, high + 0.3 * size, (count // 2, 3))
    corners = mesh.vertices[mesh.faces[rng.integers(0, len(mesh.faces), count - count // 2)]].astype(float)
    near = np.einsum("nk,nkj->nj", rng.dirichlet(np.ones(3), len(corners)), corners)
    near += rng.normal(scale=0.02 * size, size=near.shape)
    return np.concatenate([anywhere, near]).astype(np.float32)
