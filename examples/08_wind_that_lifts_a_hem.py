"""The wind that lifts the back of a hem by 10 cm, found by gradient descent through the rollout.

Every stage of a frame is differentiable, so the height of the hem in the last frame has a gradient with respect to the
wind. Each step goes along it as far as the target would be if the height were linear, at most `longest` m/s. The wind
that was found is then tested by an ordinary rollout, beside one in still air.

python examples/08_wind_that_lifts_a_hem.py
"""

from pathlib import Path

import numpy as np
import torch
import tyro

import warpgarment as wg


def back_of_hem(vertices: np.ndarray) -> np.ndarray:
    """The rearmost quarter of the vertices within 3 cm of the lowest one; the body walks towards +Z."""
    hem = np.flatnonzero(vertices[:, 1] < vertices[:, 1].min() + 0.03)
    return hem[np.argsort(vertices[hem, 2])[: max(1, len(hem) // 4)]]


def main(
    out: Path = Path("out/hem"), frames: int = 25, lift: float = 0.10, steps: int = 10, longest: float = 4.0
) -> None:
    assets = wg.demo.assets()
    dress = assets.garments["dress"]
    hem = torch.from_numpy(back_of_hem(dress.first_vertices))
    simulator = wg.Simulator.from_pretrained("layers")  # a network that reads the wind
    simulator.network.requires_grad_(False)  # gradients of the wind alone
    given = {"first_vertices": dress.first_vertices, "frames": frames}
    silk = wg.Material.silk()
    still = simulator.rollout(dress.garment, assets.collider, wind=[0.0, 0.0, 0.0], materials=silk, **given)

    wind = torch.tensor([0.0, 0.0, -6.0])  # m/s, from the front
    best, nearest = wind, float("inf")
    for step in range(steps):
        wind.requires_grad_(True)
        moved = wg.differentiable.rollout(simulator, dress.garment, assets.collider, wind=wind, material=silk, **given)
        lifted = moved[-1, hem, 1].mean() - float(still.vertices[-1, hem, 1].mean())
        (slope,) = torch.autograd.grad(lifted, wind)
        missing = lift - lifted.item()
        print(f"step {step}: wind of {wind.detach().numpy().round(2)} m/s: {100 * lifted.item():.2f} cm higher")
        if abs(missing) < nearest:
            best, nearest = wind.detach(), abs(missing)
        if abs(missing) < 0.05 * lift:
            break
        change = missing * slope / slope.square().sum()
        wind = (wind + change * min(1.0, longest / change.norm().item())).detach()

    found = best.numpy()
    windy = simulator.rollout(dress.garment, assets.collider, wind=found, materials=silk, **given)
    measured = float((windy.vertices - still.vertices)[-1, hem, 1].mean())
    print(f"found {found.round(2)} m/s: an ordinary rollout lifts the hem by {100 * measured:.2f} cm")
    body = wg.BodyMotion(assets.body.vertices[:frames], assets.body.faces, assets.body.fps)
    blown = f"{np.linalg.norm(found):.0f} m/s, {100 * measured:.0f} cm higher"
    rows = [("still air", [still], [wg.draw.SLATE]), (blown, [windy], [wg.draw.CORAL])]
    camera = wg.draw.chase([body, windy, still], size=(240, 340), azimuth=118.0)  # from the side
    wg.draw.sheet(out / "hem.png", body, rows, frames=6, camera=camera)
    windy.save(out / "dress.pc2")
    print(f"wrote {out}/hem.png and {out}/dress.pc2")


if __name__ == "__main__":
    tyro.cli(main)
