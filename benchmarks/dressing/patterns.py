"""Garments as pattern makers build them: flat panels in front of and behind the body, stitched along their outlines."""

from __future__ import annotations

import numpy as np

from warpgarment.objects.garment import Garment

CELL = 0.04
"""Side of a square of a panel [m]."""
DEEP = 5
"""Squares between the panels."""
ROWS = 15


def boxy_tshirt(**more) -> Garment:
    """A T-shirt of two flat panels 20 cm apart, with walls along their seams; sleeves stand out to both sides.

    It is 0.44 m wide, 0.6 m long and 0.84 m from cuff to cuff, with its neck at the origin, Y up.
    """
    inside = np.zeros((21, ROWS), bool)  # columns from x = -0.42 m on, rows from the hem up
    inside[5:16] = True
    inside[:, ROWS - 5 :] = True
    inside[8:13, ROWS - 1] = False

    def opened(x: float, y: float, along: int) -> bool:
        """Whether a border with its middle there [cells from the middle and the top] is an opening."""
        cuff, hem, neck = abs(x) > 10.4, y < 0.1 - ROWS, abs(x) < 2.6 and y > -1.1
        return bool(cuff and along == 0) or bool(hem) or bool(neck)

    return _boxed(inside, opened, 0.1, name="boxy_tshirt", **more)


def boxy_trousers(**more) -> Garment:
    """Trousers of two flat panels 20 cm apart: 0.36 m wide, 0.72 m long, with their waist at the origin, Y up."""
    inside = np.zeros((9, 18), bool)
    inside[:, 12:] = True
    inside[:4] = inside[5:] = True
    return _boxed(inside, lambda x, y, along: y > -0.1 or y < -17.9, 0.1, name="boxy_trousers", **more)


def _boxed(inside: np.ndarray, opened, half: float, **more) -> Garment:
    """Two panels of squares at z = half and -half, and walls along their borders but for openings.

    Args:
        inside: Squares of a panel, [columns, rows], the last row being the uppermost.
        opened: Function of the middle of a border, in cells from the middle and the top, and its direction (0: along
            the columns' height), that tells whether there is no wall.
        half: Half the distance of the panels [m].
        more: Of `Garment`.
    """
    columns, rows = inside.shape
    layers = np.linspace(half, -half, DEEP + 1)
    number: dict[tuple[int, int, int], int] = {}
    points: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []

    def corner(i: int, j: int, k: int) -> int:
        if (i, j, k) not in number:
            number[i, j, k] = len(points)
            points.append(((i - columns / 2) * CELL, (j - rows) * CELL, layers[k]))
        return number[i, j, k]

    def square(a: int, b: int, c: int, d: int, odd: bool) -> None:
        faces.extend([(a, b, c), (a, c, d)] if odd else [(a, b, d), (b, c, d)])

    def there(i: int, j: int) -> bool:
        return 0 <= i < columns and 0 <= j < rows and bool(inside[i, j])

    for i, j in zip(*np.nonzero(inside), strict=True):
        ring = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        square(*(corner(*at, 0) for at in ring), bool((i + j) % 2))
        square(*(corner(*at, DEEP) for at in ring[::-1]), bool((i + j) % 2))
        for side, (di, dj) in enumerate([(0, -1), (1, 0), (0, 1), (-1, 0)]):
            start, end = ring[side], ring[(side + 1) % 4]
            middle = 0.5 * (start[0] + end[0]) - columns / 2, 0.5 * (start[1] + end[1]) - rows
            if there(i + di, j + dj) or opened(*middle, 0 if di else 1):
                continue
            for k in range(DEEP):
                a, b = corner(*start, k), corner(*end, k)
                square(b, a, corner(*start, k + 1), corner(*end, k + 1), bool((i + j + k) % 2))
    return Garment(np.array(points), np.array(faces), **more)
