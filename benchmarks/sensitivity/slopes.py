"""Gradients of a rollout beside central differences: the height of the back of the hem, with respect to the wind.

python -m benchmarks.sensitivity.slopes                # 10 and 20 frames, a minute of one core
"""

from __future__ import annotations

import numpy as np
import torch
import tyro

import warpgarment as wg
from warpgarment.view.report import table


def back_of_hem(vertices: np.ndarray) -> torch.Tensor:
    """The rearmost quarter of the vertices within 3 cm of the lowest one."""
    hem = np.flatnonzero(vertices[:, 1] < vertices[:, 1].min() + 0.03)
    return torch.from_numpy(hem[np.argsort(vertices[hem, 2])[: len(hem) // 4]])


def main(frames: tuple[int, ...] = (10, 20), aside: tuple[float, ...] = (0.1, 0.5, 1.5), wind: float = -8.0) -> None:
    """Prints the table.

    Args:
        frames: Lengths of the rollouts.
        aside: Half the distances of the differences [m/s].
        wind: Velocity of the air along Z [m/s].
    """
    assets = wg.demo.assets()
    dress, simulator = assets.garments["dress"], wg.Simulator.from_pretrained("layers", device="cpu")
    simulator.network.requires_grad_(False)
    hem, silk = back_of_hem(dress.first_vertices), wg.Material.silk()
    rows: list[list[object]] = []
    for count in frames:
        given = {"first_vertices": dress.first_vertices, "frames": count}

        def height(air: torch.Tensor, given: dict = given) -> torch.Tensor:
            found = wg.differentiable.rollout(
                simulator, dress.garment, assets.collider, wind=air, material=silk, **given
            )
            return found[-1, hem, 1].mean()

        air = torch.tensor([0.0, 0.0, wind], requires_grad=True)
        (slope,) = torch.autograd.grad(height(air), air)
        with torch.no_grad():
            for axis in range(3):
                way = torch.eye(3)[axis]
                found = [(height(air + far * way) - height(air - far * way)).item() / (2 * far) for far in aside]
                rows.append([count, "xyz"[axis], f"{slope[axis]:.2e}", *(f"{value:.2e}" for value in found)])
    print(table(["frames", "along", "gradient", *(f"differences of {far:g} m/s" for far in aside)], rows))


if __name__ == "__main__":
    tyro.cli(main)
