r"""A static garment model in the manner of DeePSD (Bertiche et al. 2021): each frame from the pose of the body alone.

Cloth follows its body as smooth skin (kernels/features/skin.py), with blend weights that are learned, and is displaced
by what the pose asks:

    x_v(t) = Σ_j w_vj (c_j(t) + R_j(t) (X_v - c_j(0))) + R_v(t) D_v (p(t) - p(0))
    w_v = softmax(log w⁰_v + Δ(z_v)),    D_v = D(z_v),    z_v = MLP(descriptor of v)
    p(t) = MLP(mean_j φ(R_root(t)ᵀ R_j(t), R_root(t)ᵀ (c_j(t) - c(t)), c_j(0) - c(0)))

| symbol | code | what |
| --- | --- | --- |
| X, c(0) | | garment and body in frame 0, in which cloth is bound |
| R_j, c_j | `turns`, `middles` | rotation and mean of the body's points since frame 0 |
| w⁰ | `skin.weight` | blend weights of the smooth skin |
| z | `descriptor`, `self.vertex` | place, shape and distance from the body of a vertex in frame 0 |
| R_root, c | | rigid motion of all points |

Untrained it is the smooth skin: Δ and D begin at zero. DeePSD has a graph network over the template in place of the
descriptors, a pose of joint angles, and losses without supervision on top. Like it, this sees no material, no wind, no
velocity and no other garment: only the number of a garment in its outfit. Frame 0 must face as in training.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise
from scipy.sparse import coo_matrix, diags
from scipy.spatial import cKDTree
from torch import nn

from warpgarment.errors import CheckpointError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.kernels.deformation.replaced import rotation
from warpgarment.kernels.features.skin import BOUND, Skin, bind
from warpgarment.objects.body import BodyMotion
from warpgarment.training.data.sequence import Sequence

from .collisions import vertex_normals

KIND = "warpgarment.static"
SMOOTHED = (1, 4, 16)  # rounds of smoothing; a descriptor says how far they move a vertex
DESCRIPTOR = 3 + 3 + 3 + 1 + 3 + 2 + 3 * len(SMOOTHED)
HIDDEN, POSE, OF_POINT = 128, 64, 15
AT_ONCE = 16  # frames


@dataclass(frozen=True)
class Bound:
    """An outfit bound to its body in frame 0: V vertices, N points of the body.

    Attributes:
        skin: The smooth skin.
        middles: c_j(0) [m], [N,3].
        descriptor: Descriptor of each vertex, [V,DESCRIPTOR].
    """

    skin: Skin
    middles: torch.Tensor
    descriptor: torch.Tensor

    @classmethod
    def of(cls, sequence: Sequence, body: BodyMotion) -> Bound:
        """Binds the recorded frame 0 of a sequence."""
        first, start = np.asarray(sequence.vertices[0], np.float64), np.asarray(body.vertices[0], np.float64)
        skin = bind(first, np.zeros(len(first), np.int64), start, [0, len(start)], "cpu")
        faces = np.asarray(sequence.garment.faces, np.int64)
        distance, nearest = cKDTree(start).query(first)
        layers = sequence.layers
        rank = np.zeros((len(first), 2))
        for k, layer in enumerate(layers):
            rank[layer.vertices] = k, k == len(layers) - 1
        parts = [
            2.0 * (first - start.mean(axis=0)),
            _unit(vertex_normals(first, faces)),
            10.0 * (first - start[nearest]),
            10.0 * distance[:, None],
            _unit(vertex_normals(start, np.asarray(body.faces, np.int64)))[nearest],
            rank,
            *(10.0 * (first - smooth) for smooth in _smoothed(first, faces)),
        ]
        descriptor = torch.from_numpy(np.concatenate(parts, axis=1).astype(np.float32))
        middles = torch.from_numpy(start[skin.around.numpy()].mean(axis=1).astype(np.float32))
        return cls(skin, middles, descriptor)

    def pose(self, body: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Rotations R_j [T,N,3,3] and means c_j [T,N,3] of the points in frames of the body [m], [T,U,3]."""
        return self.skin.pose(torch.from_numpy(np.ascontiguousarray(body, np.float32)))

    def of_points(self, turns: torch.Tensor, middles: torch.Tensor) -> torch.Tensor:
        """What φ reads of each point in each frame, [T,N,OF_POINT]."""
        shape = self.middles - self.middles.mean(dim=0)
        moved = middles - middles.mean(dim=1, keepdim=True)
        root = rotation(moved.mT @ shape)
        turned = (root.mT[:, None] @ turns).flatten(-2)
        placed = (root.mT[:, None] @ moved[..., None])[..., 0]
        return torch.cat([turned, 2.0 * placed, 2.0 * shape.expand_as(placed)], dim=-1)


class StaticGarment(nn.Module):
    """The network; `hidden` and `pose` are its widths."""

    def __init__(self, hidden: int = HIDDEN, pose: int = POSE) -> None:
        super().__init__()
        self.settings = {"hidden": hidden, "pose": pose}
        self.vertex = nn.Sequential(
            nn.Linear(DESCRIPTOR, hidden), nn.GELU(), nn.Linear(hidden, hidden), nn.GELU(), nn.Linear(hidden, hidden),
            nn.GELU(),
        )  # fmt: skip
        self.point = nn.Sequential(nn.Linear(OF_POINT, hidden), nn.GELU(), nn.Linear(hidden, hidden), nn.GELU())
        self.pose = nn.Sequential(nn.Linear(hidden, hidden), nn.GELU(), nn.Linear(hidden, pose))
        self.weights, self.displacement = nn.Linear(hidden, BOUND), nn.Linear(hidden, 3 * pose)
        for head in (self.weights, self.displacement):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def forward(self, bound: Bound, turns: torch.Tensor, middles: torch.Tensor) -> torch.Tensor:
        """Positions of cloth.

        Args:
            bound: The outfit.
            turns, middles: The result of `Bound.pose`, of T frames.

        Returns:
            Positions [m], [T,V,3].
        """
        skin, z = bound.skin, self.vertex(bound.descriptor)
        weight = torch.softmax(torch.log(skin.weight + 1e-6) + self.weights(z), dim=-1)
        still = torch.eye(3).expand(1, len(bound.middles), 3, 3)
        poses = bound.of_points(torch.cat([still, turns]), torch.cat([bound.middles[None], middles]))
        asked = self.pose(self.point(poses).mean(dim=1))
        pushed = self.displacement(z).unflatten(-1, (3, -1)) @ (asked[1:] - asked[0]).T  # [V,3,T]
        near = turns[:, skin.points]
        places = middles[:, skin.points] + (near @ skin.offset[..., None])[..., 0]
        with torch.no_grad():
            blended = (skin.weight[..., None, None] * near).sum(dim=2)
            frame = rotation(blended.flatten(0, 1)).unflatten(0, blended.shape[:2])
        return (weight[..., None] * places).sum(dim=2) + (frame @ pushed.permute(2, 0, 1)[..., None])[..., 0]

    @torch.no_grad()
    def posed(self, sequence: Sequence, body: BodyMotion, frames: np.ndarray) -> np.ndarray:
        """The outfit of a sequence in frames of its body.

        Args:
            sequence: The sequence, of which frame 0 is read.
            body: Its body, of which frame 0 is read.
            frames: Positions of the body [m], [T,U,3].

        Returns:
            Positions [m], float32 [T,V,3].
        """
        bound = Bound.of(sequence, body)
        found = [self(bound, *bound.pose(frames[k : k + AT_ONCE])) for k in range(0, len(frames), AT_ONCE)]
        return torch.cat(found).numpy()

    def save(self, path: Path, notes: Mapping[str, Any]) -> None:
        """Writes weights, widths and facts about the training to one file of safetensors."""
        about = {"kind": KIND, "settings": json.dumps(self.settings), "notes": json.dumps(dict(notes))}
        with atomic_file(Path(path)) as temporary:
            temporary.write_bytes(serialise(self.state_dict(), metadata=about))

    @classmethod
    def load(cls, path: Path) -> StaticGarment:
        """Reads what `save` wrote.

        Raises:
            CheckpointError: The file is missing, or is none of this kind.
        """
        try:
            with safe_open(path, "pt") as file:
                about = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}
            if about.get("kind") != KIND:
                raise CheckpointError(f"{path} holds no static garment model; `outfits train-static` makes one")
            network = cls(**{key: int(value) for key, value in json.loads(about["settings"]).items()})
            network.load_state_dict(tensors)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise CheckpointError(f"{path} cannot be read: {error}") from error
        return network.eval()


def notes_of(path: Path) -> dict[str, Any]:
    """The facts about the training that `save` wrote."""
    with safe_open(path, "pt") as file:
        return json.loads((file.metadata() or {}).get("notes", "{}"))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _smoothed(points: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Positions [m] after `SMOOTHED` rounds of half the way to the mean of the neighbours, [V,3] each."""
    i, j = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    count = len(points)
    joined = (coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(count, count)) > 0).astype(float)
    mean = diags(1.0 / np.maximum(np.asarray(joined.sum(axis=1)).ravel(), 1.0)) @ joined.tocsr()
    found = []
    for round_ in range(1, max(SMOOTHED) + 1):
        points = 0.5 * (points + mean @ points)
        if round_ in SMOOTHED:
            found.append(points)
    return found
