"""Small garments, bodies and networks that many tests simulate."""

from __future__ import annotations

import igl
import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.sim.simulator import Simulator

TINY = {"embedding": 16, "layers": 1, "feed_forward": 16, "heads": 2, "manifold_heads": 1, "history": 3, "dropout": 0.0}


def tube(around: int, along: int, *, bottom: float, top: float, radius=(0.3, 0.19)):
    """Vertices [m] and faces of an open tube about +Y, with its first ring at the top."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    share = np.linspace(0, 1, along)[:, None]
    wide = radius[1] + (radius[0] - radius[1]) * share
    height = np.broadcast_to(top + (bottom - top) * share, (along, around))
    vertices = np.stack([wide * np.cos(angle), height, wide * np.sin(angle)], axis=-1).reshape(-1, 3)
    ring, spoke = np.meshgrid(np.arange(along - 1), np.arange(around), indexing="ij")
    a, b = ring * around + spoke, ring * around + (spoke + 1) % around
    faces = np.stack([a, b, a + around, b, b + around, a + around], axis=-1).reshape(-1, 3)
    return vertices.astype(np.float32), faces.astype(np.int32)


def skirt(**options) -> Garment:
    """A skirt of 192 faces."""
    return Garment(*tube(16, 7, bottom=-0.3, top=0.3), name="skirt", **options)


def outfit() -> Garment:
    """Two separate tubes, 120 faces."""
    upper, lower = tube(12, 4, bottom=0.1, top=0.4), tube(12, 3, bottom=-0.3, top=-0.05)
    vertices = np.concatenate([upper[0], lower[0]])
    return Garment(vertices, np.concatenate([upper[1], lower[1] + len(upper[0])]), name="outfit")


CAPSULE = trimesh.creation.capsule(height=1.0, radius=0.15, count=[16, 16])
CAPSULE.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))


def body(frames: int, move=lambda t: (0.0, 0.0, 0.0), turn=lambda t: (0.0, 0.0, 0.0), fps: float = 30.0) -> BodyMotion:
    """The capsule in rigid motion: per frame a rotation vector `turn` [rad], which is applied first, and an offset
    `move` [m]."""
    rest = np.asarray(CAPSULE.vertices)
    moved = [Rotation.from_rotvec(turn(t)).apply(rest) + np.asarray(move(t)) for t in range(frames)]
    return BodyMotion(np.stack(moved), CAPSULE.faces, fps)


def walk(frames: int, fps: float = 30.0) -> BodyMotion:
    """The capsule swaying and turning."""
    return body(frames, lambda t: (0.01 * np.sin(0.5 * t), 0.0, 0.01 * t), lambda t: (0.0, 0.05 * t, 0.0), fps)


def network(kind=ManifoldAwareTransformer, **changes) -> ManifoldAwareTransformer:
    """A network with random weights whose output is small: a few millimetres and degrees per frame."""
    torch.manual_seed(0)
    made = kind(NetworkConfig.small(**(TINY | changes)))
    for head in (made.face_head, made.velocity_head):
        torch.nn.init.normal_(head.weight, std=0.3)
        torch.nn.init.normal_(head.bias, std=0.3)
    scales = {"psi_std": (9, 0.02), "singular_value_std": (3, 2e-3), "q_std": (3, 2e-3)}
    made.set_statistics({name: torch.full((length,), value) for name, (length, value) in scales.items()})
    return made


def still(**changes) -> ManifoldAwareTransformer:
    """A network that does not move the garment; only contacts and pins move it."""
    made = ManifoldAwareTransformer(NetworkConfig(**(TINY | changes)))
    for head in (made.face_head, made.velocity_head):
        torch.nn.init.zeros_(head.weight)
        torch.nn.init.zeros_(head.bias)
    return made


def simulator(made: ManifoldAwareTransformer, **options) -> Simulator:
    """A simulator with a network on the CPU."""
    return Simulator(made, "cpu", **options)


def nowhere_deeper(vertices: np.ndarray, motion: BodyMotion, frame: int) -> float:
    """Depth of the deepest vertex in a frame by libigl [m]."""
    distance = igl.signed_distance(
        vertices.astype(np.float64),
        motion.vertices[frame].astype(np.float64),
        motion.faces.astype(np.int64),
        igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]
    return max(0.0, -float(distance.min()))


class Failing(ManifoldAwareTransformer):
    """A network that predicts NaN for the first garment of a batch from its third frame on."""

    calls = 0

    def forward_normalised(self, *args, **options):
        output = super().forward_normalised(*args, **options)
        self.calls += 1
        if self.calls >= 3:
            output.psi[0, 0] = torch.nan
        return output
