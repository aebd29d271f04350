"""The bundled rest body, and a BVH writer for the tests of motions."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from warpgarment import demo
from warpgarment.training.bodies import RestBody


@lru_cache(maxsize=1)
def rest_body() -> RestBody:
    """The body that ships with the demo, in its rest pose."""
    return RestBody.load(Path(demo.ASSETS) / "rest_body.npz")


def write_bvh(path: Path, joints: list[tuple[str, str | None, tuple[float, float, float]]], frames, fps=30.0) -> Path:
    """Writes a BVH file.

    Args:
        path: The file.
        joints: Name, parent (None for the root) and offset, parents first.
        frames: Per frame the root's position, then Z, X, Y rotations [degrees] of every joint in depth-first order.
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
