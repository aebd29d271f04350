"""Which time codes of a stage are read as frames, and how many of them are a second; frames of caches in seconds."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError

SLOWEST, FASTEST = 12.0, 240.0  # time codes a second that are taken for frames; others are seconds or ticks
SMOOTH = 24.0  # frames a second, at least, at which rotations between far samples are followed
NTSC = tuple(1000.0 * rate / 1001.0 for rate in (24, 30, 60, 120))
LONGEST = 20_000  # frames in which nothing moves, before the first time sample or after the last


class Frames(NamedTuple):
    """Time codes of the frames, float64 [T], evenly spaced, and frames per second; None for a single frame."""

    codes: np.ndarray
    fps: float | None


def frames_of(samples: np.ndarray, rate: float, span: tuple[float, float] | None, *, turns: bool, where: str) -> Frames:
    """Frames of a mesh that has time samples, or none.

    Where the stage counts frames (12 to 240 time codes a second), a frame is a time code, or the distance of the
    samples where these are closer and evenly spaced. Where it counts seconds or ticks, a frame is the least distance of
    two samples. Frames go from the start to the end of the stage where it has a range, otherwise from the first to
    the last sample. Between samples USD interpolates.

    Args:
        samples: Time codes at which anything that moves the mesh has a value, sorted, shape [S].
        rate: Time codes per second.
        span: Start and end time code of the stage; None: it has none.
        turns: Whether transforms or a skeleton move the mesh, so that positions between samples are not on a line.
        where: The file and the mesh, for messages.

    Raises:
        MeshError: The rate is not positive, or there would be far more frames than samples.
    """
    if not np.isfinite(rate) or rate <= 0:
        raise MeshError(f"{where}: {rate:g} time codes per second. Repair timeCodesPerSecond of the stage.")
    if span is not None and not (np.isfinite(span).all() and span[1] > span[0]):
        span = None
    if len(samples) < 2 and span is None:
        return Frames(samples[:1], None)
    step = _step(samples, rate, turns)
    start, end = span if span is not None else (float(samples[0]), float(samples[-1]))
    moves = (samples[0], samples[-1]) if len(samples) > 1 else (start, start)
    if max(moves[0] - start, end - moves[1]) > LONGEST * step:
        warnings.warn(
            f"{where}: the stage's range goes from {start:g} to {end:g}, and its time samples end at {moves[1]:g}. "
            f"Only the time of the samples is read; more than {LONGEST:,} frames without motion are left out.",
            UserWarning,
            stacklevel=6,
        )
        start, end = moves
    count = int(np.floor((end - start) / step + 1e-6)) + 1
    if count > LONGEST * 3 + 50 * len(samples):
        raise MeshError(
            f"{where}: {len(samples):,} time samples over {end - start:g} time codes at {rate:g} a second would be "
            f"{count:,} frames. Repair timeCodesPerSecond or the time samples."
        )
    codes = start + step * np.arange(count)
    return Frames(_snapped(codes, samples, step), _rounded(rate / step) if count > 1 else None)


def _rounded(fps: float) -> float:
    """A rate that differs from a whole one by the rounding of times in float32 is that one."""
    return float(round(fps)) if abs(fps - round(fps)) < 1e-5 * fps else fps


def _step(samples: np.ndarray, rate: float, turns: bool) -> float:
    """Time codes from one frame to the next."""
    counts_frames = SLOWEST <= rate <= FASTEST
    if len(samples) < 2:
        return 1.0 if counts_frames else rate / 30.0
    gaps = np.diff(samples)
    least = float(gaps.min())
    even = float(gaps.max()) <= least * 1.01
    least = float(samples[-1] - samples[0]) / round(float(samples[-1] - samples[0]) / least)  # of rounded time codes
    if counts_frames and not (even and least < 0.99):
        return 1.0
    native = rate / least
    if native > FASTEST:
        return least * np.ceil(native / FASTEST)
    if native < SLOWEST and turns:
        return least / np.ceil(SMOOTH / native)
    return least


def _snapped(codes: np.ndarray, samples: np.ndarray, step: float) -> np.ndarray:
    """Codes that differ from a sample by rounding alone are put on it, so that its value is read as it is."""
    if len(samples) == 0:
        return codes
    near = samples[np.clip(np.searchsorted(samples, codes - 1e-3 * step), 0, len(samples) - 1)]
    return np.where(np.abs(near - codes) < 1e-3 * step, near, codes)


class Moments(NamedTuple):
    """Frames per second of evenly spaced frames, None where that cannot be told; time of the first [s]."""

    fps: float | None
    start: float


def moments(times: np.ndarray, precision: float, where: str) -> Moments:
    """The rate and the start of frames whose times a file has.

    A rate that differs from a whole one, or one of NTSC, by the rounding of the times is that one; so is a start from a
    whole frame.

    Args:
        times: Times of the frames [s], shape [T].
        precision: Largest relative error of the file's numbers.
        where: The file, for messages.

    Warns:
        UserWarning: The times do not grow, or are not evenly spaced; then there is no rate.
    """
    seconds = np.asarray(times, dtype=np.float64)
    first = float(seconds[0])
    if len(seconds) < 2:
        return Moments(None, first if np.isfinite(first) else 0.0)
    span = float(seconds[-1] - seconds[0])
    error = 4.0 * precision * float(np.abs(seconds).max())
    gap = span / (len(seconds) - 1)
    if not np.isfinite(seconds).all() or gap <= error:
        if np.isfinite(seconds).all() and span == 0.0:
            return Moments(None, first)  # a writer that leaves them out
        _say_uneven(where)
        return Moments(None, 0.0)
    if np.abs(seconds - (seconds[0] + gap * np.arange(len(seconds)))).max() > 0.02 * gap + error:
        _say_uneven(where)
        return Moments(None, 0.0)
    fps, off = 1.0 / gap, error / span
    rates = ((float(round(fps)), max(1e-5, off)), *((rate, max(1e-7, off)) for rate in NTSC))
    near = [rate for rate, far in rates if rate and abs(rate - fps) <= far * fps]
    fps = min(near, key=lambda rate: abs(rate - fps)) if near else fps
    number = round(first * fps)
    close = abs(first * fps - number) <= max(1e-3, error * fps)
    return Moments(fps, number / fps if close else first)


def _say_uneven(where: str) -> None:
    warnings.warn(
        f"{where}: its frames are not evenly spaced in time, or their times do not grow: the times are left out. Give "
        "the rate with fps=.",
        UserWarning,
        stacklevel=7,
    )
