"""Checks of a teacher against known results: a strip that hangs, a sheet that swings, a cloth that comes to rest.

    for result in run_checks(NewtonTeacher(CONVERGED)):
        print(result)

They use only :class:`.Teacher` and are valid for every teacher. The sheets that are compared with formulas weigh
1 kg/m^2, so that the air around them does not matter.

The results depend on the solver as much as on the cloth. With a fixed number of iterations, Newton's VBD has the errors

| substeps x iterations | hanging strip stretches | swinging sheet's period |
| --------------------- | ----------------------- | ----------------------- |
| 10 x 5, the default   | twice as far            | 2.3 % too long          |
| 10 x 20, 20 x 5       | 5 %, 9 % too far        | 1.1 % too long          |
| 20 x 10, `CONVERGED`  | right within 0.1 %      | 0.8 % too long          |

and larger ones for stiffer, lighter or finer cloth: see :mod:`.newton`. The remaining error of the period is that of
the mesh: at half the edge length it is 0.2 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import j0

from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from . import Cloth, ClothScene, Teacher

GRAVITY = 9.81
FPS = 30.0
_J01 = 2.404825557695773  # first zero of the Bessel function J0


@dataclass(frozen=True)
class CheckResult:
    """The result of a check.

    Attributes:
        name: Name of the measured quantity.
        measured: Measured value, in `unit`.
        expected: Expected value, in `unit`.
        tolerance: Largest `error` with which the check is passed.
        unit: Unit of the measured and the expected value.
    """

    name: str
    measured: float
    expected: float
    tolerance: float
    unit: str = ""

    @property
    def error(self) -> float:
        """Relative error; the error in `unit` if the expected value is zero."""
        return abs(self.measured - self.expected) / (abs(self.expected) or 1.0)

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance; False if it is NaN."""
        return self.error <= self.tolerance

    def __str__(self) -> str:
        verdict = "ok" if self.passed else "FAILED"
        return (
            f"{self.name}: {self.measured:.5g} {self.unit}, expected {self.expected:.5g}, error "
            f"{100 * self.error:.1f} % of {100 * self.tolerance:.0f} % allowed: {verdict}"
        )


def run_checks(teacher: Teacher) -> list[CheckResult]:
    """Results of all checks of this file, which take some ten seconds with Newton on a CPU."""
    return [hanging_strip(teacher), pendulum(teacher), *rest_on_sphere(teacher)]


def hanging_strip(
    teacher: Teacher,
    material: Material | None = None,
    *,
    length: float = 0.25,
    width: float = 0.05,
    edge: float = 0.025,
    settle: int = 20,
    tolerance: float = 0.05,
) -> CheckResult:
    """The extension of a strip hung by its upper edge, under its own weight.

    At small strain a strip of density ρ, modulus E (:attr:`.Material.modulus`) and length L carries ρ g s at a height s
    above its lower end, and is extended by ∫ ρ g s / E ds = ρ g L² / (2 E). (The clamped edge cannot contract, which
    reduces the extension by about 1 %.)

    Args:
        teacher: Teacher to check.
        material: Material of the strip; None for a soft and heavy one, which is extended by 0.5 %.
        length, width: Size of the strip [m].
        edge: Edge length of its mesh [m].
        settle: Number of frames in which the strip comes to rest.
        tolerance: Largest relative error.
    """
    material = material or Material(density=1.0, stretch=100.0, shear=100.0, bend=1e-4)
    strip = hanging_sheet(width, length, edge)
    scene = ClothScene((Cloth(strip, edge, material=material),), frames=3, fps=FPS, settle=settle)
    last = _frames(teacher, scene)[-1]
    end = strip.vertices[:, 1] < -length + 0.1 * edge
    measured = -length - float(last[end, 1].mean())
    expected = material.density * GRAVITY * length**2 / (2.0 * material.modulus)
    return CheckResult("elongation of a hanging strip", 1e3 * measured, 1e3 * expected, tolerance, "mm")


def pendulum(
    teacher: Teacher,
    material: Material | None = None,
    *,
    length: float = 0.3,
    width: float = 0.05,
    edge: float = 0.05,
    tip: float = 0.03,
    swings: float = 0.9,
    tolerance: float = 0.03,
) -> CheckResult:
    """The period of a sheet that swings about its upper edge.

    A sheet without bending stiffness is a hanging chain (Daniel Bernoulli 1732). At small amplitudes its slowest mode
    is J₀(j √(s / L)) at a height s above the lower end, j = 2.4048 the first zero of J₀, and has the period
    4π / j √(L / g); a rigid plate would take 2 % less. The sheet starts in that mode, and its motion is projected on
    it: the other modes are orthogonal to it. The period is twice the mean time between zeros.

    Args:
        teacher: Teacher to check.
        material: Material of the sheet; None for a limp and heavy one.
        length, width: Size of the sheet [m].
        edge: Edge length of its mesh [m].
        tip: Amplitude of the lower end [m].
        swings: Number of simulated periods; two zeros need three quarters of a period.
        tolerance: Largest relative error.
    """
    material = material or Material(density=1.0, stretch=1e3, shear=1e3, bend=1e-5)
    expected = 4.0 * np.pi / _J01 * np.sqrt(length / GRAVITY)
    sheet = hanging_sheet(width, length, edge)
    mode = j0(_J01 * np.sqrt(np.clip(1.0 + sheet.vertices[:, 1].astype(np.float64) / length, 0.0, 1.0)))
    start = _swung(sheet, mode, tip)
    frames = int(np.ceil(swings * expected * FPS)) + 2
    scene = ClothScene((Cloth(sheet, edge, start, material),), frames=frames, fps=FPS, settle=0)
    shown = _frames(teacher, scene)
    weight = vertex_areas(sheet) * mode
    signal = shown[:, :, 2] @ weight
    crossings = np.flatnonzero(signal[:-1] * signal[1:] < 0)
    times = crossings + signal[crossings] / (signal[crossings] - signal[crossings + 1])
    measured = 2.0 * float(np.diff(times).mean()) / FPS if len(times) > 1 else float("nan")
    return CheckResult("period of a swinging sheet", measured, expected, tolerance, "s")


def rest_on_sphere(
    teacher: Teacher,
    material: Material | None = None,
    *,
    radius: float = 0.12,
    size: float = 0.36,
    edge: float = 0.045,
    frames: int = 45,
    depth: float = 0.01,
    motion: float = 0.02,
) -> list[CheckResult]:
    """A square cloth dropped on a sphere, which should stay outside of it and come to rest.

    Args:
        teacher: Teacher to check.
        material: Material of the cloth; None for an ordinary one with friction 0.5.
        radius: Radius of the sphere [m].
        size: Side of the cloth [m].
        edge: Edge length of its mesh [m].
        frames: Number of simulated frames.
        depth: Largest depth of a vertex inside the sphere, as a share of the radius.
        motion: Largest kinetic energy of the cloth at the end, as a share of its largest one.

    Returns:
        Depth of the deepest vertex in the last frame as a share of the radius, and the remaining share of the largest
        kinetic energy.
    """
    import igl

    material = material or Material(friction=0.5)
    sphere, faces = _sphere(radius)
    cloth = flat_sheet(size, edge, height=radius + 0.02)
    body = np.repeat(sphere[None], frames, axis=0)
    scene = ClothScene((Cloth(cloth, edge, material=material),), body, faces, fps=FPS, settle=0)
    shown = _frames(teacher, scene)
    distance = igl.signed_distance(
        shown[-1],
        sphere.astype(np.float64),
        faces.astype(np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]
    speed = np.diff(shown, axis=0) * FPS
    energy = 0.5 * material.density * (vertex_areas(cloth) * (speed**2).sum(2)).sum(1)
    return [
        CheckResult("depth in a sphere over its radius", max(0.0, -float(distance.min()) / radius), 0.0, depth),
        CheckResult("kinetic energy left on a sphere", float(energy[-1] / energy.max()), 0.0, motion),
    ]


def hanging_sheet(width: float, length: float, edge: float) -> Garment:
    """A sheet from y = 0 down to y = -length, facing +Z, with its upper edge pinned; lengths in metres."""
    columns, rows = max(1, round(width / edge)), max(1, round(length / edge))
    sheet = _grid(columns, rows)
    vertices = np.stack([(sheet[:, 0] - 0.5) * width, -sheet[:, 1] * length, np.zeros(len(sheet))], 1)
    return Garment(vertices, _faces(columns, rows), pins=np.arange(columns + 1), name="hanging sheet")


def flat_sheet(size: float, edge: float, *, height: float) -> Garment:
    """A square sheet in the plane y = height, facing up; lengths in metres."""
    cells = max(1, round(size / edge))
    sheet = (_grid(cells, cells) - 0.5) * size
    vertices = np.stack([sheet[:, 0], np.full(len(sheet), height), sheet[:, 1]], 1)
    return Garment(vertices, _faces(cells, cells), name="sheet")


def vertex_areas(garment: Garment) -> np.ndarray:
    """A third of the area of each vertex's faces at rest [m^2], float64 [V]."""
    corners = garment.vertices.astype(np.float64)[garment.faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.bincount(garment.faces.ravel(), np.repeat(areas / 3.0, 3), minlength=len(garment.vertices))


def _frames(teacher: Teacher, scene: ClothScene) -> np.ndarray:
    return np.stack(list(teacher.simulate(scene))).astype(np.float64)


def _swung(sheet: Garment, mode: np.ndarray, tip: float) -> np.ndarray:
    """Vertices [m], [V, 3], of the sheet displaced in z by tip times the mode, without a change of its length."""
    rest = sheet.vertices.astype(np.float64)
    heights, first = np.unique(rest[:, 1], return_index=True)
    depth, swing = -heights[::-1], tip * mode[first][::-1]  # from the pinned edge down
    lowered = np.concatenate([[0.0], np.cumsum(np.sqrt(np.diff(depth) ** 2 - np.diff(swing) ** 2))])
    row = np.searchsorted(depth, -rest[:, 1])
    return np.stack([rest[:, 0], -lowered[row], swing[row]], 1).astype(np.float32)


def _grid(columns: int, rows: int) -> np.ndarray:
    """Corners of cells in the unit square, row by row, [N, 2]."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, columns + 1), np.linspace(0.0, 1.0, rows + 1))
    return np.stack([x.ravel(), y.ravel()], 1)


def _faces(columns: int, rows: int) -> np.ndarray:
    """Two triangles per cell with alternating diagonals, counter-clockwise with y downwards."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(columns), np.arange(rows)))
    a = j * (columns + 1) + i
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    odd = ((i + j) % 2 == 1)[:, None, None]
    one, other = np.stack([[a, c, b], [b, c, d]]), np.stack([[a, c, d], [a, d, b]])
    return np.where(odd, one.transpose(2, 0, 1), other.transpose(2, 0, 1)).reshape(-1, 3).astype(np.int32)


def _sphere(radius: float) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32)
