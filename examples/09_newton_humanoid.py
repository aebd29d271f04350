"""A neural garment on Newton's humanoid: particles of a Newton model, moved by a network, on bodies that Newton moves.

pip install "warpgarment[physics,usd,view]"
python examples/09_newton_humanoid.py

Two humanoids walk as two worlds of one model, each in a tube dress; their joints follow a formula, where another solver
of Newton, or a policy, would move them. docs/newton.md has the whole of the solver.
"""

from pathlib import Path

import newton
import numpy as np
import tyro
import warp as wp

import warpgarment as wg
from warpgarment.newton import ShapeCollider, SolverNeuralGarment, add_garment

HUMANOID = Path(newton.__file__).parent / "examples" / "assets" / "nv_humanoid.xml"
TOP, HEM, STAND = 1.26, 0.62, 1.285  # heights of the dress's borders and of the root [m]


def humanoid() -> newton.ModelBuilder:
    builder = newton.ModelBuilder()
    root = wp.transform((0.0, 0.0, STAND), wp.quat_identity())
    builder.add_mjcf(str(HUMANOID), xform=root, ignore_names=["floor"])
    return builder


def tube_dress(body: np.ndarray, around: int, rings: int) -> wg.Garment:
    """A dress [m], Y up, 25 mm from the trunk and wider to the hem, held by its upper border."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    vertices, wide, deep = [], 0.0, 0.0
    for k, height in enumerate(np.linspace(TOP, HEM, rings)):
        near = body[(np.abs(body[:, 1] - height) < 0.05) & (np.abs(body[:, 2]) < 0.2) & (np.abs(body[:, 0]) < 0.13)]
        wide = max(wide + 0.004 * (height < 0.95), np.abs(near[:, 2]).max(initial=0.0) + 0.025)
        deep = max(deep + 0.006 * (height < 0.95), np.abs(near[:, 0]).max(initial=0.0) + 0.025)
        turned = angle + (k % 2) * np.pi / around
        vertices.append(np.stack([deep * np.cos(turned), np.full(around, height), wide * np.sin(turned)], axis=1))
    faces = []
    for k in range(rings - 1):
        a = k * around + np.arange(around)
        b, step = k * around + (np.arange(around) + 1) % around, around
        even = (
            [(a, b, a + step), (b, b + step, a + step)] if k % 2 == 0 else [(a, b + step, a + step), (a, b, b + step)]
        )
        faces += [np.stack(corners, axis=1) for corners in even]
    return wg.Garment(np.concatenate(vertices), np.concatenate(faces), pins=np.arange(around), name="dress")


def walking(model: newton.Model, time: float) -> np.ndarray:
    """Coordinates of all joints at a time [s]: both worlds walk, the second one half a step later."""
    q = model.joint_q.numpy().copy()
    starts, labels = model.joint_q_start.numpy(), model.joint_label
    ease = min(time / 0.8, 1.0)
    for joint, label in enumerate(labels):
        world, name, first = int(model.joint_world.numpy()[joint]), label.rsplit("/", 1)[-1], starts[joint]
        side = np.pi if "left" in name else 0.0
        phase = 2 * np.pi * 0.85 * time + side + np.pi * world
        if name == "root":
            q[first] += 0.9 * max(time - 0.4, 0.0)
            q[first + 2] += 0.015 * ease * (np.cos(2 * phase) - 1.0)
        elif "hip_y" in name:
            q[first + 2] = -0.45 * ease * np.sin(phase) - 0.06 * ease
        elif "knee" in name:
            q[first] = -ease * (0.15 + 0.4 * (1.0 + np.cos(phase + 0.3)))
        elif "abdomen_z" in name:
            q[first] = 0.12 * ease * np.sin(phase)
    return q


def main(
    out: Path = Path("out/newton"), seconds: float = 3.0, substeps: int = 2, around: int = 40, rings: int = 24
) -> None:
    bare = humanoid().finalize()
    garment = tube_dress(ShapeCollider(bare).at(bare).cpu().numpy(), around, rings)
    scene = newton.ModelBuilder()
    for _ in range(2):
        world = humanoid()
        add_garment(world, garment)
        scene.add_world(world)
    model = scene.finalize()
    solver = SolverNeuralGarment(model, garment)

    dt = 1.0 / (solver.fps * substeps)
    state, after = model.state(), model.state()
    particles, bodies = [state.particle_q.numpy().copy()], [solver.collider.at(state).cpu().numpy()]
    for step in range(1, round(seconds / dt) + 1):
        after.joint_q.assign(walking(model, step * dt))
        newton.eval_fk(model, after.joint_q, after.joint_qd, after)  # another solver, or a policy, moves bodies here
        solver.step(state, after, None, None, dt)
        state, after = after, state
        if step % substeps == 0:
            particles.append(state.particle_q.numpy().copy())
            bodies.append(solver.collider.at(state).cpu().numpy())

    cloth = np.stack(particles)[..., [0, 2, 1]] * np.float32([1, 1, -1])  # Y up
    body = np.stack(bodies)
    deepest = max(status.max_penetration for status in solver.status)
    print(f"{len(cloth)} frames of 2 worlds on {model.device}; at the end {1e3 * deepest:.1f} mm deep at most")
    rows = []
    for world, (dress, shown) in enumerate(zip(np.split(cloth, 2, axis=1), np.split(body, 2, axis=1), strict=True)):
        motion = wg.GarmentMotion(dress, garment.faces, solver.fps, name=f"dress_{world}")
        motion.save(out / f"dress_{world}.usd")
        carried = wg.BodyMotion(shown, solver.collider.faces[world], solver.fps)
        carried.save(out / f"humanoid_{world}.usd")
        rows.append((f"world {world}", [motion], wg.draw.PALETTE))
        if world == 0:
            wg.draw.sheet(out / "world_0.png", carried, rows, frames=8)
    print(f"wrote {out}/world_0.png, and dress and humanoid of each world as .usd")


if __name__ == "__main__":
    tyro.cli(main)
