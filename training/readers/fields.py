"""Numbers out of files of strangers: finite ones, or an error that names the file and the field."""

from __future__ import annotations

from typing import Any

import numpy as np

from warpgarment.errors import MeshError

MOST_BETAS = 1_000
LARGEST = 1e12  # of a number in a description


def numbers(where: str, value: Any, dimensions: tuple[int, ...] = (1,)) -> np.ndarray:
    """An array of finite numbers.

    Args:
        where: The file and the field, for messages.
        value: Value of the field: an array, a number, or a list of numbers or of such lists.
        dimensions: Numbers of dimensions it may have.

    Returns:
        The numbers, float64; one number has dimension 0.

    Raises:
        MeshError: It holds something else, is empty, or a number is NaN or infinite.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, OverflowError):  # lists of different lengths
        array = np.asarray(None)
    if array.dtype.kind not in "fiu" or array.ndim not in dimensions or array.size == 0:
        shape = f"{array.dtype} {list(array.shape)}" if isinstance(value, np.ndarray) else repr(value)[:40]
        raise MeshError(f"{where} must be numbers, with {' or '.join(map(str, dimensions))} dimensions; it is {shape}.")
    if not np.isfinite(array).all():
        raise MeshError(f"{where} holds NaN or infinity.")
    return array.astype(np.float64)


def number(where: str, value: Any) -> float:
    """One finite number of at most `LARGEST`.

    Args:
        where: The file and the field, for messages.
        value: Value of the field.

    Raises:
        MeshError: It is something else.
    """
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not plain or not -LARGEST <= value <= LARGEST:  # also refuses NaN, and integers that no float holds
        shown = "of more than 40 digits" if isinstance(value, int) and abs(value) > 10**40 else repr(value)[:40]
        raise MeshError(f"{where} must be a number, it is {shown}. Numbers up to {LARGEST:g} are read.")
    return float(value)


def betas(where: str, value: Any, frames: int) -> np.ndarray:
    """Shape coefficients, [S], or [T, S] where they change from frame to frame.

    Args:
        where: The file and the field, for messages.
        value: Value of the field.
        frames: Number of frames T.

    Raises:
        MeshError: It holds something else.
    """
    array = numbers(where, value, (1, 2))
    if array.shape[-1] > MOST_BETAS or (array.ndim == 2 and len(array) not in (1, frames)):
        raise MeshError(
            f"{where} must be [S], or [T,S] with T = {frames:,}, S at most {MOST_BETAS:,}; it is {list(array.shape)}."
        )
    return array[0] if array.ndim == 2 and (array == array[:1]).all() else array
