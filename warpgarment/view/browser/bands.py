"""Colours of faces in steps: the scale of a figure, and a garment taken apart by it.

A page shows meshes of one colour each, whose vertices and faces may change without a flicker. A garment that is
coloured by a figure is therefore one mesh for each step of the scale, and has colours of faces, with flat shading.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

Color = tuple[int, int, int]


class Scale(NamedTuple):
    """A figure in steps.

    Attributes:
        title: What is shown, with its unit.
        edges: Values between the steps, rising, K - 1 of them.
        colors: sRGB of each step, K of them.
    """

    title: str
    edges: tuple[float, ...]
    colors: tuple[Color, ...]

    def steps(self, values: np.ndarray) -> np.ndarray:
        """The step of each value [F], int64 from 0 to K - 1; -1 for NaN."""
        found = np.searchsorted(np.asarray(self.edges), values, side="right")
        return np.where(np.isnan(values), -1, found)

    @property
    def labels(self) -> list[str]:
        """What each step holds, in words."""
        between = [f"{a:g} to {b:g}" for a, b in zip(self.edges, self.edges[1:], strict=False)]
        return [f"below {self.edges[0]:g}", *between, f"{self.edges[-1]:g} and more"]


def split(vertices: np.ndarray, faces: np.ndarray, step: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """The part of a mesh in each step that has faces: the step, its vertices [W,3], and its faces [G,3] among them.

    Args:
        vertices: Positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
        step: Step of each face, shape [F]; faces below 0 are left out.
    """
    for k in np.unique(step[step >= 0]).tolist():
        chosen = faces[step == k]
        used, number = np.unique(chosen, return_inverse=True)
        yield k, vertices[used], number.reshape(chosen.shape).astype(np.uint32)


def ramp(anchors: tuple[str, ...], count: int) -> tuple[Color, ...]:
    """Colours between anchors ("#rrggbb") at even distances, in straight lines."""
    points = np.array([[int(a[i : i + 2], 16) for i in (1, 3, 5)] for a in anchors], np.float64)
    places = np.linspace(0, len(points) - 1, count)
    rows = np.stack([np.interp(places, np.arange(len(points)), column) for column in points.T], axis=1)
    return tuple((int(r), int(g), int(b)) for r, g, b in rows.round())


_INSIDE: Color = (214, 39, 40)
_SEQUENCE = ("#fde725", "#5ec962", "#21918c", "#3b528b", "#440154")  # light to dark: also without colours
_DIVERGING = ("#2166ac", "#92c5de", "#e6e6e6", "#f4a582", "#b2182b")

DISTANCE = Scale(
    "distance to the body [mm], red: inside it",
    (0, 2, 4, 6, 8, 10, 15, 20, 30, 50, 100),
    (_INSIDE, *ramp(_SEQUENCE, 11)),
)
STRAIN = Scale(
    "largest stretch against rest [%]",
    (-10, -5, -2, 2, 5, 10, 15, 20, 30),
    (*ramp(_DIVERGING[:3], 4)[:3], *ramp(_DIVERGING[2:], 7)),
)
ERROR = Scale(
    "distance to the second result [cm]", (0.25, 0.5, 1, 1.5, 2, 3, 4, 6, 8, 12), ramp(_SEQUENCE[::-1], 11)
)  # fmt: skip
