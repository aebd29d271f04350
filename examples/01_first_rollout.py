"""A bundled dress on a bundled walking body is rolled out, compared with physics, and saved as USD and as a picture.

python examples/01_first_rollout.py
"""

from pathlib import Path

import tyro

import warpgarment as wg


def main(out: Path = Path("out/first_rollout"), frames: int = 90) -> None:
    assets = wg.demo.assets()
    dress = assets.garments["dress"]  # a garment at rest, and its motion by a physics simulation
    simulator = wg.Simulator.from_pretrained("default")

    # `collider` is the body without hands; the first frame is the dress as it hangs on the body
    motion = simulator.rollout(dress.garment, assets.collider, first_vertices=dress.first_vertices, frames=frames)

    error = wg.metrics.mean_vertex_error(motion.vertices, dress.truth.vertices[: motion.frames])
    deepest = max(status.max_penetration for status in motion.status[1:])
    print(f"{motion.frames} frames of {len(motion.faces):,} faces on {simulator.device}")
    print(f"mean vertex error {error:.2f} cm, deepest penetration {1e3 * deepest:.1f} mm")

    motion.save(out / "dress.usd")
    body = wg.BodyMotion(assets.body.vertices[: motion.frames], assets.body.faces, assets.body.fps)
    wg.draw.contact_sheet(out / "dress.png", body, [motion], [dress.truth], frames=6)
    print(f"wrote {out}/dress.usd and {out}/dress.png")


if __name__ == "__main__":
    tyro.cli(main)
