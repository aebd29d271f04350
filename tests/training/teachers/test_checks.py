"""The checks of teachers: by teachers that know the answer, and of Newton."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j0, jn_zeros

from warpgarment.objects.material import Material
from warpgarment.training.teachers import ClothScene
from warpgarment.training.teachers.checks import (
    CheckResult,
    hanging_sheet,
    hanging_strip,
    pendulum,
    rest_on_sphere,
    run_checks,
    vertex_areas,
)
from warpgarment.training.teachers.newton.settings import CONVERGED
from warpgarment.training.teachers.newton.teacher import NewtonTeacher


class Known:
    """A teacher that yields what a function of the scene and the time says."""

    name = "known"

    def __init__(self, answer: Callable[[ClothScene, float], np.ndarray]):
        self._answer = answer

    def simulate(self, scene: ClothScene) -> Iterator[np.ndarray]:
        """Frame t is reached at t + 1 frames after the start, as with a teacher that settles for one."""
        for frame in range(len(scene)):
            yield self._answer(scene, (frame + 1) / scene.fps).astype(np.float32)


def hung(share: float) -> Known:
    """Strips that stretch by a share of what they should: the displacement is that of a bar in its own weight."""

    def answer(scene: ClothScene, _time: float) -> np.ndarray:
        (cloth,) = scene.cloths
        vertices, material = cloth.garment.vertices.astype(np.float64), cloth.material
        depth, length = -vertices[:, 1], -vertices[:, 1].min()
        young = 4 * material.shear * (material.stretch + material.shear) / (material.stretch + 2 * material.shear)
        vertices[:, 1] -= share * material.density * 9.81 / young * (length * depth - depth**2 / 2)
        return vertices

    return Known(answer)


@pytest.mark.parametrize("share", [1.0, 1.3])
def test_the_strip_is_measured_as_it_hangs(share):
    """The check would pass a teacher whose cloth stretches too far, or fail one that is right."""
    result = hanging_strip(hung(share), Material(density=0.7, stretch=150.0, shear=90.0))
    # a stretch of a millimetre on a quarter of a metre in float32: 3e-5 of it
    assert result.measured == pytest.approx(share * result.expected, rel=1e-4)
    assert result.error == pytest.approx(share - 1.0, abs=1e-4)
    assert result.passed == (share == 1.0)


def swinging(faster: float, second_mode: float) -> Known:
    """Chains that swing in their first mode, at another speed, with some of the second mode beside it."""

    def answer(scene: ClothScene, time: float) -> np.ndarray:
        (cloth,) = scene.cloths
        vertices = cloth.garment.vertices.astype(np.float64)
        length = -vertices[:, 1].min()
        root = np.sqrt(np.clip(1 + vertices[:, 1] / length, 0, 1))
        for zero, size in zip(jn_zeros(0, 2), (0.03, second_mode), strict=True):
            vertices[:, 2] += size * j0(zero * root) * np.cos(faster * zero / 2 * np.sqrt(9.81 / length) * time)
        return vertices

    return Known(answer)


def test_the_period_is_that_of_the_slowest_mode():
    """The check would take another mode's swing for the period, or a rigid plate's for a sheet's."""
    # trapezoidal sums over six rows leave the modes orthogonal to a few hundredths
    assert pendulum(swinging(1.0, 0.0)).error < 1e-3
    assert pendulum(swinging(1.0, 0.003), edge=0.025, swings=2.0).error < 5e-3
    slow = pendulum(swinging(0.9, 0.0))
    assert slow.measured == pytest.approx(slow.expected / 0.9, rel=1e-3)
    assert not slow.passed
    rigid = 2 * np.pi * np.sqrt(2 * 0.3 / (3 * 9.81))
    assert 1.01 < slow.expected / rigid < 1.03
    assert not pendulum(swinging(0.0, 0.0)).passed  # never returns: NaN


def test_the_sheet_starts_in_its_mode_with_its_length():
    """A sheet that starts stretched would bounce instead of swing."""
    seen = []

    def answer(scene: ClothScene, _time: float) -> np.ndarray:
        seen.append(scene.cloths[0])
        return scene.cloths[0].first

    pendulum(Known(answer))
    cloth = seen[0]
    upright = cloth.garment.edges[np.ptp(cloth.garment.vertices[cloth.garment.edges][:, :, 0], axis=1) < 1e-6]
    lengths = [np.linalg.norm(np.diff(v[upright], axis=1), axis=2) for v in (cloth.start, cloth.garment.vertices)]
    np.testing.assert_allclose(lengths[0], lengths[1], rtol=1e-5)
    assert cloth.start[:, 2].max() == pytest.approx(0.03)
    np.testing.assert_allclose(cloth.start[cloth.garment.pins], cloth.garment.vertices[cloth.garment.pins], atol=1e-6)


def test_the_sphere_notices_what_is_inside_or_moves():
    """The check would pass cloth that fell through the body, or that never comes to rest."""

    def lowered(scene: ClothScene, time: float) -> np.ndarray:
        return scene.cloths[0].first - np.array([0, 0.05 * np.exp(-8 * time), 0])

    inside, still = rest_on_sphere(Known(lambda scene, time: lowered(scene, time) - [0, 0.03, 0]))
    # the sheet's middle lies 20 mm over a ball of 120 mm: 10 mm inside
    assert inside.measured == pytest.approx(0.01 / 0.12, rel=0.02)
    assert not inside.passed
    assert still.passed
    outside, moving = rest_on_sphere(Known(lambda scene, time: lowered(scene, time) + [0, 0.1 * np.sin(9 * time), 0]))
    assert outside.passed
    assert not moving.passed


def test_sheets_are_what_formulas_speak_of():
    """Masses, lengths or the side that faces out would be wrong."""
    sheet = hanging_sheet(0.05, 0.25, 0.025)
    assert vertex_areas(sheet).sum() == pytest.approx(0.05 * 0.25, rel=1e-6)
    assert sheet.vertices[sheet.pins, 1].tolist() == [0, 0, 0]
    assert (sheet.face_frames[:, 2, 2] > 0.99).all()


def test_a_result_says_whether_it_passed():
    """NaN would count as passed, or an expected zero divide by itself."""
    good = CheckResult("period", 1.02, 1.0, 0.03, "s")
    assert good.passed
    assert good.error == pytest.approx(0.02)
    assert str(good) == "period: 1.02 s, expected 1, error 2.0 % of 3 % allowed: ok"
    assert not replace(good, measured=float("nan")).passed
    assert CheckResult("depth", 0.02, 0.0, 0.01).error == 0.02
    assert "FAILED" in str(replace(good, measured=2.0))


def test_newton_passes_when_converged():
    """Newton's cloth would not be the material it is said to be, or fall through a body."""
    results = run_checks(NewtonTeacher(CONVERGED))
    assert [r.name for r in results if not r.passed] == []
    assert len(results) == 4


def test_newton_errs_less_with_more_iterations():
    """The error of the default settings would be that of the formula, not of the solver."""
    settings = [replace(CONVERGED, substeps=10, iterations=n) for n in (5, 10, 20)]
    errors = [hanging_strip(NewtonTeacher(s)).error for s in settings]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[0] > 0.5  # the default settings stretch a soft, heavy strip twice as far
