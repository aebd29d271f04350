"""A live body: each frame is simulated as soon as the body's next pose is known.

python examples/04_live_body.py
"""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tyro

import warpgarment as wg


def tracked_body(motion: wg.BodyMotion, frames: int) -> Iterator[np.ndarray]:
    """A stand-in for a camera, a game or a simulation that yields vertices [m], [U, 3], 30 times per second."""
    yield from motion.vertices[1:frames]


def main(out: Path = Path("out/live"), frames: int = 60) -> None:
    assets = wg.demo.assets()
    shirt, body = assets.garments["tshirt"], assets.collider
    simulator = wg.Simulator.from_pretrained("default")

    state = simulator.start(shirt.garment, body.vertices[0], body.faces, first_vertices=shirt.first_vertices)
    shown, latency = [state.vertices], []
    for next_body in tracked_body(body, frames):
        began = time.perf_counter()
        state = simulator.step(state, next_body)
        shown.append(state.vertices)  # here you would draw or send them
        latency.append(time.perf_counter() - began)
        if not state.status.finite:
            print(state.status.message)
            break

    median, slowest = 1e3 * np.median(latency), 1e3 * max(latency[1:], default=latency[0])
    print(f"{len(shown)} frames on {simulator.device}: {median:.0f} ms in the median, {slowest:.0f} ms at most")
    motion = wg.GarmentMotion(np.stack(shown), shirt.garment.faces, fps=30.0, name="tshirt")
    motion.save(out / "tshirt.npz")
    seen = wg.BodyMotion(assets.body.vertices[: motion.frames], assets.body.faces, assets.body.fps)
    wg.draw.contact_sheet(out / "tshirt.png", seen, [motion], frames=6)
    print(f"wrote {out}/tshirt.npz and {out}/tshirt.png")


if __name__ == "__main__":
    tyro.cli(main)
