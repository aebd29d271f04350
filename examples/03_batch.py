"""Several garments on several bodies in one batch, with the motions of single rollouts but fewer launches.

python examples/03_batch.py
"""

import time
from pathlib import Path

import numpy as np
import tyro

import warpgarment as wg


def main(out: Path = Path("out/batch"), frames: int = 60) -> None:
    assets = wg.demo.assets()
    dress, tshirt = assets.garments["dress"], assets.garments["tshirt"]
    walk = assets.collider
    turned = wg.BodyMotion(walk.vertices * np.float32([-1, 1, -1]), walk.faces, walk.fps)  # half a turn about Y
    slow = wg.BodyMotion(walk.vertices, walk.faces, fps=20.0)  # resampled to the network's rate

    garments = [dress.garment, tshirt.garment, dress.garment, tshirt.garment]
    bodies = [walk, walk, turned, slow]  # one per garment; a body may occur several times
    first = [dress.first_vertices, tshirt.first_vertices, dress.first_vertices * [-1, 1, -1], tshirt.first_vertices]

    simulator = wg.Simulator.from_pretrained("default")
    began = time.perf_counter()
    together = simulator.rollout(garments, bodies, first_vertices=first, frames=frames)
    batched = time.perf_counter() - began

    began = time.perf_counter()
    singly = [
        simulator.rollout(garment, body, first_vertices=vertices, frames=frames)
        for garment, body, vertices in zip(garments, bodies, first, strict=True)
    ]
    one_by_one = time.perf_counter() - began

    print(f"{len(garments)} garments, {frames} frames: {batched:.1f} s in a batch, {one_by_one:.1f} s one by one")
    for a, b in zip(together, singly, strict=True):
        apart = np.abs(a.vertices - b.vertices).max()
        print(
            f"{a.name:8} {a.frames} frames, {a.status[-1].verdict.value}, {1e3 * apart:.3f} mm from the single rollout"
        )
    for index, motion in enumerate(together):
        motion.save(out / f"{index}_{motion.name}.pc2")
    rows = [(f"{m.name} on body {k}", [m], [wg.draw.PALETTE[k]]) for k, m in enumerate(together)]
    wg.draw.sheet(out / "batch.png", None, rows, frames=6)
    print(f"wrote {len(together)} motions and batch.png to {out}")


if __name__ == "__main__":
    tyro.cli(main)
