"""Measures of how cloth differs from a recording, and of how it looks, frame by frame.

Of the differences d = x - x_recorded of all V vertices, [T,V,3] in metres:

| figure | meaning |
| --- | --- |
| distance | mean over vertices of |d|, also by quarter of height, hem to top |
| low, high | mean of |P d| and |d - P d|, where P smooths d over the rest mesh |
| slow, fast | mean of |m| and |d' - m|, where m is the mean over one second of d', which is d as the garment sees it |
| bias | mean over vertices of |mean over all frames of d'| |

P solves (M + s^4 L M^-1 L) P d = M d, with L the cotangent Laplacian of the rest mesh and M its lumped areas, free at
all borders. A wave of wavelength w keeps the share 1 / (1 + (w_0 / w)^4) of its amplitude, w_0 = 2 pi s = 20 cm: longer
waves are low, shorter ones high, and |low|^2 + |high|^2 is not |d|^2. d' = R^T d with R the rotation that fits the
recorded garment best (Kabsch, from rest), so that a garment that always hangs too far behind its wearer is biased in
whatever direction they walk. The second is centred and ends where the frames end.

Of positions x by themselves: **bending** is the mean over inner edges of the squared change of the dihedral angle
against the rest mesh [rad^2]; **strain_1**, **strain_99** are percentiles over edges of the relative change of length;
**acceleration** is the mean over vertices of |x(t+1) - 2 x(t) + x(t-1)| fps^2 [m/s^2], NaN in the first frame and the
last. All is computed in float64.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse
from scipy.ndimage import uniform_filter1d
from scipy.sparse.linalg import splu

from warpgarment.kernels.mesh.laplacian import cotangent_laplacian
from warpgarment.objects.garment import Garment
from warpgarment.training.rollouts import kabsch

WAVELENGTH = 0.20  # metres: half of a wave of this length is low
WINDOW = 1.0  # seconds
QUARTERS = ("hem", "second", "third", "top")
DIFFERENCE = ("distance", *QUARTERS, "low", "high", "slow", "fast")  # [cm]
LOOKS = ("bending", "strain_1", "strain_99", "acceleration")


class Shape:
    """The rest mesh of a sequence, prepared for these measures.

    Args:
        garment: Rest mesh of all garments together.
        parts: Vertices of each garment, whose heights are divided into quarters one by one; None for a single garment.
        fps: Frames per second.
    """

    def __init__(self, garment: Garment, parts: Sequence[slice] | None = None, fps: float = 30.0):
        rest, faces = garment.vertices.astype(np.float64), garment.faces.astype(np.int64)
        self._rest, self._fps, self._edges = rest, fps, garment.edges.astype(np.int64)
        self._length = self._lengths(rest[None])[0]
        self._hinges = hinges(faces)
        self._angles = dihedral_angles(rest[None], self._hinges)[0]
        self.quarter = np.empty(len(rest), np.int64)
        for part in parts or [slice(0, len(rest))]:
            height = rest[part, 1]
            share = (height - height.min()) / max(float(np.ptp(height)), 1e-12)
            self.quarter[part] = np.minimum((4 * share).astype(np.int64), 3)
        corner = rest[faces]
        area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        self._mass = np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(rest))
        self._mass[self._mass == 0] = 1.0  # of no face: such a vertex is smoothed with no other
        laplacian = cotangent_laplacian(rest, faces)
        biharmonic = laplacian @ scipy.sparse.diags(1.0 / self._mass) @ laplacian
        reach = WAVELENGTH / (2 * np.pi)
        self._factor = splu((scipy.sparse.diags(self._mass) + reach**4 * biharmonic).tocsc())

    def smoothed(self, difference: np.ndarray) -> np.ndarray:
        """The part of long wavelengths of a function of the vertices, float64 [T,V,3], in the unit of `difference`."""
        frames, count = difference.shape[:2]
        columns = np.moveaxis(difference.astype(np.float64), 1, 0).reshape(count, -1)
        return np.moveaxis(self._factor.solve(self._mass[:, None] * columns).reshape(count, frames, 3), 0, 1)

    def seen_by_garment(self, difference: np.ndarray, recorded: np.ndarray) -> np.ndarray:
        """Differences in axes that turn with the recorded garment, float64 [T,V,3] [m]."""
        turns = np.stack([kabsch(self._rest, frame.astype(np.float64))[0] for frame in recorded])
        return np.einsum("tji,tvj->tvi", turns, difference.astype(np.float64))

    def differences(self, positions: np.ndarray, recorded: np.ndarray) -> dict[str, np.ndarray]:
        """The figures `DIFFERENCE` of every frame [cm], float64 [T] each; a quarter without vertices is NaN.

        Args:
            positions: Positions [m], [T,V,3].
            recorded: Recorded positions [m], [T,V,3].
        """
        d = positions.astype(np.float64) - recorded
        size = np.linalg.norm(d, axis=-1)
        found = {"distance": size.mean(axis=1)}
        for k, name in enumerate(QUARTERS):
            inside = self.quarter == k
            found[name] = size[:, inside].mean(axis=1) if inside.any() else np.full(len(size), np.nan)
        low = self.smoothed(d)
        turned = self.seen_by_garment(d, recorded)
        slow = moving_mean(turned, 2 * round(WINDOW * self._fps / 2) + 1)
        for name, part in (("low", low), ("high", d - low), ("slow", slow), ("fast", turned - slow)):
            found[name] = np.linalg.norm(part, axis=-1).mean(axis=1)
        return {name: 100.0 * values for name, values in found.items()}

    def bias(self, positions: np.ndarray, recorded: np.ndarray) -> float:
        """Mean over vertices of the length of the mean over frames of the difference as the garment sees it [cm]."""
        turned = self.seen_by_garment(positions.astype(np.float64) - recorded, recorded)
        return 100.0 * float(np.linalg.norm(turned.mean(axis=0), axis=-1).mean())

    def looks(self, positions: np.ndarray) -> dict[str, np.ndarray]:
        """The figures `LOOKS` of every frame, float64 [T] each.

        Args:
            positions: Positions [m], [T,V,3].
        """
        x = positions.astype(np.float64)
        change = dihedral_angles(x, self._hinges) - self._angles
        change = (change + np.pi) % (2 * np.pi) - np.pi
        strain = self._lengths(x) / self._length - 1.0
        acceleration = np.full(len(x), np.nan)
        if len(x) > 2:
            second = (x[2:] - 2 * x[1:-1] + x[:-2]) * self._fps**2
            acceleration[1:-1] = np.linalg.norm(second, axis=-1).mean(axis=1)
        bending = (change**2).mean(axis=1) if len(self._hinges) else np.zeros(len(x))
        low, high = np.percentile(strain, [1.0, 99.0], axis=1)
        return {"bending": bending, "strain_1": low, "strain_99": high, "acceleration": acceleration}

    def _lengths(self, x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x[:, self._edges[:, 1]] - x[:, self._edges[:, 0]], axis=-1)


def hinges(faces: np.ndarray) -> np.ndarray:
    """Inner edges and the vertices opposite to them.

    Args:
        faces: Vertex indices, [F,3], of a manifold whose faces are oriented alike.

    Returns:
        Edge a, b and the third vertices of the face on whose border it runs from a to b and of the other, int64 [H,4].
    """
    a, b, c = (np.concatenate([faces[:, (k + i) % 3] for k in range(3)]) for i in range(3))
    here = {(int(p), int(q)): int(r) for p, q, r in zip(a, b, c, strict=True)}
    rows = [(p, q, r, here[q, p]) for (p, q), r in here.items() if p < q and (q, p) in here]
    return np.array(rows, np.int64).reshape(-1, 4)


def dihedral_angles(positions: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Signed angles between the normals of the faces at inner edges [rad], -pi to pi, 0 where they are flat.

    Args:
        positions: Positions [m], [T,V,3].
        edges: Result of :func:`hinges`, [H,4].

    Returns:
        float64 [T,H].
    """
    a, b, c, d = (positions[:, edges[:, i]].astype(np.float64) for i in range(4))
    along = b - a
    first, second = np.cross(along, c - a), np.cross(d - a, along)
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-30)
    sine = np.einsum("thi,thi->th", np.cross(first, second), along)
    return np.arctan2(sine, np.einsum("thi,thi->th", first, second))


def moving_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Centred mean over `width` frames, an odd number, of which only those that exist are taken; [T,...]."""
    padding = [(width // 2, width // 2)] + [(0, 0)] * (values.ndim - 1)
    total = uniform_filter1d(np.pad(values.astype(np.float64), padding), width, axis=0, mode="constant")
    count = uniform_filter1d(np.pad(np.ones(len(values)), padding[0]), width, mode="constant")
    middle = slice(width // 2, width // 2 + len(values))
    return total[middle] / count[middle].reshape(-1, *(1,) * (values.ndim - 1))
