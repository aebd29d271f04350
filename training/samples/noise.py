"""Perturbations of histories that resemble the errors of a rollout, so that the network learns to undo them.

A garment of V vertices has a basis of smooth random displacement fields at several scales: white noise on the
vertices, smoothed by k applications of the averaging operator (A V)_i = (V_i + mean of the neighbours of i) / 2 and
scaled to unit RMS. A displacement of the history is

    delta_h = amplitude * (sum_j b_j c_hj + white noise + one offset per component),      c_h = c_H + random walk
    backwards in time,

and changes little from frame to frame, like the drift of a rollout. The amplitude halves from each scale to the next
finer one, so every scale stretches the cloth about equally. White noise has 1/32 of it, since the result of a Poisson
solve is smooth. Near pins, where a rollout does not drift, the displacement fades out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

SMOOTHINGS = (64, 16, 4)  # numbers of applications of the averaging operator, coarse to fine
FIELDS = 12  # number of random fields per scale


@dataclass(frozen=True)
class NoiseConfig:
    """Perturbation of a training sample's history. Lengths in metres.

    Attributes:
        position: RMS of the coarsest displacement field; finer ones have 1/2, 1/4 and (white) 1/32 of it.
        offset: RMS per axis of the constant displacement of each component.
        walk: Step of the random walk per frame, relative to the amplitude of the displacement.
        spread: Least factor of `position` and `offset`; each sample draws its factor log-uniformly from [spread, 1].
        clean: Share of samples without perturbation.
        features: Standard deviation sigma_n of the paper's Gaussian noise on the normalised input features.
    """

    position: float = 0.012
    offset: float = 0.010
    walk: float = 0.1
    spread: float = 0.1
    clean: float = 0.1
    features: float = 0.0


def averaging_operator(faces: np.ndarray, vertex_count: int) -> sp.csr_matrix:
    """Sparse matrix [V,V] whose rows average a vertex with the mean of its neighbours; isolated vertices are kept."""
    i = np.concatenate([faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()])
    j = np.concatenate([faces[:, [1, 2, 0]].ravel(), faces[:, [0, 1, 2]].ravel()])
    adjacency = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(vertex_count, vertex_count)).tocsr()
    adjacency.data[:] = 1.0
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    half = np.where(degree > 0, 0.5, 0.0)
    return (sp.diags(1.0 - half) + sp.diags(half / np.maximum(degree, 1.0)) @ adjacency).tocsr()


class NoiseBasis:
    """Smooth random fields of one garment.

    Args:
        faces: Vertex indices, int32 [F,3].
        vertex_component: Component of each vertex, int [V].
        pins: Indices of pinned vertices; may be empty.
        seed: Seed of the fields.
    """

    def __init__(self, faces: np.ndarray, vertex_component: np.ndarray, pins: np.ndarray, seed: int = 0) -> None:
        count = len(vertex_component)
        averaging = averaging_operator(faces, count)
        rng = np.random.default_rng(seed)
        columns, scale = [], []
        for level, smoothing in enumerate(SMOOTHINGS):
            fields = rng.standard_normal((count, FIELDS))
            for _ in range(smoothing):
                fields = averaging @ fields
            fields -= fields.mean(axis=0)
            fields /= np.sqrt((fields**2).mean(axis=0)) + 1e-9
            columns.append(fields)
            scale += [0.5**level / np.sqrt(FIELDS)] * FIELDS
        self.fields = np.concatenate(columns, axis=1).astype(np.float32)  # [V, 3 * FIELDS]
        self.scale = np.array(scale, np.float32)
        self.white = 1.0 / 32.0
        self.component = np.asarray(vertex_component)
        self.components = int(self.component.max()) + 1
        self.fade = np.ones((count, 1), np.float32)
        if len(pins):
            held = np.zeros(count)
            held[pins] = 1.0
            near = held.copy()
            for _ in range(6):
                near = np.maximum(averaging @ near, held)
            self.fade = (1.0 - near)[:, None].astype(np.float32)

    def displacement(self, frames: int, config: NoiseConfig, rng: np.random.Generator) -> np.ndarray | None:
        """Draws displacements [m], shape [frames, V, 3], oldest frame first; None for a clean sample."""
        clean, amplitude = rng.random(), config.spread ** rng.random()
        if clean < config.clean or (config.position == 0.0 and config.offset == 0.0):
            return None
        fields, count = self.fields.shape[1], len(self.fade)
        # Newest frame first while the walk is summed, so that the newest frame has the stated amplitude.
        steps = rng.standard_normal((frames, fields + self.components, 3)).astype(np.float32)
        steps[1:] *= config.walk
        steps = np.cumsum(steps, axis=0)[::-1]
        smooth = steps[:, :fields] * (self.scale[:, None] * (amplitude * config.position))
        offset = steps[:, fields:] * (amplitude * config.offset)
        delta = (self.fields @ smooth.transpose(1, 0, 2).reshape(fields, frames * 3)).reshape(count, frames, 3)
        white = rng.standard_normal((count, 3), dtype=np.float32) * (self.white * amplitude * config.position)
        delta += white[:, None] + offset.transpose(1, 0, 2)[self.component]
        return (delta * self.fade[:, :, None]).transpose(1, 0, 2)
