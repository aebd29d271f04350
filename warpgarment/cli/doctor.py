"""`warpgarment doctor`: what is installed, what it runs on, and whether it works."""

from __future__ import annotations

import importlib.util
import platform
import time
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from warpgarment.errors import UsageError

from . import _EXTRAS

_CORE = ("warpgarment", "warp-lang", "torch", "numpy", "scipy", "trimesh", "libigl", "safetensors")


@dataclass
class Doctor:
    """Options of `doctor`."""

    device: str | None = None
    """Device of the self check; by default a GPU where there is one."""


def run(options: Doctor) -> None:
    """Prints versions, devices and extras; rolls a few frames out."""
    import torch
    import warp as wp

    from warpgarment.kernels import launch  # noqa: F401  (keeps Warp's banner out of the report)

    print(f"python {platform.python_version()} on {platform.platform()}")
    versions = {name: _version(name) for name in _CORE} | {"torch": torch.__version__}  # with its build, such as +cu130
    print(", ".join(f"{name} {version}" for name, version in versions.items()))
    wp.init()
    for device in wp.get_devices():
        memory = f", {device.total_memory / 2**30:.0f} GiB" if device.is_cuda else ""
        print(f"warp device {device.alias}: {device.name}{memory}")
    print(f"torch: CUDA {torch.version.cuda if torch.cuda.is_available() else 'not available'}")
    for extra in dict.fromkeys(_EXTRAS.values()):
        missing = [m for m, e in _EXTRAS.items() if e == extra and importlib.util.find_spec(m) is None]
        print(f"extra {extra}: {'missing ' + ', '.join(missing) if missing else 'installed'}")
    print(_self_check(options.device))


def _self_check(device: str | None) -> str:
    """Rolls a tube out on a rising ball with an untrained network that moves it like skin."""
    from warpgarment.nn.config import NetworkConfig
    from warpgarment.nn.faces.network import ManifoldAwareTransformer
    from warpgarment.objects.body import BodyMotion
    from warpgarment.objects.garment import Garment
    from warpgarment.sim.simulator import Simulator

    began = time.perf_counter()
    ball, ball_faces = _tube(radius=0.2, height=0.4, around=24, rows=12, closed=True)
    tube, faces = _tube(radius=0.25, height=0.2, around=24, rows=6, closed=False)
    rising = ball + 0.01 * np.arange(5, dtype=np.float32)[:, None, None] * np.array([0, 1, 0], dtype=np.float32)
    network = ManifoldAwareTransformer(NetworkConfig.small())
    simulator = Simulator(network, device)
    motion = simulator.rollout(Garment(tube, faces, name="tube"), BodyMotion(rising, ball_faces))
    if not np.isfinite(motion.vertices).all():
        raise UsageError(
            f"self check on {simulator.device}: positions are not finite; please report this with the above."
        )
    return f"self check on {simulator.device}: ok, {motion.frames} frames in {time.perf_counter() - began:.1f} s"


def _tube(*, radius: float, height: float, around: int, rows: int, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """An upright tube, or a ball-like one that narrows to a point at both ends; faces point outwards."""
    angle = 2 * np.pi * np.arange(around) / around
    level = np.linspace(-0.5, 0.5, rows)[1:-1] if closed else np.linspace(-0.5, 0.5, rows)
    profile = radius * np.sqrt(1 - (2 * level) ** 2) if closed else np.full(rows, radius)
    x, z = profile[:, None] * np.sin(angle), profile[:, None] * np.cos(angle)
    y = np.broadcast_to(height * level[:, None], x.shape)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(len(level) - 1), np.arange(around), indexing="ij")
    a, b = row * around + column, row * around + (column + 1) % around
    quads = [np.stack([a, b, b + around], axis=-1), np.stack([a, b + around, a + around], axis=-1)]
    faces = np.concatenate([q.reshape(-1, 3) for q in quads])
    if closed:
        low, high, last = len(vertices), len(vertices) + 1, (len(level) - 1) * around
        vertices = np.concatenate([vertices, [[0, -height / 2, 0], [0, height / 2, 0]]])
        ring = np.stack([np.arange(around), (np.arange(around) + 1) % around], axis=1)
        below = np.column_stack([ring[:, ::-1], np.full(around, low)])
        above = np.column_stack([ring + last, np.full(around, high)])
        faces = np.concatenate([faces, below, above])
    return vertices.astype(np.float32), faces.astype(np.int32)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "(missing)"
