"""Skirts on two legs that part: how long a tape around them is, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import tube

import warpgarment as wg
from warpgarment.geometry.stride import too_narrow

RADIUS, APART, FRAMES = 0.08, 0.2, 11


def _legs(step: float) -> tuple[np.ndarray, np.ndarray]:
    """Two legs of 8 cm radius, 20 cm apart, that part by a way [m] in 10 frames, one to the front, one to the back."""
    vertices, faces = tube(64, 51, bottom=-0.5, top=0.5, radius=(RADIUS, RADIUS))
    side = np.repeat([-0.5, 0.5], len(vertices))
    both = np.concatenate([vertices, vertices])
    both[:, 0] += APART * side
    moved = [both + np.stack([0 * side, 0 * side, side * step * t / 10], 1) for t in range(FRAMES)]
    return np.stack(moved), np.concatenate([faces, faces + len(vertices)])


@pytest.mark.parametrize(("radius", "narrow"), [(0.2, True), (0.4, False)], ids=["narrow", "wide"])
def test_a_tape_around_two_legs(radius, narrow) -> None:
    """A skirt of 1.26 m would be simulated on legs that need 1.58 m without a word, or a wide one be blamed. The tape
    is 2 d + 2 pi r, d between the axes: 0.1 % for 64 sides; the line is that of the tube, likewise."""
    vertices, faces = tube(64, 9, bottom=-0.4, top=0.4, radius=(radius, radius))
    body, body_faces = _legs(0.5)
    found = too_narrow(vertices, vertices, faces, body, body_faces)
    if not narrow:
        assert found is None
        return
    apart = np.hypot(APART, 0.5 * np.arange(FRAMES) / 10)
    np.testing.assert_allclose(found.needed, 2 * apart + 2 * np.pi * RADIUS, rtol=2e-3)
    np.testing.assert_allclose(found.length, 2 * np.pi * radius, rtol=2e-3)
    assert found.frames.tolist() == np.flatnonzero(2 * apart + 2 * np.pi * RADIUS > 1.15 * found.length).tolist()
    assert "in frame 10 (" in str(found)


def test_one_leg_and_slits_are_no_steps() -> None:
    """Trousers, sleeves and an open skirt would be called too narrow: a line around one leg, and one that is open."""
    body, body_faces = _legs(0.5)
    vertices, faces = tube(32, 9, bottom=-0.4, top=0.4, radius=(0.1, 0.1))
    leg = vertices + np.float32([-0.5 * APART, 0, 0])
    assert too_narrow(leg, leg, faces, body, body_faces) is None
    vertices, faces = tube(64, 9, bottom=-0.4, top=0.4, radius=(0.2, 0.2))
    around = np.arctan2(vertices[:, 2], vertices[:, 0])[faces]
    slit = faces[~((around > -0.2).all(1) & (around < 0.2).all(1))]
    assert too_narrow(vertices, vertices, slit, body, body_faces) is None


def test_simulate_tells_which_garment() -> None:
    """The warning would name another garment of an outfit, or look at its place in the file and not at the start."""
    from warpgarment.cli.simulate import _narrow

    body, body_faces = _legs(0.5)
    moving = wg.BodyMotion(body, body_faces, 30.0)
    narrow, wide = (wg.Garment(*tube(64, 9, bottom=-0.4, top=0.4, radius=(radius, radius))) for radius in (0.2, 0.4))
    assert list(_narrow({"over": wide, "under": narrow}, None, moving)) == ["under"]
    away = narrow.vertices + np.float32([3.0, 0.0, 0.0])
    assert _narrow({"under": narrow}, [away], moving) == {}
