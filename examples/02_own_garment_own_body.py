"""Your garment on your body: a garment from a file, any deforming triangle mesh as the body, and `fit` between them.

The body need not be a person, let alone a parametric one. Here it is a bottle that bows and turns, and the garment is a
sleeve for it, modelled in centimetres around the upright bottle.

python examples/02_own_garment_own_body.py
"""

from pathlib import Path

import numpy as np
import tyro

import warpgarment as wg


def lathe(heights: np.ndarray, radii: np.ndarray, around: int) -> tuple[np.ndarray, np.ndarray]:
    """A surface of revolution about Y from bottom to top, with faces counter-clockwise seen from outside.

    Args:
        heights: Heights of the rings [m], shape [R].
        radii: Radii of the rings [m], shape [R].
        around: Number of vertices in a ring.

    Returns:
        Vertices [m], shape [V, 3], and faces, shape [F, 3].
    """
    angle = 2 * np.pi * np.arange(around) / around
    x, z = radii[:, None] * np.sin(angle), radii[:, None] * np.cos(angle)
    y = np.broadcast_to(heights[:, None], x.shape)
    row, column = np.meshgrid(np.arange(len(heights) - 1), np.arange(around), indexing="ij")
    a, b = row * around + column, row * around + (column + 1) % around
    quads = [np.stack([a, b, b + around], -1), np.stack([a, b + around, a + around], -1)]
    return np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate([q.reshape(-1, 3) for q in quads])


def bottle_motion(frames: int) -> tuple[np.ndarray, wg.BodyMotion]:
    """An upright bottle (the rest pose), and its motion, which is already bent in its first frame."""
    heights = np.linspace(0, 1.2, 49)
    radii = 0.10 + 0.10 * np.exp(-(((heights - 0.45) / 0.28) ** 2))
    radii[[0, -1]] = 1e-3  # closed except for a pinhole
    rest, faces = lathe(heights, radii, 40)
    posed = []
    for t in range(frames):
        bend = 0.35 * np.cos(2 * np.pi * t / 60) * rest[:, 1] ** 2  # grows with height
        turn = 0.02 * t
        x, z = rest[:, 0] + bend, rest[:, 2]
        c, s = np.cos(turn), np.sin(turn)
        posed.append(np.stack([c * x + s * z, rest[:, 1], c * z - s * x], -1))
    return rest, wg.BodyMotion(np.stack(posed), faces, fps=30.0)


def main(out: Path = Path("out/own_garment"), frames: int = 60) -> None:
    out.mkdir(parents=True, exist_ok=True)
    rest, motion = bottle_motion(frames)
    motion.save(out / "bottle.pc2")  # with bottle.obj beside it, as Blender and Houdini write it

    heights = np.linspace(25, 75, 15)  # centimetres
    sleeve, faces = lathe(heights, 12.0 + 10.0 * np.exp(-(((heights - 45) / 28) ** 2)), 30)
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in sleeve] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (out / "sleeve.obj").write_text("\n".join(lines) + "\n")

    # From here on, the files could be your own.
    garment = wg.Garment.load(out / "sleeve.obj", unit="cm")
    body = wg.BodyMotion.load(out / "bottle.pc2", fps=30.0)
    first = wg.fit(garment, (rest, body.faces), body.vertices[0])
    simulator = wg.Simulator.from_pretrained("default")
    result = simulator.rollout(garment, body, first_vertices=first)

    print(f"{garment} on {body}")
    depth = wg.metrics.max_penetration(result.vertices, body.vertices, body.faces)
    print(f"deepest penetration {1e3 * depth:.1f} mm, last frame: {result.status[-1].message}")
    result.save(out / "sleeve.usd")
    wg.draw.contact_sheet(out / "sleeve.png", body, [result], frames=6)
    print(f"wrote {out}/sleeve.usd and {out}/sleeve.png")


if __name__ == "__main__":
    tyro.cli(main)
