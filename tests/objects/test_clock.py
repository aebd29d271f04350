"""If these failed, motions would lose their end, or come back at other times than those of the shot."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from support.meshes import capsule

import warpgarment as wg
from warpgarment.objects.clock import Clock, between, in_words

BODY = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2)
RATES = (23.976, 24000 / 1001, 24, 25, 29.97, 30000 / 1001, 30, 48, 50, 59.94, 60, 120)


def body(frames, fps=24.0, **more):
    """A body that jumps about, so that every frame is unlike its neighbours."""
    jumps = np.random.default_rng(frames).normal(0, 0.1, (frames, 1, 3))
    return wg.BodyMotion(BODY.vertices + jumps.astype(np.float32), BODY.faces, fps, **more)


def seen_at(motion, times):
    """Positions at moments [s] by np.interp, in float64, of frames at these times; still before and after."""
    flat = motion.vertices.reshape(motion.frames, -1).astype(float)
    when = motion.start + np.arange(motion.frames) / motion.fps
    return np.stack([np.interp(times, when, column) for column in flat.T], 1).reshape(len(times), -1, 3)


@pytest.mark.parametrize("frames", [1, 2, 3, 24, 25, 97])
def test_to_another_rate_and_back(frames):
    """24 frames at 24 a second would be 23 after a simulation at 30, the last one cut. The number of frames and the
    last one exactly; the same for every pair of rates, and whatever the start."""
    for rate, other in itertools.product(RATES, RATES):
        motion = body(frames, rate, start=1001 / 24)
        there = motion.resampled(other)
        back = there.resampled(rate)
        assert (back.frames, back.fps, back.start) == (frames, rate, 1001 / 24), (rate, other)
        assert np.array_equal(back.vertices[[0, -1]], motion.vertices[[0, -1]])
        assert there.frames - 1 >= (frames - 1) * other / rate - 0.01  # nothing is left out
        assert there.frames - 1 < (frames - 1) * other / rate + 1  # and nothing invented
        assert np.array_equal(there.vertices[-1], motion.vertices[-1])
        assert abs(there.clock.end - motion.clock.end) < 1e-9


@pytest.mark.parametrize("other", RATES)
def test_frames_are_where_time_says(other):
    """A resampled motion would run fast, slow or late. By np.interp, to float32 rounding, 1e-6 m."""
    motion = body(25, 24.0, start=2.5)
    there = motion.resampled(other)
    times = np.minimum(2.5 + np.arange(there.frames) / other, 2.5 + 1)
    np.testing.assert_allclose(there.vertices, seen_at(motion, times), atol=1e-6)
    np.testing.assert_allclose(there.clock.times, times, atol=1e-3 / other)
    assert motion.resampled(24.0) is motion


def test_a_finer_rate_and_back_is_the_motion_itself():
    """What lies at the same moment would be mixed with its neighbours. Exact where rates are multiples."""
    motion = body(24, 30.0)
    for other in (60, 90, 120, 240):
        assert np.array_equal(motion.resampled(other).resampled(30.0).vertices, motion.vertices)
        assert np.array_equal(motion.resampled(other).vertices[:: other // 30], motion.vertices)


def test_some_frames_only():
    """`frames=` would hold the end of the whole motion in its last frame."""
    motion = body(25)
    part = motion.resampled(30.0, 10)
    assert (part.frames, part.last) == (10, 9)
    np.testing.assert_allclose(part.vertices, seen_at(motion, np.arange(10) / 30), atol=1e-6)
    assert motion.resampled(30.0, 1000).frames == 31


def test_what_is_made_of_a_motion_keeps_its_time():
    """A part of the body, or a copy, would begin at 0."""
    motion = body(24, start=1001 / 24)
    for made in (motion.submesh(np.arange(len(BODY.faces)) < 50), motion.resampled(30.0), motion.resampled(24.0)):
        assert made.start == 1001 / 24
    held = motion.resampled(30.0).submesh(np.arange(len(BODY.faces)) < 50)
    assert held.resampled(24.0).frames == 24
    assert (held.frames, held.last, held.clock.number) == (30, pytest.approx(28.75), pytest.approx(1251.25))


def test_a_garment_is_resampled_like_its_body():
    """Statuses would be of other frames, a failed rollout would spread its NaN over good frames, or end twice."""
    status = [wg.RolloutStatus.judged(t, t < 4, 0.003 * t) for t in range(5)]
    vertices = np.stack([BODY.vertices + np.float32(0.1 * t) for t in range(5)])
    vertices[4] = np.nan
    motion = wg.GarmentMotion(vertices, BODY.faces, 30.0, status, "skirt", start=3.0)
    fine = motion.resampled(60.0)
    assert (fine.frames, fine.fps, fine.start, fine.name) == (8, 60.0, 3.0, "skirt")
    assert np.isfinite(fine.vertices[:7]).all()
    assert np.isnan(fine.vertices[7]).all()
    assert [s.frame for s in fine.status] == list(range(8))
    assert [s.finite for s in fine.status] == [True] * 7 + [False]
    assert [s.max_penetration for s in fine.status[:7]] == pytest.approx([0, 0.003, 0.003, 0.006, 0.006, 0.009, 0.009])
    slow = wg.GarmentMotion(vertices[:4], BODY.faces, 24.0, status[:4]).resampled(30.0)
    assert (slow.frames, slow.resampled(24.0).frames) == (5, 4)
    assert np.array_equal(slow.resampled(24.0).vertices[-1], vertices[3])


@pytest.mark.parametrize(("more", "said"), [
    ({"start": np.nan}, "start must be a time"), ({"start": np.inf}, "start must be a time"),
    ({"start": 1e15}, "start must be a time"), ({"last": 3.0}, "last must be between"),
    ({"last": 5.0}, "last must be between"), ({"last": np.nan}, "last must be between"),
])  # fmt: skip
def test_times_that_are_none(more, said):
    """Frames could not be told apart, or lie in no order."""
    with pytest.raises(wg.MeshError, match=said):
        body(5, **more)


def test_places_and_words():
    """What is said of a shot would name other frames than it has."""
    clock = Clock.checked(25, 24, 1001 / 24)
    assert in_words(clock) == "25 frames, 1001 to 1025 at 24 a second (41.708 to 42.708 s)"
    assert in_words(Clock.checked(1, 30)) == "1 frame, 0 at 30 a second (0.000 to 0.000 s)"
    assert clock.places(np.array([0, 1001.5 / 24, 1025 / 24, 99])).tolist() == pytest.approx([0, 0.5, 24, 24])
    assert clock.places(clock.times).tolist() == list(range(25))
    with_nan = np.array([[[0.0]], [[np.nan]]], np.float32)
    assert between(with_nan, np.array([0.0, 1.0]))[0] == 0
