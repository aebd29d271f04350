"""Moving bodies of a batch of scenes: contact planes of vertices, the way of the surface under them, and pins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.physics.planes import Planes, planes_of
from warpgarment.kernels.sdf import BodyMeshes
from warpgarment.training.teachers import ClothScene
from warpgarment.training.teachers.scenes import bound_to_body, used_body


class MovingBodies:
    """The bodies of scenes, packed, at any time of their motion. They stand still before it and after it.

    Args:
        scenes: The scenes.
        scene_of_vertex: Scene of each vertex of the cloth, [V].
        keep: Distance to keep from the body [m], [V].
        gap: Distance beyond it within which contact is detected [m].
        device: Device of the tensors.
    """

    def __init__(
        self,
        scenes: Sequence[ClothScene],
        scene_of_vertex: np.ndarray,
        keep: np.ndarray,
        gap: float,
        device: torch.device,
    ) -> None:
        found = [used_body(scene) for scene in scenes]
        self._settle, self._device = scenes[0].settle, device
        self._frames = [frames for frames, _ in found]
        starts = np.cumsum([0] + [frames.shape[1] for frames in self._frames])
        with_body = [number for number, (_, faces) in enumerate(found) if len(faces)]
        self.any = bool(with_body)
        self._after = self._at(0)
        self._before = self._after
        self._pins = _bound_pins(scenes, found, starts, device)
        if not self.any:
            return
        body = np.full(len(scenes), -1, np.int32)
        body[with_body] = np.arange(len(with_body))
        faces = np.concatenate([found[n][1] + starts[n] for n in with_body]).astype(np.int32)
        face_starts = np.cumsum([0] + [len(found[n][1]) for n in with_body])
        ends = [int(starts[n]) for n in with_body] + [int(starts[-1])]
        self._meshes = BodyMeshes(self._after, torch.from_numpy(faces).to(device), ends, [int(n) for n in face_starts])
        self._body_of_vertex = torch.from_numpy(body[scene_of_vertex]).to(device)
        self._keep = torch.from_numpy(keep.astype(np.float32)).to(device)
        self._within = self._keep + gap

    def _at(self, frame: int) -> torch.Tensor:
        shown = [frames[np.clip(frame - self._settle, 0, len(frames) - 1)] for frames in self._frames]
        return torch.from_numpy(np.concatenate(shown).astype(np.float32)).to(self._device)

    def begin_frame(self, frame: int) -> None:
        """Takes the motion that ends in a frame of the simulation, which has `settle` + T of them."""
        self._before, self._after = (self._at(max(frame - 1, 0)), self._at(frame))

    def _between(self, share: float) -> torch.Tensor:
        return self._before + (self._after - self._before) * share

    def planes(self, points: torch.Tensor, share: float, step: float) -> Planes:
        """Planes of points [m], float64 [V,3], at a share of the frame; `step` is the share that the step takes."""
        now, before = self._between(share), self._between(share - step)
        self._meshes.update(now)
        return planes_of(points, self._meshes, before, self._keep, self._within, self._body_of_vertex)

    def pins(self, share: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Vertices that are tied to bodies, [P], and their positions [m] at a share of the frame, float64 [P,3]."""
        pin, corner, weights, height = self._pins
        points = self._between(share)[corner].double()
        normal = torch.linalg.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        normal = normal / normal.norm(dim=1, keepdim=True).clamp(min=1e-30)
        return pin, (weights[:, :, None] * points).sum(1) + height[:, None] * normal


def _bound_pins(
    scenes: Sequence[ClothScene], found: list[tuple[np.ndarray, np.ndarray]], starts: np.ndarray, device: torch.device
) -> tuple[torch.Tensor, ...]:
    """Pinned vertices [P], corners of the body's faces [P,3], barycentric coordinates [P,3] and heights [m], [P]."""
    parts: list[tuple[np.ndarray, ...]] = [(np.zeros(0, int), np.zeros((0, 3), int), np.zeros((0, 3)), np.zeros(0))]
    first = 0
    for scene, (frames, faces), start in zip(scenes, found, starts[:-1], strict=True):
        for cloth, at in zip(scene.cloths, scene.starts[:-1], strict=True):
            pins = cloth.garment.pins
            if len(pins) and len(faces):
                face, weights, height = bound_to_body(np.asarray(cloth.first)[pins], frames[0], faces)
                parts.append((pins + at + first, faces[face] + start, weights, height))
        first += int(scene.starts[-1])
    joined = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return tuple(torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in joined)
