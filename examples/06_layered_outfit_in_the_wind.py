"""Two garments over each other on a walking body, in the wind: an outfit, its materials, and what the status says.

python examples/06_layered_outfit_in_the_wind.py
"""

from pathlib import Path

import numpy as np
import tyro

import warpgarment as wg


def main(out: Path = Path("out/outfit"), frames: int = 90, weights: str = "layers") -> None:
    assets = wg.demo.assets()
    dress, jacket = assets.outfit.outfit
    outfit = wg.Outfit([dress, jacket], materials=[wg.Material.cotton(), wg.Material.denim()])  # innermost first
    gusts = 5.0 + 2.0 * np.sin(np.arange(frames) / 8.0)  # m/s, one for each frame of the body
    wind = wg.Wind([0.5, 0.0, -1.0], gusts, fps=assets.body.fps)

    simulator = wg.Simulator.from_pretrained(weights)
    known = {"first_vertices": assets.outfit.first_vertices, "frames": frames}
    if {"materials", "wind"} <= simulator.network.reads:
        motions = simulator.rollout(outfit, assets.collider, wind=wind, **known)
    else:
        print("this network reads neither materials nor wind; the garments move without")
        motions = simulator.rollout(wg.Outfit(outfit.garments), assets.collider, **known)

    for motion in motions:
        crossing = sum(bool(s.layer_crossings or s.self_crossings) for s in motion.status)
        counted = sum(s.layer_crossings is not None for s in motion.status)
        lag = max((s.lag or 0.0) for s in motion.status)
        print(
            f"{motion.name:8} {motion.frames} frames, {counted} of them counted, {crossing} with crossing triangles, "
            f"held back by up to {1e3 * lag:.0f} mm"
        )
        motion.save(out / f"{motion.name}.pc2")
    body = wg.BodyMotion(assets.body.vertices[:frames], assets.body.faces, assets.body.fps)
    wg.draw.sheet(out / "outfit.png", body, [("dress under jacket", motions, wg.draw.PALETTE)], frames=6)
    print(f"wrote {out}/outfit.png, and a .pc2 with .obj of each garment")


if __name__ == "__main__":
    tyro.cli(main)
