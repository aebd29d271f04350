"""The wind that blows on garments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warpgarment.errors import UsageError

FASTEST = 100.0
"""Fastest air [m/s]; faster than in any storm is a mistake of unit."""
MOST_ROWS = 10_000_000


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Wind:
    """Air that moves the same everywhere, steadily or from frame to frame. It is not changed once it is made.

        wg.Wind([0, 0, 1], 5.0)                    # 5 m/s towards +Z; Y is up
        wg.Wind([1, 0, 0], [0, 2, 4, 2], fps=24)   # along X, a speed for each frame of a shot; the last one holds on

    Args:
        direction: Direction in which the air moves, of any length but zero, shape [3], or [T,3] with one for each row.
        speed: Speed of the air [m/s], a number of at least 0, or one for each row, shape [T].
        fps: Rows a second; None for those of the network. Between rows the velocity changes in a straight line.

    Attributes:
        rows: Velocity of the air in each row [m/s], float64 [T,3], read-only.
        fps: Rows a second, or None.

    Raises:
        UsageError: NaN or infinity, a direction of no length where there is speed, a negative speed, one of more than
            100 m/s, other shapes, or a rate that is not positive.
    """

    rows: np.ndarray
    fps: float | None

    def __init__(self, direction: Any, speed: Any, *, fps: float | None = None) -> None:
        towards, fast = _numbers("direction", direction), _numbers("speed", speed)
        if towards.ndim not in (1, 2) or towards.shape[-1] != 3 or not len(towards):
            raise UsageError(
                f"a wind's direction must have shape [3] or [T,3], got {list(towards.shape)}. Give x, y and z; Y is up"
            )
        if fast.ndim > 1 or not fast.size:
            raise UsageError(f"a wind's speed must be a number or have shape [T], got {list(fast.shape)}")
        towards, fast = np.atleast_2d(towards), np.atleast_1d(fast)
        if 1 not in (len(towards), len(fast)) and len(towards) != len(fast):
            raise UsageError(
                f"a wind of {len(towards)} directions and {len(fast)} speeds. Give one of each for every row, or a "
                "single one for all"
            )
        if fast.min() < 0:
            raise UsageError(
                f"a wind's speed must not be negative, got {fast.min():g} m/s{_at(fast < 0)}. Turn its direction round"
            )
        if fast.max() > FASTEST:
            raise UsageError(too_fast(fast))
        length = np.linalg.norm(towards, axis=1, keepdims=True)
        if ((length[:, 0] == 0) & (fast > 0)).any():
            raise UsageError(
                f"a wind's direction has no length{_at(length[:, 0] == 0)}, and its speed is not 0. Give x, y and z "
                "of any other length, or speed 0 for still air"
            )
        if fps is not None and not (np.isfinite(fps) and fps > 0):
            raise UsageError(f"a wind's fps must be a positive number of rows a second, got {fps}")
        rows = towards / np.where(length > 0, length, 1.0) * fast[:, None]
        rows.setflags(write=False)
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "fps", None if fps is None else float(fps))

    @classmethod
    def of_velocities(cls, velocities: Any, *, fps: float | None = None) -> Wind:
        """The wind of some velocities.

        Args:
            velocities: Velocity of the air [m/s], shape [3], or [T,3] with one for each row.
            fps: Rows a second, as in the constructor.

        Raises:
            UsageError: NaN or infinity, more than 100 m/s, or another shape.
        """
        given = _numbers("velocity", velocities)
        if given.ndim not in (1, 2) or given.shape[-1] != 3 or not len(given):
            raise UsageError(f"a wind's velocity must have shape [3] or [T,3], got {list(given.shape)}")
        return cls(given, np.linalg.norm(np.atleast_2d(given), axis=1), fps=fps)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        speed = np.linalg.norm(self.rows, axis=1)
        if len(self) == 1:
            return f"Wind.of_velocities({self.rows[0].round(6).tolist()})"
        rate = "" if self.fps is None else f" at {self.fps:g} a second"
        return f"<Wind of {len(self):,} rows{rate}, {speed.min():.3g} to {speed.max():.3g} m/s>"

    def velocities(self, fps: float) -> np.ndarray:
        """Velocity of the air at each frame of a rate [m/s], float32 [K,3]; after the last row, that one holds on.

        Args:
            fps: Frames per second.
        """
        if self.fps is None or self.fps == fps or len(self) == 1:
            return self.rows.astype(np.float32)
        last = len(self) - 1
        frames = int(np.ceil(last * fps / self.fps - 1e-9)) + 1
        if frames > MOST_ROWS:
            raise UsageError(f"a wind of {len(self):,} rows at fps={self.fps:g} would last {frames:,}. Check fps")
        places = np.minimum(np.arange(frames) * (self.fps / fps), last)
        columns = [np.interp(places, np.arange(last + 1), column) for column in self.rows.T]
        return np.stack(columns, axis=1).astype(np.float32)


def too_fast(speed: np.ndarray) -> str:
    """The message about speeds [m/s], shape [T], of which one is over `FASTEST`."""
    return f"wind of {speed.max():,.0f} m/s; it must be at most {FASTEST:.0f} m/s. Check its unit"


def _numbers(name: str, value: Any) -> np.ndarray:
    """The argument as float64, a copy."""
    try:
        found = np.array(value.detach().cpu().numpy() if hasattr(value, "detach") else value, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"a wind's {name} must be numbers, got {value!r}") from None
    if not np.isfinite(found).all():
        rows = np.logical_not(np.isfinite(np.atleast_2d(found.T).T).all(axis=-1)).reshape(-1)
        raise UsageError(f"a wind's {name} holds NaN or infinity{_at(rows)}. Repair what it is from")
    return found


def _at(bad: np.ndarray) -> str:
    """Where the first bad row is, if there are several rows."""
    return f" (first: row {int(bad.argmax())})" if len(bad) > 1 else ""
