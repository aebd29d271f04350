"""Training on your own simulations: write them as sequences, train, roll the new network out.

Here a single bundled simulation takes the place of yours, and a minute of training that of hours: the loss falls, but
do not expect a good network. `warpgarment train --data DIR --out DIR` trains from the command line.

python examples/05_train_on_own_data.py
"""

import json
from pathlib import Path

import numpy as np
import tyro

import warpgarment as wg
from warpgarment.training.data.sequence import write_sequence
from warpgarment.training.train.config import TrainConfig
from warpgarment.training.train.start import train


def write_own_data(folder: Path, frames: int) -> None:
    """Writes one folder per sequence: a garment's rest mesh and motion, a body's rest mesh, bones and transforms."""
    dress = wg.demo.assets().garments["dress"]
    with np.load(wg.demo.ASSETS / "body.npz") as body:
        arrays = {
            "garment_rest_vertices": dress.garment.vertices,
            "garment_faces": dress.garment.faces,
            "pins": dress.garment.pins,
            "garment_vertices": dress.truth.vertices[:frames],  # the result of your simulator [m], Y up
            "body_rest_vertices": body["rest_vertices"],
            "body_faces": body["faces"],
            "collider_faces": body["collider_faces"],
            "bone_indices": body["bone_indices"],
            "bone_weights": body["bone_weights"],
            "bone_transforms": body["bone_transforms"][:frames],
        }
    manifest = {"status": "good", "split": "train", "garment": "dress", "motion": "walk", "fps": 30.0, "frames": frames}
    if not (folder / "dress_walk").exists():
        write_sequence(folder / "dress_walk", arrays, manifest)


def main(out: Path = Path("out/own_training"), frames: int = 60, steps: int = 60, batch_size: int = 4) -> None:
    write_own_data(out / "data", frames)
    config = TrainConfig(
        data=out / "data",
        out=out / "run",
        network="small",
        steps=steps,
        batch_size=batch_size,
        statistics_batches=2,
        log_every=max(1, steps // 6),
    )
    path = train(config)
    for line in (out / "run" / "log.jsonl").read_text().splitlines():
        entry = json.loads(line)
        if "loss" in entry:
            print(f"step {entry['step']:4}  loss {entry['loss']:.3f}")

    assets = wg.demo.assets()
    dress = assets.garments["dress"]
    simulator = wg.Simulator.from_pretrained(path)
    motion = simulator.rollout(
        dress.garment, assets.collider, first_vertices=dress.first_vertices, frames=min(frames, 20)
    )
    body = wg.BodyMotion(assets.body.vertices[: motion.frames], assets.body.faces, assets.body.fps)
    truth = wg.GarmentMotion(dress.truth.vertices[: motion.frames], dress.truth.faces, dress.truth.fps)
    wg.draw.contact_sheet(out / "dress.png", body, [motion], [truth], frames=6)
    error = wg.metrics.mean_vertex_error(motion.vertices, dress.truth.vertices[: motion.frames])
    print(f"{path}: {error:.2f} cm from the truth after {motion.frames} frames")


if __name__ == "__main__":
    tyro.cli(main)
