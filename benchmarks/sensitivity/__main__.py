"""How far rounding carries a rollout: noise on the first frame, numbers of threads, batches.

    python -m benchmarks.sensitivity                                   # the demo's garments, 40 frames, network `fast`
    python -m benchmarks.sensitivity --network small --noise 1e-7 1e-6 1e-5 --seeds 5 --frames 80

A rollout repeated on the same machine with the same number of threads is the same, bit for bit. Its frames depend on
those before: whether a vertex is in contact, and whether another pass of the collisions follows, is a comparison of
numbers, and the last bit can decide it. Beside each distance stands the first frame in which the number of collision
iterations differs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
import torch

import warpgarment as wg


def compared(one: wg.GarmentMotion, other: wg.GarmentMotion) -> str:
    """Distance of the vertices of two rollouts in their last frame, and where they part, as one line."""
    apart = 1000.0 * np.linalg.norm(one.vertices - other.vertices, axis=-1)
    if not apart.any():
        return "the same bits"
    counts = [[getattr(status, "collision_iterations", 0) for status in motion.status or ()] for motion in (one, other)]
    turns = [frame for frame, (a, b) in enumerate(zip(*counts, strict=True)) if a != b]
    turn = f"collisions take another turn in frame {turns[0]}" if turns else "collisions take the same turns"
    return (
        f"{apart[-1].mean():.2g} mm apart on average in the last frame, {apart.max():.2g} at most in any; "
        f"bits differ from frame {int(np.nonzero(apart.any(axis=1))[0][0])}, {turn}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a line for each comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", default="fast", help="one that ships, or a file")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--noise", type=float, nargs="*", default=[1e-8, 1e-7, 1e-6, 1e-5], help="sigma [m]")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--threads", type=int, nargs="*", default=[2], help="numbers compared with one thread")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    assets = wg.demo.assets()
    simulator = wg.Simulator.from_pretrained(options.network, device="cpu")
    names = sorted(assets.garments)
    garments = [assets.garments[name].garment for name in names]
    first = [assets.garments[name].first_vertices for name in names]

    def alone(number: int, start: np.ndarray) -> wg.GarmentMotion:
        return simulator.rollout(garments[number], assets.collider, first_vertices=start, frames=options.frames)

    kept = [alone(number, start) for number, start in enumerate(first)]
    batch = simulator.rollout(
        [*garments, *garments], assets.collider, first_vertices=[*first, *first], frames=options.frames
    )
    for number, name in enumerate(names):
        print(f"{name}, again: {compared(kept[number], alone(number, first[number]))}", flush=True)
        print(f"{name}, in a batch of {len(batch)}: {compared(kept[number], batch[number])}", flush=True)
        for threads in options.threads:
            torch.set_num_threads(threads)
            print(f"{name}, {threads} threads: {compared(kept[number], alone(number, first[number]))}", flush=True)
            torch.set_num_threads(1)
        for sigma in options.noise:
            for seed in range(options.seeds):
                noise = np.random.default_rng(seed).normal(0.0, sigma, first[number].shape)
                moved = (first[number] + noise).astype(np.float32)
                print(
                    f"{name}, noise of {sigma:g} m, seed {seed}: {compared(kept[number], alone(number, moved))}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
