"""A hundred garments in one batch: dresses and T-shirts of a hundred lengths on one walking body, and their picture.

python examples/07_a_hundred_garments.py
"""

import sys
import time
from pathlib import Path

import numpy as np
import trimesh
import tyro

import warpgarment as wg


def shortened(garment: wg.Garment, first: np.ndarray, share: float, name: str) -> tuple[wg.Garment, np.ndarray]:
    """A garment without its lowest part, and its first frame.

    Args:
        garment: The garment.
        first: Its positions in the first frame [m], shape [V,3].
        share: Share of its height that is cut off.
        name: Name of the result.
    """
    height = garment.vertices[:, 1]
    kept = (height[garment.faces] > height.min() + share * np.ptp(height)).all(1)
    faces = garment.faces[kept]
    pairs = trimesh.graph.face_adjacency(faces)
    piece = trimesh.graph.connected_component_labels(pairs, node_count=len(faces))
    faces = faces[piece == np.bincount(piece).argmax()]  # a cut may leave crumbs
    used, numbers = np.unique(faces, return_inverse=True)
    return wg.Garment(garment.vertices[used], numbers.reshape(-1, 3), name=name), first[used]


def main(out: Path = Path("out/hundred"), count: int = 100, frames: int = 20) -> None:
    assets = wg.demo.assets()
    garments, starts = [], []
    for number in range(count):
        item = assets.garments[("dress", "tshirt")[number % 2]]
        share = 0.4 * number / count
        garment, first = shortened(item.garment, item.first_vertices, share, f"{item.garment.name}_{number:03}")
        garments.append(garment)
        starts.append(first)
    simulator = wg.Simulator.from_pretrained("default")
    needed = wg.memory.predict(garments, [assets.collider], simulator.network.config, device=simulator.device)
    print(f"{count} garments, {sum(len(g.faces) for g in garments):,} faces, {needed.total / 1e9:.1f} GB")

    began = time.perf_counter()
    motions = simulator.rollout(
        garments, assets.collider, first_vertices=starts, frames=frames, progress=sys.stderr.isatty()
    )
    spent = time.perf_counter() - began
    deepest = max(motion.status[-1].max_penetration for motion in motions)
    each = 1e3 * spent / (count * (frames - 1))
    print(
        f"{frames} frames in {spent:.0f} s, {each:.1f} ms for a garment and frame; {1e3 * deepest:.1f} mm deep at most"
    )

    body = wg.BodyMotion(assets.body.vertices[:frames], assets.body.faces, assets.body.fps)
    size, across = (90, 150), int(np.ceil(np.sqrt(count)))
    camera = wg.draw.chase([body, motions[0]], size=size)
    pictures = []
    for number, motion in enumerate(motions):
        colors = [wg.draw.PALETTE[number % len(wg.draw.PALETTE)]]
        pictures += wg.draw.film(body, [motion], size=size, colors=colors, frames=[frames - 1], camera=camera)
    pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % across)
    rows = [np.concatenate(pictures[k : k + across], axis=1) for k in range(0, len(pictures), across)]
    wg.draw.write_png(out / "hundred.png", np.concatenate(rows))
    print(f"wrote {out}/hundred.png")


if __name__ == "__main__":
    tyro.cli(main)
